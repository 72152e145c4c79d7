"""Electrons and codes of a pixel in uniform light against closed forms."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import pytest

from sim.camera import CameraModel, Lens
from sim.detection import responsivity
from sim.effects import library
from sim.effects.ambient_light import AmbientLight
from sim.effects.base import Effect
from sim.effects.brighter_fatter import BrighterFatter
from sim.effects.charge_transfer_inefficiency import ChargeTransferInefficiency
from sim.effects.crosstalk import Crosstalk
from sim.effects.exposure_offset import ExposureOffset
from sim.frame import Exposure, predict_frame
from sim.optics.illumination import irradiance_factor
from sim.point import edge_profile, kernel
from sim.scene import (
    Darkness,
    KnifeEdge,
    UniformField,
)
from sim.sensor import mosaic
from sim.spectrum import FloatArray, Spectrum, photons_from_energy
from sim.stages import Light, charge_of
from sim.uniform import LEAST_UNMIXED, FieldPoints, Uniform, electron_rate
from tests.sim.local_effects import AngleCut, Local, ReadOutRamp


def test_a_laser_line_gives_the_closed_form(mono_camera: CameraModel) -> None:
    """A line of 1 pm at 550 nm with radiance 0.01 W sr^-1 m^-2. QE's peak has its kink there: 5e-7."""
    line = Spectrum.of([549.999, 550.0, 550.001], [0.0, 10.0, 0.0])
    qe = float(mono_camera.quantum_efficiency["Y"].at(550.0))
    photons = float(photons_from_energy(550.0, 0.01))
    wanted = photons * irradiance_factor(4.0) * (3e-6) ** 2 * 0.9 * 0.9 * qe
    assert electron_rate(mono_camera, "Y", line) == pytest.approx(wanted, rel=1e-6)
    assert electron_rate(mono_camera, "Y", line, magnification=-1.0) == pytest.approx(
        wanted * irradiance_factor(4.0, 1.0) / irradiance_factor(4.0), rel=1e-6
    )


def test_electrons_are_linear_in_light_and_follow_the_aperture(colour_camera: CameraModel, lamp: Spectrum) -> None:
    rate = electron_rate(colour_camera, "G", lamp)
    assert electron_rate(colour_camera, "G", lamp.scale(3.0)) == pytest.approx(3 * rate, rel=1e-12)
    slow = colour_camera.model_copy(update={"lens": Lens(f_number=8.0, focal_length_mm=8.0, transmittance=0.45)})
    assert electron_rate(slow, "G", lamp) == pytest.approx(rate / 2 * (1 + 4 * 16) / (1 + 4 * 64), rel=1e-12)
    half = Spectrum.of([300.0, 800.0], [0.5, 0.5])
    assert electron_rate(colour_camera, "G", lamp, reflectance=half) == pytest.approx(rate / 2, rel=1e-6)


def test_responsivity_is_the_product_of_its_parts(colour_camera: CameraModel) -> None:
    w = np.array([450.0, 550.0, 655.0])
    plain = responsivity(colour_camera, "R", w)
    np.testing.assert_allclose(plain, colour_camera.quantum_efficiency["R"].at(w) * 0.9)
    sine = np.array([0.0, 0.3])[:, None]
    cut = responsivity(colour_camera, "R", w, (AngleCut(),), sine)
    assert cut.shape == (2, 3)
    np.testing.assert_allclose(cut[1], plain * AngleCut().through(w, 0.3))


class Broken(Local):
    name: ClassVar[str] = "test_broken"

    def on_light(self, light: Light) -> Light:
        return light.add_laws(
            spectrum=lambda wavelength_nm, radiance, kind: np.where(wavelength_nm == 550.0, np.nan, radiance)
        )


