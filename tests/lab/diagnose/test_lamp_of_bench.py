"""What the bench conceals in its lamp is named over the wire: ageing and warm-up, each rendered finer than the law that
is fitted; a healthy lamp stays silent, in two spectra of the light source, too."""

from __future__ import annotations

import contextlib
import math
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
from lab.formats.recording_set import RecordingSet, read, write
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


#: Flats again after the wavelengths, so that the session lasts for a minute at a share of real time.
LONG = CapturePlan((*PLAN.sequences[:3], FlatSequence(levels=(0.1, 0.4, 0.7, 0.87), frames=2), *PLAN.sequences[3:]))


def _recordings(folder: Path, *concealed: str, plan: CapturePlan = PLAN, real_time_factor: float = 0.0) -> RecordingSet:
    with contextlib.ExitStack() as running:
        there = LampStation(
            folder,
            running,
            concealed=parse(concealed),
            shape=(480, 640),
            monochromator=True,
            real_time_factor=real_time_factor,
        )
        store = Store(folder / "data")
        running.callback(store.close)
        session = CaptureSession.start(store, there.station, plan)
        assert session.run().state == "finished"
        write(store.recording_set(session.id), folder / "set")
    return read(folder / "set")


def test_a_healthy_lamp_stays_silent(tmp_path: Path) -> None:
    found = diagnose(_recordings(tmp_path))
    assert (found.verdict, found.effects) == ("no_mismatch", ())


def test_an_aged_lamp_is_named_with_its_size(tmp_path: Path) -> None:
    found = diagnose(_recordings(tmp_path, "both:lamp_ageing:reddening_percent=12"))
    (named,) = found.effects
    assert (named.name, named.law) == ("lamp_ageing", "exact")
    size = named.parameters["reddening_percent"]
    assert size.std is not None and abs(size.value - 12.0) < 3.0 * size.std
    assert found.held_out is not None
    # what is held out is explained: chi2 of n numbers to 4 sqrt(2 n), the bend of the lamp's change within the law's
    # tolerance
    assert found.held_out.chi2_after < found.held_out.n + 4.0 * (2.0 * found.held_out.n) ** 0.5
    assert found.held_out.chi2_before > 10.0 * found.held_out.n


def test_a_lamp_that_warms_up_is_named_with_what_it_changed_by(tmp_path: Path) -> None:
    spec = "both:source_drift:drift_percent_per_min=6,settling_min=1"
    recordings = _recordings(tmp_path, spec, plan=LONG, real_time_factor=0.3)
    found = diagnose(recordings)
    (named,) = found.effects
    assert named.name == "source_drift"
    times = [one.time for one in recordings.captures() if one.time is not None]
    lasted_min = (max(times) - min(times)).total_seconds() / 60.0
    drift = named.parameters["drift_percent_per_min"]
    settling = named.parameters.get("settling_min")

    def change(per_min: float, settling_min: float) -> float:
        return per_min * settling_min * (1.0 - math.exp(-lasted_min / settling_min))

    told = change(drift.value, 1e4 if settling is None else settling.value)
    # The change over the session, whether or not it tells how the drift ends: to 3 standard deviations of the slope,
    # and the 4.5 % by which the bench's second stage departs.
    assert drift.std is not None
    assert told == pytest.approx(change(6.0, 1.0), abs=3.0 * drift.std * lasted_min + 0.045 * change(6.0, 1.0))
