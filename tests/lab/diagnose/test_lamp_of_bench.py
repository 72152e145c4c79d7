"""What the bench conceals in its lamp is named over the wire: ageing and warm-up, each rendered finer than the law that
is fitted; a healthy lamp stays silent, in two spectra of the light source, too."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest

from lab.capture.plan import CapturePlan
from lab.capture.session import CaptureSession
from lab.capture.store import Store
from lab.capture_kinds.chart import ChartSequence
from lab.capture_kinds.dark import DarkSequence
from lab.capture_kinds.flat import FlatSequence
from lab.capture_kinds.narrowband import NarrowbandSequence
from lab.diagnose import diagnose
from lab.formats.results import DiagnosisResult
from mocks.conceal import parse
from tests.lab.capture.test_lamp_on_bench import LampStation

pytestmark = pytest.mark.extra  # a session of the bench and a diagnosis of one law each

PLAN = CapturePlan(
    (
        DarkSequence(exposures_s=(0.0005, 0.5, 2.0), frames=4),
        FlatSequence(levels=(0.1, 0.25, 0.4, 0.55, 0.7, 0.87), frames=4, lamp_level=1.0, colour_temperature_k=3000.0),
        NarrowbandSequence(step_nm=20.0, passes=2),
        ChartSequence(frames=2),
        ChartSequence(frames=2, lamp_level=1.0, colour_temperature_k=6500.0),
    )
)


def _diagnosed(folder: Path, *concealed: str) -> DiagnosisResult:
    with contextlib.ExitStack() as running:
        there = LampStation(folder, running, concealed=parse(concealed), shape=(480, 640), monochromator=True)
        store = Store(folder / "data")
        session = CaptureSession.start(store, there.station, PLAN)
        assert session.run().state == "finished"
        found = diagnose(store.recording_set(session.id))
        store.close()
    return found


def test_a_healthy_lamp_stays_silent(tmp_path: Path) -> None:
    found = _diagnosed(tmp_path)
    assert (found.verdict, found.effects) == ("no_mismatch", ())


def test_an_aged_lamp_is_named_with_its_size(tmp_path: Path) -> None:
    found = _diagnosed(tmp_path, "both:lamp_ageing:reddening_percent=12")
    (named,) = found.effects
    assert (named.name, named.law) == ("lamp_ageing", "exact")
    size = named.parameters["reddening_percent"]
    assert size.std is not None and abs(size.value - 12.0) < 3.0 * size.std
    assert found.held_out is not None
    # what is held out is explained: chi2 of n numbers to 4 sqrt(2 n), the bend of the lamp's change within the law's
    # tolerance
    assert found.held_out.chi2_after < found.held_out.n + 4.0 * (2.0 * found.held_out.n) ** 0.5
    assert found.held_out.chi2_before > 10.0 * found.held_out.n
