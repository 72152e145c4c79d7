"""Whole frames behind a traced lens, held to the plain chain and to closed forms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sim import frame as sim_frame
from sim.camera import CameraModel, Lens
from sim.effects import library
from sim.frame import Exposure, expected_electrons
from sim.optics.imaging import MeasuredPsf, TracedLens
from sim.optics.table import LensTable
from sim.scene import (
    Darkness,
    EdgeRegion,
    KnifeEdge,
    ReflectanceChart,
    Scene,
    ScreenPattern,
    SpectralImage,
    UniformField,
    Warp,
)
from sim.sensor import mosaic
from sim.spectrum import Spectrum
from sim.uniform import electron_rate


def _traced(camera: CameraModel, table: LensTable) -> CameraModel:
    lens = Lens(f_number=4.0, focal_length_mm=8.0, transmittance=0.9, imaging=TracedLens(table=table))
    return camera.model_copy(update={"lens": lens, "dark_current_e_per_s": 0.0})


def _scenes(lamp: Spectrum) -> list[Scene]:
    pattern = np.random.default_rng(0).integers(0, 2, (20, 24)).astype(np.uint8)
    wavelength_nm = tuple(np.arange(400.0, 701.0, 20.0).tolist())
    cube = np.random.default_rng(1).random((72, 96, 16)) * lamp.at(wavelength_nm)
    return [
        UniformField(lamp),
        KnifeEdge((EdgeRegion((10, 10, 60, 80), 5.0),), lamp.scale(0.02), lamp),
        ReflectanceChart(((8.0, 10.0), (9.0, 88.0), (64.0, 86.0), (62.0, 8.0)), lamp),
        ScreenPattern(pattern, Warp.from_corners(24, 20, [(5, 8), (6, 90), (66, 88), (64, 6)]), lamp.scale(0.02), lamp),
        SpectralImage(wavelength_nm, cube),
    ]


@pytest.fixture
def same_everywhere(synthetic_lens: Any) -> LensTable:
    """A lens of one round point spread function, without distortion, with the fall-off of cos^4."""
    table = synthetic_lens(k=0.0, colour=0.0).table()
    axis = np.repeat(table.psf[:, :1], len(table.field_deg), axis=1)
    r = 8.0 * np.tan(np.deg2rad(table.field_deg[:, 1]))
    fall = np.broadcast_to(1.0 / (1.0 + (r / 8.0) ** 2) ** 2, table.relative_illumination.shape)
    return replace(
        table,
        psf=axis / axis.sum(axis=(2, 3), keepdims=True),
        encircled_share=np.ones(fall.shape),
        relative_illumination=fall,
        window_um=np.zeros(table.window_um.shape),
        chief_mm=np.stack([0.0 * r, r], axis=1),
        content_hash="the same everywhere",
    )


def _measured(table: LensTable) -> MeasuredPsf:
    """The same point spread function for all the frame."""
    psf = table.psf[:1, 0] / table.psf[0, 0].sum()
    rows = tuple(tuple(tuple(row) for row in plane) for plane in psf.tolist())
    return MeasuredPsf(wavelength_nm=(550.0,), psf=rows, sample_pitch_um=table.sample_pitch_um)


@pytest.mark.parametrize("index", range(5))
@pytest.mark.parametrize("with_effects", [False, True])
def test_a_lens_that_is_the_same_everywhere_is_the_plain_chain(
    colour_camera: CameraModel, lamp: Spectrum, same_everywhere: LensTable, index: int, with_effects: bool
) -> None:
    """Two ways to one frame: scattered as a table, and by Fourier transforms with the table's function as a measured
    one. They differ by the sampling of both (carrying, edges of the window, wrap of the frame's ends): 4e-3 of the
    mean.
    """
    effects = (library.effects()["optical_low_pass_filter"](displacement_x_um=2.0, displacement_y_um=1.0),)
    effects = effects if with_effects else ()
    camera = _traced(colour_camera, same_everywhere)
    plain = camera.model_copy(
        update={"lens": Lens(f_number=4.0, focal_length_mm=8.0, transmittance=0.9, imaging=_measured(same_everywhere))}
    )
    exposure = Exposure(_scenes(lamp)[index], 0.02)
    # On 4 samples a pixel drawing itself is out of the way (an aligned cube is folded exactly in the plain chain).
    got, wanted = (expected_electrons(c, exposure, effects, oversample=4) for c in (camera, plain))
    inside = np.s_[6:-6, 6:-6]
    assert np.sqrt(np.mean((got - wanted)[inside] ** 2)) < 4e-3 * wanted[inside].mean()
    assert got[inside].sum() == pytest.approx(wanted[inside].sum(), rel=1e-3)


def test_an_even_field_is_the_tables_illumination(
    colour_camera: CameraModel, lamp: Spectrum, synthetic_lens: Any
) -> None:
    lens = synthetic_lens(corner_um=200.0)
    camera = _traced(colour_camera, lens.table())
    frame = expected_electrons(camera, Exposure(UniformField(lamp), 0.1))
    rate = electron_rate(camera, "G", lamp) * 0.1
    middle = mosaic.planes(frame, camera.cfa)["G1"][18, 24]
    # The table's wavelengths are 10 nm apart, and held beyond 400..720 nm; the axis is a pixel away.
    assert middle == pytest.approx(rate, rel=1e-3)
    corner = frame[0, 0] / rate
    h = np.hypot(35.5, 47.5) * 3.0 / 200.0
    assert corner == pytest.approx(1 - 0.35 * h**2, abs=0.02)  # the ideal radius is 2 % longer


def test_distortion_moves_light_unless_the_scene_is_placed_in_the_image(
    colour_camera: CameraModel, lamp: Spectrum, synthetic_lens: Any
) -> None:
    """A bright spot at 45 px from the axis: barrel distortion of 4 % there draws it in by 1.8 px."""
    lens = synthetic_lens(corner_um=135.0, k=-0.04, colour=0.0)
    camera = _traced(colour_camera.model_copy(update={"cfa": "MONO",
                                                      "quantum_efficiency": {"Y": colour_camera.quantum_efficiency["G"]}}),  # noqa: E501
                     lens.table())  # fmt: skip
    spot = np.zeros((9, 9), np.uint8)
    spot[4, 4] = 1
    col = 47.5 + 38.0
    warp = Warp.from_corners(9, 9, [(35.5 - 9, col - 9), (35.5 - 9, col + 9), (35.5 + 9, col + 9), (35.5 + 9, col - 9)])
    scene = ScreenPattern(spot, warp, lamp.scale(0.0), lamp)
    at = {}
    for placed in ("ideal", "image"):
        frame = expected_electrons(camera, Exposure(scene, 0.1, placed=placed))
        at[placed] = float(np.sum(frame * np.arange(96)) / frame.sum())
    h = 38.0 * 3.0 / 135.0
    window_px = 0.9 * h / 3.0
    coma_px = (0.3 * 3.0 * h - 0.9 * h) / 3.0  # the blobs' centroid, from the window's centre
    # A square's light isn't all at its centre, and more comes from nearer the axis: 0.05 px.
    assert at["ideal"] == pytest.approx(col - 0.04 * h**2 * 38.0 + window_px + coma_px, abs=0.06)
    assert at["image"] == pytest.approx(col + coma_px, abs=0.06)


@pytest.mark.parametrize("index", range(5))
def test_every_scene_gives_frames_and_statistics(
    colour_camera: CameraModel, lamp: Spectrum, synthetic_lens: Any, index: int
) -> None:
    camera = _traced(colour_camera, synthetic_lens().table())
    exposure = Exposure(_scenes(lamp)[index], 0.02, magnification=0.1)
    mean, variance = sim_frame.moments(camera, exposure)
    frame = sim_frame.sample(camera, exposure, np.random.default_rng(0)).astype(float)
    assert np.all(np.isfinite(mean)) and np.all(variance > 0)
    chi2 = np.mean((frame - mean) ** 2 / variance)
    assert chi2 == pytest.approx(1.0, abs=6.0 * np.sqrt(2.0 / frame.size))


def test_darkness_and_moving_effects(colour_camera: CameraModel, lamp: Spectrum, synthetic_lens: Any) -> None:
    camera = _traced(colour_camera, synthetic_lens().table())
    assert not expected_electrons(camera, Exposure(Darkness(), 1.0)).any()
    mover = library.effects()["lateral_chromatic_aberration"]
    effect = mover(**{next(iter(mover.quantities())): 1.0})
    with pytest.raises(ValueError, match="leave distortion and lateral colour to the prescription"):
        expected_electrons(camera, Exposure(UniformField(lamp), 1.0), (effect,))


def test_a_lens_has_to_be_the_tables(synthetic_lens: Any) -> None:
    with pytest.raises(ValueError, match=r"f-number is 2.8, beyond the limit of 2 % from the traced 4"):
        Lens(f_number=2.8, focal_length_mm=8.0, imaging=TracedLens(table=synthetic_lens().table()))


def test_light_that_no_channel_sees_is_named(colour_camera: CameraModel, lamp: Spectrum) -> None:
    metres = Spectrum.of([0.4, 0.55, 0.7], [1.0, 1.0, 1.0])
    with pytest.raises(ValueError, match=r"light lies at 0.4 to 0.7 nm, outside the limits .* give wavelengths in nm"):
        expected_electrons(colour_camera, Exposure(UniformField(metres), 0.1))
    infrared = SpectralImage((900.0, 950.0), np.ones((72, 96, 2)))
    with pytest.raises(ValueError, match="outside the limits"):
        expected_electrons(colour_camera, Exposure(infrared, 0.1))
    dark = lamp.scale(0.0)
    assert sim_frame.predict_frame(colour_camera, Exposure(UniformField(dark), 0.1)).max() < 250.0


def test_an_exposure_that_saturates_everything_is_named(colour_camera: CameraModel, lamp: Spectrum) -> None:
    for exposure_s, gain_db, limit in ((20.0, 0.0, "1.05e\\+04"), (20.0, 20.0, "1101")):
        exposure = Exposure(UniformField(lamp), exposure_s, gain_db=gain_db)
        electrons = expected_electrons(colour_camera, exposure)
        with pytest.raises(ValueError, match=f"exposure 20 s saturates all pixels.*limit is {limit} e .*; expose"):
            sim_frame.check_not_saturated(colour_camera, exposure, electrons)
    fine = Exposure(UniformField(lamp), 0.02)
    sim_frame.check_not_saturated(colour_camera, fine, expected_electrons(colour_camera, fine))


def test_impossible_lenses_are_named() -> None:
    with pytest.raises(ValueError, match=r"focal length: -8.0 mm is below the lower limit 0.1 mm; give a value"):
        Lens(f_number=4.0, focal_length_mm=-8.0)
    with pytest.raises(ValueError, match=r"sum|1"):
        MeasuredPsf(wavelength_nm=(550.0,), psf=(((1.0, 1.0), (1.0, 1.0)),), sample_pitch_um=1.0)
