"""What a diagnosis found, in the words of its report."""

from __future__ import annotations

import pytest

from api.client import ServiceClient, ServiceProblem
from lab.formats.results import DiagnosisResult
from lab.report.answers import answers
from tests.api.conftest import Running
from tests.lab.calibration.test_life import fitted


def diagnosis(probability: float = 0.99) -> DiagnosisResult:
    """A mismatch that a filter explains: two measurements with both predictions, and pictures of two frames."""
    x = tuple(float(n) for n in range(5))
    curve = {
        "side": "left", "measurement": "narrowband", "label": "flat", "channel": "R", "axis": "wavelength, nm",
        "quantity": "mean level, DN",
        "x": x, "measured": (1.0,) * 5, "measured_std": (0.1,) * 5, "after": (1.0,) * 5, "held_out": True,
    }  # fmt: skip
    picture = {"kind": "flat", "capture": "f", "held_out": True, "before": ((4.0, -4.0),), "after": ((1.0, -1.0),)}
    unchanged = picture | {"side": "right", "after": picture["before"]}
    return DiagnosisResult.model_validate(
        {
            "source": "s",
            "verdict": "explained",
            "effects": [
                {
                    "name": "infrared_cut_filter", "family": "infrared_cut_filter", "law": "exact",
                    "probability": probability, "sides": ["left"],
                    "parameters": {"edge_nm": {"value": 650.0, "std": 0.2, "unit": "nm"}},
                    "statement": "A filter stands before the sensor.",
                }
            ],
            "curves": [
                curve | {"before": (2.0,) * 5},
                curve | {"measurement": "chart", "before": (1.5,) * 5},
                curve | {"measurement": "dark_level", "before": (1.1,) * 5},
            ],
            "pictures": [picture | {"side": "left"}, unchanged],
        }
    )  # fmt: skip


def kept(running: Running, source: str, found: DiagnosisResult) -> str:
    return running.store.add_result("diagnose", source, found.model_dump(mode="json"))


def test_findings_are_the_reports_first_screen(shared: Running) -> None:
    with ServiceClient(shared.url, shared.keys["read"]) as client:
        session = next(client.sessions()).id
        with pytest.raises(ServiceProblem, match=r"409: session .*: isn.t diagnosed yet"):
            client.findings(session)
        shared.store.add_result("fit", session, fitted(2.0).model_dump(mode="json"))
        newest = kept(shared, session, diagnosis())
        assert client.session(session).results["diagnose"] == newest
        found = client.findings(session)
        wanted = answers(fitted(2.0), None, diagnosis())
        assert found.answers == {question: tuple(lines) for question, lines in wanted if lines}
        assert found.verdict == "explained" and "infrared-cut filter" in str(found.answers).lower()
        # (2 - 1) / 0.1 and (1.5 - 1) / 0.1 standard deviations; the third isn't shown.
        assert ["10 σ" in one.caption for one in found.proofs] == [True, False]
        assert "5 σ" in found.proofs[1].caption
        assert [one.side for one in found.pictures] == ["left"]  # the other shows no difference
        kept(shared, session, diagnosis(0.5))
        assert "50.0 %" in str(client.findings(session).answers)


def test_findings_of_what_isnt_there(shared: Running) -> None:
    with ServiceClient(shared.url, shared.keys["read"]) as client:
        for missing in (lambda: client.findings("none"), lambda: client.recordings_findings("0" * 16)):
            with pytest.raises(ServiceProblem, match="404"):
                missing()


def test_findings_of_recordings_that_were_sent_in(running: Running) -> None:
    with ServiceClient(running.url, running.keys["admin"]) as client:
        session = client.capture("fakes", quick=True, sequences=("dark",)).id
        archive = client.fetch_session(session, running.store.root / "sent.tar")
        sent = client.send_recordings(archive).id
        kept(running, str(running.app.state.service.inbox.folder(sent)), diagnosis())
        assert client.recordings_findings(sent).verdict == "explained"
