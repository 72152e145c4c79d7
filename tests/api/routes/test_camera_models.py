"""Camera models of fits and diagnoses, and comparisons, over the network."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import pytest

import lab.fit
from api.client import ServiceClient, ServiceProblem
from lab.calibration import camera_models
from lab.fit.compare import compare
from lab.formats.camera_file import CameraFile, default_camera, read_camera
from lab.formats.results import FitResult
from sim.camera import CameraModel
from sim.effects.library import effect
from sim.parameters import declared
from tests.api.conftest import Running, until_state
from tests.lab.calibration.test_life import fitted


@pytest.fixture
def session(shared: Running) -> str:
    """The finished session."""
    with shared.client("read") as client:
        found: str = client.get("/api/v1/sessions").json()[-1]["id"]
        return found


def kept(running: Running, session: str, fit: FitResult) -> str:
    """A fit of a session in the registry; its id."""
    return running.store.add_result("fit", session, fit.model_dump(mode="json"))


# --- camera models -----------------------------------------------------------------------------------------------------


def test_a_fit_over_the_network_keeps_its_cameras(
    running: Running, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(lab.fit, "fit_recording_set", lambda *_: fitted(2.0))
    with ServiceClient(running.url, running.keys["admin"]) as client:
        session = client.capture("fakes", quick=True, sequences=("dark",), name="with models")
        client.fit(session.id)
        (listed,) = client.camera_models()
        assert listed.kind == "fitted" and listed.session_id == session.id and listed.sides == ("left", "right")
        assert not listed.cameras
        model = client.camera_model(listed.id)
        left = model.cameras["left"]
        noise = next(one for one in left.parameters if one.name == "read_noise_e")
        assert (noise.value, noise.std) == (2.0, fitted(2.0).cameras["left"].noise.read_noise_e_std)  # type: ignore[union-attr]
        for one in left.parameters:
            if not one.name.startswith("lens."):
                assert one.unit == declared(CameraModel)[one.name].unit
        archive = client.fetch_camera_model(listed.id, tmp_path / "cameras.zip")
        with zipfile.ZipFile(archive) as packed:
            packed.extractall(tmp_path / "cameras")
        assert read_camera(tmp_path / "cameras" / "left.toml").camera.read_noise_e == 2.0
        # The session goes, its results stay.
        client.delete_session(session.id)
        assert client.camera_model(listed.id).cameras["right"] == model.cameras["right"]


def test_a_diagnosed_camera_has_the_effects_that_were_named(shared: Running, session: str) -> None:
    result = shared.store.add_result("diagnose", session, {})
    acting = CameraFile("found", default_camera().camera, (effect("veiling_glare")(share_percent=1.5),))
    camera_models.keep(shared.store, result, {"left": acting})
    with ServiceClient(shared.url, shared.keys["read"]) as client:
        found = client.camera_model(result)
        assert found.kind == "improved" and found.sides == ("left",)
        (named,) = found.cameras["left"].effects
        told = {one.name: (one.value, one.unit) for one in named.parameters}
        assert named.name == "veiling_glare" and told["share_percent"] == (1.5, "%")


def test_what_was_kept_without_files_says_so(shared: Running, session: str) -> None:
    old = kept(shared, session, fitted(2.0))
    with shared.client("read") as client:
        assert client.get(f"/api/v1/camera-models/{old}").json()["sides"] == []
        assert client.get(f"/api/v1/camera-models/{old}/archive.zip").status_code == 409
        missing = client.get("/api/v1/camera-models/0123456789abcdef")
        assert missing.status_code == 404 and "lists them" in missing.json()["detail"]
        page = client.get("/api/v1/camera-models", params={"limit": 1})
        assert "next" in page.headers["link"] and int(page.headers["x-total-count"]) >= 1


# --- comparisons -------------------------------------------------------------------------------------------------------


def test_two_calibrations_are_compared_as_on_the_command_line(shared: Running, session: str) -> None:
    a, b = kept(shared, session, fitted(2.0)), kept(shared, session, fitted(2.4))
    wanted = compare(fitted(2.0), fitted(2.4))
    with ServiceClient(shared.url, shared.keys["read"]) as client:
        found = client.compare(a, b, ["noise read_noise_e>5%", "right:noise read_noise_e>50%"])
        assert found.comparison.changes == wanted.changes and found.comparison.threshold_sigma == wanted.threshold_sigma
        assert (found.comparison.a, found.comparison.b) == (a, b)
        assert found.failing == ("left noise read_noise_e", "right noise read_noise_e")
        # A session stands for its newest fit.
        assert client.compare(a, session).comparison.changes == found.comparison.changes
        assert client.compare(a, a).comparison.changed is False
        with pytest.raises(ServiceProblem, match="fail_on 'magic': no such figure in both"):
            client.compare(a, b, ["magic"])
        with pytest.raises(ServiceProblem, match="b: '0123456789abcdef' has no fit") as missing:
            client.compare(a, "0123456789abcdef")
        assert missing.value.status == 404
        diagnosis = shared.store.add_result("diagnose", session, {})
        with pytest.raises(ServiceProblem, match="is a result of the kind diagnose"):
            client.compare(diagnosis, b)


def test_the_comparison_has_a_page(shared: Running, session: str) -> None:
    a, b = kept(shared, session, fitted(2.0)), kept(shared, session, fitted(2.4))
    with shared.client("read") as client:
        page = client.get("/api/v1/comparisons/page", params={"a": a, "b": b})
        assert page.status_code == 200 and "2 of " in page.text and a in page.text
        assert "default-src 'none'" in page.headers["content-security-policy"]
        assert client.get("/api/v1/comparisons/page", params={"a": a}).status_code == 422


def test_recordings_stand_for_their_newest_fit(running: Running) -> None:
    with running.client("admin") as client:
        asked = {"station": "fakes", "quick": True, "sequences": ["dark"]}
        started = client.post("/api/v1/sessions", json=asked).json()["id"]
        until_state(client, started, "finished")
        content = client.get(f"/api/v1/sessions/{started}/archive.zip").content
        assert zipfile.is_zipfile(io.BytesIO(content))
        sent = client.post("/api/v1/recordings", content=content, headers={"Content-Type": "application/zip"}).json()
        folder = str(running.app.state.service.inbox.folder(sent["id"]))
        running.store.add_result("fit", folder, fitted(2.0).model_dump(mode="json"))
        here = kept(running, started, fitted(2.4))
        found = client.get("/api/v1/comparisons", params={"a": sent["id"], "b": here}).json()
        assert {one["name"] for one in found["comparison"]["changes"] if one["changed"]} == {"noise read_noise_e"}
