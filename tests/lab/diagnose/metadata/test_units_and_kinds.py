"""Exposures in other units than seconds, and a mono sensor that is stated with a mosaic, are told in one line."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lab.diagnose.metadata import misstatements
from lab.diagnose.metadata.frames import misstated_exposure_unit
from lab.diagnose.metadata.lights import misstated_mosaic
from lab.fit.noise.noise_fit import fit_noise
from lab.formats.importers.emva1288 import read_emva1288
from lab.formats.recording_set import RecordingSet, inspect
from tests.lab.diagnose.metadata.lies import restated
from tests.lab.diagnose.on_blocks import former
from tests.lab.fit.noise.synthetic_sensor import Sensor, recording_set

CMOS = Path(__file__).resolve().parents[5] / "shared" / "data" / "emva1288_cmos_crop"
DARKS, LADDER = [(0.001, 2), (2.0, 2)], [(0.1, 2), (0.3, 2), (0.5, 2), (0.7, 2), (0.9, 2)]


def _changed(recordings: RecordingSet, **of: Any) -> RecordingSet:
    """The recordings with keys of each capture from functions of its number and itself."""
    captures = tuple(
        c.model_copy(update={key: value(k, c) for key, value in of.items()})
        for k, c in enumerate(recordings.manifest.captures)
    )
    return recordings.under(recordings.manifest.model_copy(update={"captures": captures}))


def test_microseconds_given_as_seconds_are_told() -> None:
    """2 s are 2e6 us, which no plan allows; the corrected exposures are those that were meant."""
    recordings = recording_set(Sensor(shape=(32, 48), cfa="MONO"), DARKS, LADDER)
    assert misstated_exposure_unit(recordings, "left") is None
    wrong = _changed(recordings, exposure_s=lambda _, c: 1e6 * c.exposure_s)
    found = misstated_exposure_unit(wrong, "left")
    assert found is not None
    assert "aren't in seconds: the longest is 2e+06 s, above 3600 s. They are read as microseconds" in found.check
    for right, one in zip(recordings.captures(), found.corrected.captures(), strict=True):
        assert one.exposure_s == pytest.approx(right.exposure_s)
    (warning,) = [w for w in inspect(wrong)[1] if "not in milliseconds or microseconds" in w]
    assert "12 captures" in warning  # darks of a millisecond are 1000 us


def test_captures_without_a_stated_exposure_say_nothing_of_its_unit() -> None:
    """Imported pictures of boards may state none; the others' exposures are still told and corrected."""
    recordings = recording_set(Sensor(shape=(32, 48), cfa="MONO"), DARKS, LADDER)
    assert misstated_exposure_unit(_changed(recordings, exposure_s=lambda _, c: None), "left") is None
    found = misstated_exposure_unit(
        _changed(recordings, exposure_s=lambda k, c: 1e6 * c.exposure_s if k else None), "left"
    )
    assert found is not None
    for k, (right, one) in enumerate(zip(recordings.captures(), found.corrected.captures(), strict=True)):
        assert one.exposure_s == (pytest.approx(right.exposure_s) if k else None)


def test_times_of_copying_say_nothing_of_the_unit() -> None:
    """A ladder up to seconds whose files were written within a tenth of a second."""
    begin = datetime(2026, 3, 2, tzinfo=UTC)
    recordings = _changed(
        recording_set(Sensor(shape=(32, 48), cfa="MONO"), DARKS, LADDER),
        time=lambda k, _: begin + timedelta(milliseconds=k),
    )
    assert misstated_exposure_unit(recordings, "left") is None


def test_a_mono_sensor_stated_with_a_mosaic_is_told() -> None:
    recordings = former(5, kinds=("dark", "flat", "narrowband"))
    assert misstated_mosaic(recordings, "left") is None
    wrong = restated(recordings, cfa="RGGB", quantum_efficiency=None)
    corrected, (found,) = misstatements(wrong, "left")
    assert "but cfa = RGGB is stated: correct cfa to MONO" in found.check
    assert corrected.camera("left").cfa == "MONO"
    assert any("correct cfa to MONO" in remark for remark in fit_noise(wrong, "left").remarks)


def test_colours_that_differ_are_a_mosaic() -> None:
    """Also those that analogue gains make alike under one lamp: their variances differ."""
    assert misstated_mosaic(former(5, cfa="GRBG", kinds=("dark", "flat", "narrowband")), "left") is None
    sensor = Sensor(shape=(64, 96))
    recordings = recording_set(sensor, DARKS, LADDER)
    frames = {c.frame: recordings.frame(c) for c in recordings.captures("dark")}
    for flat in recordings.captures("flat"):
        frame = (recordings.frame(flat) - sensor.black).astype(float)
        for (row, col), share in (((0, 0), 0.7), ((1, 1), 0.5)):
            frame[row::2, col::2] /= share
        frames[flat.frame] = np.clip(np.rint(frame + sensor.black), 0, 4095).astype(np.uint16)
    balanced = RecordingSet(recordings.manifest, frames)
    assert misstated_mosaic(balanced, "left") is None


@pytest.mark.skipif(not CMOS.is_dir(), reason="the shared recordings aren't here")
def test_a_real_mono_camera_stated_with_a_mosaic_is_told() -> None:
    found = misstated_mosaic(restated(read_emva1288(CMOS), cfa="RGGB"), "left")
    assert found is not None
    assert "answer 1 light alike within 0.0" in found.check