def test_impossible_radiance_is_named(colour_camera: CameraModel, lamp: Spectrum) -> None:
    light = Spectrum.of([500.0, 550.0, 600.0], [1e-3, -1e-5, 1e-3])
    message = r"radiance is {} W sr\^-1 m\^-2 nm\^-1 at 550 nm, below the limit of 0 or not finite: subtract"
    with pytest.raises(ValueError, match=message.format("-1e-05")):
        electron_rate(colour_camera, "G", light)
    with pytest.raises(ValueError, match=message.format("-1e-05")):
        predict_frame(colour_camera, Exposure(UniformField(light), 0.01))
    with pytest.raises(ValueError, match=message.format("nan")):
        electron_rate(colour_camera, "G", lamp, (Broken(),))


def test_other_impossible_input_is_named(colour_camera: CameraModel, lamp: Spectrum) -> None:
    with pytest.raises(ValueError, match=r"exposure -0.1 s is below the limit of 0 s"):
        Exposure(Darkness(), -0.1)
    with pytest.raises(
        ValueError, match=r"channel 'Y' has no quantum efficiency in this GBRG camera \(known: R, G, B\)"
    ):
        electron_rate(colour_camera, "Y", lamp)
    with pytest.raises(ValueError, match="distance from the edge is nan px"):
        edge_profile(colour_camera, "G", lamp, 0.0, [0.0, np.nan])
    with pytest.raises(ValueError, match="support 4 of the kernel has to be odd"):
        kernel(colour_camera, "G", lamp, 4)
    with pytest.raises(ValueError, match="give at least one edge region"):
        predict_frame(colour_camera, Exposure(KnifeEdge((), lamp, lamp), 0.01))


# --- the entries agree
# -------------------------------------------------------------------------------------------------


def _every_pixel(camera: CameraModel) -> FieldPoints:
    row, col = np.indices((camera.rows, camera.cols), float).reshape(2, -1)
    return FieldPoints.at(camera, row, col)


def _means_dn(camera: CameraModel, lamp: Spectrum, exposure: Exposure, acting: tuple[Effect, ...]) -> dict[str, float]:
    """Of the uniform entry, above the black level."""
    model = Uniform(camera, acting)
    rates = {c: electron_rate(camera, c, lamp, acting) for c in camera.channels}
    electrons = model.electrons(
        rates, exposure.exposure_s, field=model.field(_every_pixel(camera)), elapsed_s=exposure.elapsed_s
    )
    offset_dn = model.offset_dn(
        exposure.elapsed_s, None, exposure.exposure_s
    ) + camera.conversion_gain_dn_per_e * float(model.added_e.mean())
    return {c: float(dn) + offset_dn for c, dn in model.mean_dn(electrons).items()}


#: What the uniform entry leaves out: a reflection's share of even light, which is a factor on its level, and columns'
#: fixed offsets.
NOT_UNIFORM = {"ghost", "column_noise"}
UNIFORM_EFFECTS = [kind for kind in (*library.effects().values(), ReadOutRamp) if kind.name not in NOT_UNIFORM]


@pytest.mark.parametrize("kind", UNIFORM_EFFECTS, ids=lambda kind: kind.name)
def test_a_flat_frame_has_the_mean_of_the_uniform_entry(
    colour_camera: CameraModel, lamp: Spectrum, kind: type[Effect]
) -> None:
    """Frame and uniform entry are two ways to one number. They differ by what is rounded and clipped in a frame, and by
    light that only a frame moves from one end of it to the other: 0.05 % of the level, 0.02 DN.
    """
    camera = colour_camera.model_copy(update={"dark_current_e_per_s": 0.0})
    exposure = Exposure(UniformField(lamp), 0.02, elapsed_s=300.0)
    for one in kind.prototypes(camera)[0]:
        frame = predict_frame(camera, exposure, (one,)) - camera.black_level_dn
        for channel, mean_dn in _means_dn(camera, lamp, exposure, (one,)).items():
            step = mosaic.step(camera.cfa)
            planes = [frame[row::step, col::step] for row, col in mosaic.phases(camera.cfa)[channel]]
            assert np.mean(planes) == pytest.approx(mean_dn, rel=5e-4, abs=0.02)


