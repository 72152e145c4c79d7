"""Captures predicted by a model: against recordings of the second image former, and against frames drawn by the model
itself."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Plan
from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.capture_kinds.slanted_edge import SlantedEdgeCapture
from lab.errors import NotDetermined
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import RecordingSet
from lab.observables.dataset import Dataset
from lab.predict.replay import Replay
from sim.effects.library import effect
from sim.spectrum import FloatArray


@pytest.fixture(scope="module")
def recordings() -> RecordingSet:
    return recordings_of(ConcealedCamera(11, cfa="RGGB", rows=96, cols=128), Plan())


@pytest.fixture(scope="module")
def replay(recordings: RecordingSet) -> Replay:
    dataset = Dataset(recordings, "left", camera_model(recordings, "left", None, maker_curves=True))
    return Replay(recordings, "left", dataset.camera)


def test_edges_come_out_where_they_were_recorded(replay: Replay, recordings: RecordingSet) -> None:
    """Residuals within the noise (photon noise, PRNU) but for a tenth: an edge that were off by 0.1 px alone would add
    a third."""
    camera = replay.camera
    for capture in recordings.captures(SlantedEdgeCapture)[:3]:
        assert capture.region is not None
        row0, col0, row1, col1 = capture.region
        inside = np.s_[row0 + 6 : row1 - 6, col0 + 6 : col1 - 6]
        mean = replay.expected(capture)[inside]
        signal = np.maximum(mean - camera.black_level_dn, 0.0)
        gain = camera.conversion_gain_dn_per_e
        noise = np.sqrt(gain * signal + (gain * camera.read_noise_e) ** 2 + (0.01 * signal) ** 2)
        left = (recordings.frame(capture)[inside] - mean) / noise
        assert left.std() < 1.1
        assert abs(left.mean()) < 0.1


def test_uniform_light_has_the_level_that_the_maker_promises(replay: Replay, recordings: RecordingSet) -> None:
    """The former's curves differ from the maker's by a scale and a tilt of some per cent."""
    black = replay.camera.black_level_dn
    for kind in ("flat", "narrowband"):
        capture = max(recordings.captures(kind), key=lambda c: float(recordings.frame(c).mean()))  # type: ignore[call-overload]
        recorded = float(recordings.frame(capture).mean()) - black
        assert float(replay.expected(capture).mean()) - black == pytest.approx(recorded, rel=0.15)


def test_drawn_frames_vary_about_the_expected_one(replay: Replay) -> None:
    """The mean of a frame of n pixels within 5 sigma: photon noise and PRNU over sqrt(n), and what rounding leaves.
    Repeats are drawn of the first one's scene: another's edge lies some hundredths of a pixel beside it."""
    again = replay.drawn(np.random.default_rng(3))
    camera = replay.camera
    of_scene: dict[object, FloatArray] = {}
    for capture in replay.captures:
        scene = replay._scene_key(capture, ())
        if scene not in of_scene:
            of_scene[scene] = replay.expected(capture)
        mean = of_scene[scene]
        signal = max(float(mean.mean()) - camera.black_level_dn, 1.0) / camera.conversion_gain_dn_per_e
        sigma_e = np.sqrt(
            signal + camera.read_noise_e**2 + camera.dsnu_e**2 + (camera.prnu_percent / 100 * signal) ** 2
        )
        sigma = camera.conversion_gain_dn_per_e * sigma_e / np.sqrt(mean.size)
        assert float(again.frame(capture).mean()) == pytest.approx(float(mean.mean()), abs=5.0 * sigma + 0.05)


def test_effects_act_on_replayed_frames(replay: Replay, recordings: RecordingSet) -> None:
    """A filter's edge at 600 nm takes all light of 650 nm and none of 500 nm: 13 and 20 widths away."""
    cut = effect("infrared_cut_filter")(cut_wavelength_nm=600.0, width_nm=4.0)
    camera = replay.camera
    for capture in recordings.captures(NarrowbandCapture):
        if 520.0 < capture.wavelength_nm < 650.0:
            continue
        dark = (
            camera.black_level_dn + camera.conversion_gain_dn_per_e * camera.dark_current_e_per_s * capture.exposure_s
        )
        with_it, without = (float(replay.expected(capture, e).mean()) - dark for e in ((cut,), ()))
        if capture.wavelength_nm >= 650.0:
            assert with_it < 0.02 * without
        else:
            assert with_it == pytest.approx(without, rel=0.01)


def test_what_a_manifest_does_not_tell_is_refused(replay: Replay, recordings: RecordingSet) -> None:
    white = recordings.captures("white")[0]
    assert white not in replay.captures
    with pytest.raises(NotDetermined, match="doesn't tell what stood before the camera"):
        replay.expected(white)
