"""Frames exchanged in a photon-transfer series are found, told and put back; series in order have none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lab.errors import NotDetermined
from lab.fit.noise.noise_fit import fit_noise
from lab.formats.importers.emva1288 import read_emva1288
from lab.formats.recording_set import RecordingSet
from lab.measure.mishaps import exchanged_frames
from tests.lab.fit.noise.synthetic_sensor import Sensor, recording_set, scores

CMOS = Path(__file__).parents[4] / "shared" / "data" / "emva1288_cmos_crop"
SENSOR = Sensor(shape=(64, 96), bend=0.02)
DARKS = [(0.001, 3), (1.0, 3), (2.0, 3)]
LADDER = [(round(float(light), 3), 2) for light in np.linspace(0.05, 1.1, 12)]  # the last saturates in no channel


def swapped(recordings: RecordingSet, one: list[str], other: list[str]) -> RecordingSet:
    """The recordings with the frames of captures exchanged, one by one."""
    frame = {c.id: c.frame for c in recordings.captures()}
    other_of = dict(zip([*one, *other], [*other, *one], strict=True))
    captures = tuple(
        c.model_copy(update={"frame": frame[other_of.get(c.id, c.id)]}) for c in recordings.manifest.captures
    )
    return recordings.under(recordings.manifest.model_copy(update={"captures": captures}))


def _of(recordings: RecordingSet, kind: str, level: int) -> list[str]:
    captures = recordings.captures(kind, "left")
    exposures = sorted({c.exposure_s for c in captures})
    return [c.id for c in captures if c.exposure_s == exposures[level]]


EXCHANGES = {
    "a frame of two levels": (("flat", 3, 1), ("flat", 7, 1)),
    "all frames of two levels": (("flat", 3, 2), ("flat", 7, 2)),
    "neighbouring levels": (("flat", 5, 1), ("flat", 6, 1)),
    "a dark and a flat": (("dark", 1, 1), ("flat", 6, 1)),
    "the dimmest and the brightest": (("flat", 0, 1), ("flat", 11, 1)),
}


@pytest.mark.parametrize("exchange", EXCHANGES)
def test_exchanged_frames_are_found_and_put_back(exchange: str) -> None:
    recordings = recording_set(SENSOR, DARKS, LADDER)
    assert exchanged_frames(recordings, "left") is None
    one, other = (_of(recordings, kind, level)[:count] for kind, level, count in EXCHANGES[exchange])
    wrong = swapped(recordings, one, other)
    found = exchanged_frames(wrong, "left")
    assert found is not None
    assert set(found.captures) == {*one, *other}
    right = {c.id: float(recordings.frame(c).mean()) for c in recordings.captures()}
    for capture in found.corrected.captures():
        # repeats of a level may be put back in another order: their means differ by noise and by nothing else
        assert float(found.corrected.frame(capture).mean()) == pytest.approx(right[capture.id], rel=1e-3)
    fit = fit_noise(wrong, "left")
    (line,) = [remark for remark in fit.remarks if "hold each other's frames" in remark]
    assert all(name in line for name in (*one, *other))
    assert max(map(abs, scores(fit, SENSOR).values())) < 3.5  # of six figures
    assert not fit.inconsistent_levels


def test_levels_in_order_have_no_exchanged_frames() -> None:
    """A lamp that drifts by 2 % from frame to frame, a response that bends by a tenth, and levels that saturate."""
    for sensor in (Sensor(shape=(64, 96), bend=0.1), Sensor(shape=(64, 96), well=5000.0, cfa="MONO")):
        assert exchanged_frames(recording_set(sensor, DARKS, LADDER), "left") is None
    rng = np.random.default_rng(7)
    recordings = recording_set(SENSOR, DARKS, LADDER)
    frames = {c.frame: recordings.frame(c) for c in recordings.captures("dark")}
    for flat in recordings.captures("flat"):
        signal = recordings.frame(flat) - SENSOR.black
        frames[flat.frame] = np.rint(SENSOR.black + signal * (1.0 + 0.02 * rng.standard_normal())).astype(np.uint16)
    drifting = RecordingSet(recordings.manifest, {k: np.minimum(v, 4095) for k, v in frames.items()})
    assert exchanged_frames(drifting, "left") is None


def test_darks_and_flats_stated_for_each_other_are_refused_with_the_remedy() -> None:
    recordings = recording_set(Sensor(shape=(32, 48)), LADDER, [(light, 2) for light, _ in LADDER])
    other = {"dark": "flat", "flat": "dark"}
    content = recordings.manifest.model_dump(mode="json")
    for capture in content["captures"]:
        capture["kind"] = other[capture["kind"]]
    exchanged = recordings.under(type(recordings.manifest).model_validate(content))
    with pytest.raises(NotDetermined, match="darks and flats may be stated for each other"):
        fit_noise(exchanged, "left")


@pytest.mark.skipif(not CMOS.is_dir(), reason="the shared recordings aren't here")
def test_exchanged_frames_of_a_real_camera_are_found() -> None:
    """Every fourth level of a CMOS camera; neighbours differ by 7 %."""
    recordings = read_emva1288(CMOS)
    assert exchanged_frames(recordings, "left") is None
    for one, other in (
        (["b_028_snap_001"], ["b_048_snap_001"]),
        (["b_048_snap_002"], ["b_052_snap_002"]),
        (["d_048_snap_001"], ["b_048_snap_001"]),
    ):
        found = exchanged_frames(swapped(recordings, one, other), "left")
        assert found is not None
        assert set(found.captures) == {*one, *other}
        assert found.corrected.manifest == recordings.manifest