def test_light_of_the_room_is_collected_while_the_shutter_is_open(colour_camera: CameraModel, lamp: Spectrum) -> None:
    """An exposure that is 2 ms too long collects light of the room 2 ms longer, too, in every entry."""
    acting = (AmbientLight(rate_e_per_s=5e4), ExposureOffset(offset_us=2000.0))
    dark = lamp.scale(0.0)
    camera = colour_camera.model_copy(update={"dark_current_e_per_s": 0.0})
    assert Uniform(camera, acting).ambient_e("G", 0.010) == pytest.approx(5e4 * 0.012)
    frame = predict_frame(camera, Exposure(UniformField(dark), 0.010), acting) - camera.black_level_dn
    wanted = _means_dn(camera, dark, Exposure(UniformField(dark), 0.010), acting)["G"]
    assert wanted == pytest.approx(camera.conversion_gain_dn_per_e * 5e4 * 0.012)
    row, col = mosaic.phases(camera.cfa)["G"][0]
    assert frame[row::2, col::2].mean() == pytest.approx(wanted, rel=1e-3)


# --- Charge between neighbours in even light --------------------------------------------------------------------------

TRAILS = ChargeTransferInefficiency(
    parallel_ppm=900.0, release_px=1.2, serial_ppm=400.0, serial_release_px=3.0, first_column="right"
)
LEVELS = {"R": 4000.0, "G": 2500.0, "B": 300.0}


def even_frame(camera: CameraModel) -> FloatArray:
    shape = camera.rows, camera.cols
    return mosaic.assemble({c: np.full(shape, e) for c, e in LEVELS.items()}, camera.cfa)


def test_combs_read_the_frame_of_even_light(colour_camera: CameraModel) -> None:
    """The trails of rows and of columns act along one axis each: the frame that is read is their product."""
    model = Uniform(colour_camera, (TRAILS,))
    down, across = model.read_combs()
    wanted = charge_of(colour_camera, (TRAILS,)).clock_out(even_frame(colour_camera))
    np.testing.assert_allclose(down.T @ model.phases_of(LEVELS) @ across, wanted, rtol=1e-9)


@pytest.mark.parametrize("effects", [(TRAILS,), (TRAILS, Crosstalk(share_percent=1.0))])
def test_mixing_is_the_mean_over_the_frame_or_that_of_a_place(
    colour_camera: CameraModel, effects: tuple[Effect, ...]
) -> None:
    """The frame's mean, and the pixels of one period of the mosaic where a place lies."""
    charge = charge_of(colour_camera, effects)
    read = charge.clock_out(charge.move_charge(even_frame(colour_camera)))
    model = Uniform(colour_camera, effects)
    for place, part in ((None, read), ((60.4, 20.3), read[60:62, 20:22])):
        factors = model.mixing_factors(LEVELS, place)
        planes = mosaic.planes(part, colour_camera.cfa)
        means = {c: np.mean([plane.mean() for n, plane in planes.items() if n[0] == c]) for c in LEVELS}
        assert factors == pytest.approx({c: means[c] / LEVELS[c] for c in LEVELS}, rel=1e-9)


@pytest.mark.parametrize("more", [Crosstalk(share_percent=1.0), BrighterFatter(exchanged_percent=3.0)])
def test_the_light_of_a_signal_is_the_inverse_of_mixing(colour_camera: CameraModel, more: Effect) -> None:
    """To the share of the brightest channel at which the search for it stops, where charge is exchanged by how much
    neighbours hold."""
    model = Uniform(colour_camera, (TRAILS, more))
    read = {c: LEVELS[c] * factor for c, factor in model.mixing_factors(LEVELS).items()}
    assert abs(read["B"] / LEVELS["B"] - 1.0) > 0.1
    assert model.light_of(read) == pytest.approx(LEVELS, abs=2.0 * LEAST_UNMIXED * LEVELS["R"])
    assert Uniform(colour_camera).light_of(read) == read
