"""The steps of an exposure one by one, as a bench that keeps a scene's light takes them."""

from __future__ import annotations

import numpy as np

from sim.camera import CameraModel
from sim.effects.ambient_light import AmbientLight
from sim.effects.exposure_offset import ExposureOffset
from sim.effects.image_lag import ImageLag
from sim.effects.optical_low_pass_filter import OpticalLowPassFilter
from sim.effects.source_drift import SourceDrift
from sim.effects.stereo_gain_mismatch import StereoGainMismatch
from sim.effects.wavelength_offset import WavelengthOffset
from sim.frame import (
    EMPTY,
    Exposure,
    KeptTransfers,
    collect_electrons,
    expect_sequence,
    expected_electrons,
    pair_gain_factor,
    read_electrons,
    scene_light,
)
from sim.scene import Darkness, ScreenPattern, UniformField, Warp
from sim.spectrum import Spectrum
from sim.uniform import radiance_at_lens


def test_one_light_serves_many_exposures(colour_camera: CameraModel, lamp: Spectrum) -> None:
    effects = (
        SourceDrift(drift_percent_per_min=3.0),
        AmbientLight(rate_e_per_s=500.0),
        ExposureOffset(offset_us=800.0),
    )
    light = scene_light(colour_camera, UniformField(lamp), effects)
    for exposure_s, elapsed_s in ((0.01, 0.0), (0.02, 120.0)):
        exposure = Exposure(UniformField(lamp), exposure_s, elapsed_s=elapsed_s)
        assert np.array_equal(
            collect_electrons(light, colour_camera, exposure, effects),
            expected_electrons(colour_camera, exposure, effects),
        )


def test_ambient_light_stays_when_the_source_changes(colour_camera: CameraModel, lamp: Spectrum) -> None:
    effects = (AmbientLight(rate_e_per_s=500.0),)
    light = scene_light(colour_camera, UniformField(lamp), effects)
    exposure = Exposure(UniformField(lamp), 0.01)
    full, half, none = (
        collect_electrons(light, colour_camera, exposure, effects, source=source) for source in (1.0, 0.5, 0.0)
    )
    assert np.allclose(half - none, 0.5 * (full - none))
    assert np.allclose(none, 5.0 + colour_camera.dark_current_e_per_s * 0.01)


def test_kept_transfers_give_the_same_frames(colour_camera: CameraModel, lamp: Spectrum) -> None:
    rng = np.random.default_rng(2)
    warp = Warp.from_corners(30, 30, [(2, 4), (3, 92), (70, 90), (68, 3)])
    effects = (OpticalLowPassFilter(displacement_x_um=2.0, displacement_y_um=1.0),)
    kept = KeptTransfers()
    for light in (lamp, lamp, lamp.scale(2.0)):
        pattern = rng.integers(0, 2, (30, 30)).astype(np.uint8)
        scene = ScreenPattern(pattern, warp, light.scale(0.01), light)
        plain = scene_light(colour_camera, scene, effects).scene
        assert np.allclose(
            scene_light(colour_camera, scene, effects, transfers=kept).scene, plain, atol=1e-5 * plain.max()
        )


def test_transfers_are_made_once_a_light() -> None:
    kept, made = KeptTransfers(most=2), []

    def make() -> list[np.ndarray[tuple[int, int], np.dtype[np.complex64]]]:
        made.append(1)
        return [np.ones((2, 2), np.complex64)]

    for key in ("a", "a", "b", "a", "c", "b"):
        assert np.all(kept.get(key, make)[0] == 1.0)
    assert len(made) == 4  # b fell out when c came


def test_read_and_lagging_charge_add_up_to_the_charge_held(colour_camera: CameraModel, lamp: Spectrum) -> None:
    effects = (ImageLag(lag_percent=4.0),)
    exposures = [Exposure(UniformField(lamp), 0.01), Exposure(Darkness(), 0.01)]
    kept = EMPTY
    for exposure, together in zip(exposures, expect_sequence(colour_camera, exposures, effects), strict=True):
        new, before = expected_electrons(colour_camera, exposure, effects), kept
        read, kept = read_electrons(new, colour_camera, exposure, effects, before)
        assert np.allclose(read, together)
        assert np.allclose(read + kept.lag_e, new + before.lag_e)


def test_effects_of_the_rig_act_outside_a_frame(colour_camera: CameraModel, lamp: Spectrum) -> None:
    there = radiance_at_lens(colour_camera, lamp, (WavelengthOffset(offset_nm=5.0),), "flat")
    wavelength_nm = np.arange(450.0, 650.0, 5.0)
    assert np.allclose(there.at(wavelength_nm), lamp.at(wavelength_nm - 5.0))
    assert pair_gain_factor(colour_camera, (StereoGainMismatch(gain_percent=4.0), WavelengthOffset())) == 1.04
