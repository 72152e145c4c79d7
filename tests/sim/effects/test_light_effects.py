"""Laws of the light and of its fall-off against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from sim.camera import CameraModel, Lens
from sim.effects.ambient_light import AmbientLight
from sim.effects.base import Effect
from sim.effects.lamp_ageing import LampAgeing
from sim.effects.non_uniform_illumination import NonUniformIllumination
from sim.effects.other_f_number import OtherFNumber
from sim.effects.radiometer_nonlinearity import RIGHT_AT, RadiometerNonlinearity
from sim.effects.screen_gamma import ScreenGamma
from sim.effects.second_order_light import SecondOrderLight
from sim.effects.source_drift import SourceDrift
from sim.effects.source_instability import SourceInstability
from sim.effects.stray_light import StrayLight
from sim.effects.vignetting import Vignetting
from sim.effects.vignetting_decentre import VignettingDecentre
from sim.frame import screen_light
from sim.point import optical_transfer
from sim.spectrum import Spectrum
from sim.stages import light_of
from sim.uniform import Uniform, electron_rate

WAVELENGTH = np.arange(380.0, 961.0)
CAMERA = CameraModel(
    rows=60, cols=80, pixel_pitch_um=2.0, fill_factor=1.0, cfa="RGGB", bit_depth=12, black_level_dn=64.0,
    white_level_dn=4095.0,
    conversion_gain_dn_per_e=0.4, full_well_e=10000.0, read_noise_e=2.0, dark_current_e_per_s=5.0, dsnu_e=0.0,
    prnu_percent=0.0,
    quantum_efficiency={c: Spectrum.of(WAVELENGTH, np.full(WAVELENGTH.shape, 0.5)) for c in "RGB"},
    lens=Lens(f_number=4.0, focal_length_mm=8.0),
)  # fmt: skip
HALF_UM = 100.0  # half the diagonal of 60 x 80 pixels of 2 um
PLACE = np.linspace(-HALF_UM, HALF_UM, 9)


def _light(one: Effect, x_um: np.ndarray, y_um: np.ndarray) -> np.ndarray:
    return Uniform(CAMERA, (one,)).shade_light(np.ones(np.shape(x_um)), x_um, y_um)


def test_vignetting_takes_its_share_in_the_corner_whatever_its_power() -> None:
    for power in (1.0, 2.0, 4.0):
        one = Vignetting(corner_loss_percent=8.0, exponent=power)
        assert _light(one, np.array(80.0), np.array(60.0)) == pytest.approx(0.92)
        assert _light(one, np.array(40.0), np.array(30.0)) == pytest.approx(1 - 0.08 * 0.5**power)


def test_a_fall_off_off_the_centre_is_that_about_it_and_a_slope() -> None:
    """Square law: rho^2 - rho_0^2 = r^2 - 2 r . c."""
    one = VignettingDecentre(fall_off_percent=8.0, centre_x=0.3, centre_y=0.0)
    centred = Vignetting(corner_loss_percent=8.0)
    expected = _light(centred, PLACE, 0 * PLACE) + 0.08 * 2 * 0.3 * PLACE / HALF_UM
    np.testing.assert_allclose(_light(one, PLACE, 0 * PLACE), expected)
    there = _light(VignettingDecentre(fall_off_percent=8.0, exponent=3.0), PLACE, PLACE)
    np.testing.assert_allclose(there, _light(Vignetting(corner_loss_percent=8.0, exponent=3.0), PLACE, PLACE))


def test_a_bow_lies_along_its_slope() -> None:
    one = NonUniformIllumination(gradient_x_percent=3.0, gradient_y_percent=4.0, bow=0.2)
    x, y = np.array([48.0, -24.0]), np.array([30.0, -45.0])
    s = 0.03 * x / 80.0 + 0.04 * y / 60.0
    np.testing.assert_allclose(_light(one, x, y), 1 + s + 0.2 * s**2 / 0.05)


def test_a_warm_up_starts_as_a_drift_and_settles() -> None:
    steady, settling = SourceDrift(drift_percent_per_min=0.3), SourceDrift(drift_percent_per_min=0.3, settling_min=8.0)
    assert Uniform(CAMERA, (settling,)).source(1.0) - 1 == pytest.approx(
        Uniform(CAMERA, (steady,)).source(1.0) - 1, rel=2e-3
    )
    assert Uniform(CAMERA, (steady,)).source(600.0) == pytest.approx(1.03, rel=1e-4)
    assert Uniform(CAMERA, (settling,)).source(36000.0) == pytest.approx(1 + 0.003 * 8.0)


def test_an_aged_lamp_is_redder_by_the_stated_share_and_keeps_its_integral() -> None:
    """Analytic limit: of equal energy, the ratio over 200 nm is exp(2 a). Conservation: the integral stays. Null limit:
    light of one wavelength, and a screen's, are as they were."""
    one = Uniform(CAMERA, (LampAgeing(reddening_percent=10.0),))
    even = np.full(WAVELENGTH.shape, 0.01)
    aged = one.radiance(WAVELENGTH, even, "flat")
    blue, red = (int(np.argmin(np.abs(WAVELENGTH - nm))) for nm in (450.0, 650.0))
    assert aged[red] / aged[blue] == pytest.approx(np.exp(0.1 * (WAVELENGTH[red] - WAVELENGTH[blue]) / 100.0))
    assert np.trapezoid(aged, WAVELENGTH) == pytest.approx(np.trapezoid(even, WAVELENGTH))
    for kind in ("narrowband", "white", "bernoulli"):
        np.testing.assert_array_equal(one.radiance(WAVELENGTH, even, kind), even)
    line = np.exp(-0.5 * ((WAVELENGTH - 600.0) / 4.0) ** 2)
    # a line of 4 nm moves by a sigma^2 / 100 nm = 0.016 nm, and keeps its integral
    moved = one.radiance(WAVELENGTH, line, "flat")
    assert np.average(WAVELENGTH, weights=moved) - 600.0 == pytest.approx(0.016, rel=0.05)
    np.testing.assert_array_equal(one.radiance(WAVELENGTH, 0.0 * even, "chart"), 0.0 * even)


def test_an_unsteady_source_scatters_and_keeps_its_mean() -> None:
    """Of 4000 frames the mean is known to s / sqrt(4000), the standard deviation to s / sqrt(8000); the same frame is
    the same again.
    """
    one = light_of(CAMERA, (SourceInstability(instability_percent=2.0),))
    drawn = np.array([one.unsteady(20.0 * k) for k in range(4000)])
    assert drawn.mean() == pytest.approx(1.0, abs=3.5 * 0.02 / np.sqrt(4000))
    assert drawn.std() == pytest.approx(0.02, abs=3.5 * 0.02 / np.sqrt(8000))
    assert one.unsteady(40.0) == drawn[2]
    assert one.source(40.0) == 1.0
    assert Uniform(CAMERA, (SourceInstability(instability_percent=2.0),)).unsteadiness == pytest.approx(0.02)


def test_second_order_brings_half_the_wavelength_with_its_share_of_the_power() -> None:
    line = np.exp(-0.5 * ((WAVELENGTH - 900.0) / 6.0) ** 2)
    after = Uniform(CAMERA, (SecondOrderLight(share_percent=4.0),)).radiance(WAVELENGTH, line, "narrowband")
    blue = WAVELENGTH < 600.0
    assert after[blue].sum() == pytest.approx(0.04 * line.sum(), rel=1e-6)
    assert np.sum((after * WAVELENGTH)[blue]) / after[blue].sum() == pytest.approx(450.0)
    np.testing.assert_array_equal(
        Uniform(CAMERA, (SecondOrderLight(share_percent=4.0),)).radiance(WAVELENGTH, line, "flat"), line
    )


def test_a_radiometer_s_nonlinearity_is_a_power_of_the_level() -> None:
    one = RadiometerNonlinearity(exponent_percent=2.0)
    for level in (RIGHT_AT, 10 * RIGHT_AT):
        line = level * np.exp(-0.5 * ((WAVELENGTH - 600.0) / 6.0) ** 2)
        ratio = Uniform(CAMERA, (one,)).radiance(WAVELENGTH, line, "narrowband")[220] / line[220]
        assert ratio == pytest.approx((level / RIGHT_AT) ** 0.02)


def test_the_room_s_colour_leaves_green_as_it_is() -> None:
    one = AmbientLight(rate_e_per_s=100.0, red_over_blue=4.0)
    assert [Uniform(CAMERA, (one,)).ambient_e(c, 1.0) for c in "RGB"] == pytest.approx([200.0, 100.0, 50.0])
    assert Uniform(CAMERA, (one,)).ambient_e("Y", 1.0) == 100.0


def test_a_screen_s_gamma_moves_the_edges_of_lit_cells() -> None:
    """(1 + erf(x / s sqrt 2)) / 2 to the fifth: the mean of the largest of five normal numbers, 1.1630 s inside; with
    no power rims stay as they are asked for, and a blur without a power is unlikely to be a gamma.
    """
    x_um = (np.arange(400) - 199.5)[None, :] * 0.05 * CAMERA.pixel_pitch_um
    step = np.broadcast_to(x_um > 0, (4, 400)).astype(float)
    y_um = np.arange(4)[:, None] * 0.05 * CAMERA.pixel_pitch_um
    shown = screen_light(CAMERA, step, x_um, y_um, (ScreenGamma(exponent=5.0, rim_px=0.4),))
    lost_px = 0.05 * float((step - shown)[0].sum())
    assert abs(lost_px - 1.16296 * 0.4) < 0.002  # samples of 0.05 px
    assert screen_light(CAMERA, step, x_um, y_um, (ScreenGamma(rim_px=0.4),)) is step
    assert (
        ScreenGamma(exponent=1.05, rim_px=0.4).log_prior() < -10.0 < ScreenGamma(exponent=2.0, rim_px=0.4).log_prior()
    )


def test_another_f_number_has_its_own_diffraction() -> None:
    f = np.linspace(0.0, 0.5, 21)
    wide, narrow = (CAMERA.model_copy(update={"lens": Lens(f_number=n, focal_length_mm=8.0)}) for n in (4.0, 5.6))
    light = Spectrum.of([400.0, 700.0], [1.0, 1.0])
    got, wanted = (
        optical_transfer(camera, CAMERA.channels[0], light, f, 0.6 * f, effects)
        for camera, effects in ((wide, (OtherFNumber(ratio=1.4),)), (narrow, ()))
    )
    np.testing.assert_allclose(got, wanted, atol=1e-4)  # wavelengths are the same, the kink at a cutoff isn't


@pytest.mark.parametrize("reach_nm", [700.0, 1000.0])
def test_stray_light_lies_where_the_light_is_stated_whatever_the_cameras_reach(reach_nm: float) -> None:
    """A line in 401 nm of stated range: 2 % of it spread over these, of which a curve of 1 sees those above 650 nm and
    no others.
    """
    wavelength = np.arange(380.0, 781.0)
    line = Spectrum.of(wavelength, np.exp(-0.5 * ((wavelength - 500.0) / 5.0) ** 2))
    efficiency = Spectrum.of((650.0, reach_nm), (1.0, 1.0))
    camera = CAMERA.model_copy(update={"quantum_efficiency": dict.fromkeys("RGB", efficiency)})
    level = 0.02 * line.integral() / 400.0
    seen = Spectrum.of((650.0, min(reach_nm, 780.0)), (level, level))
    assert electron_rate(camera, "G", line, (StrayLight(share_percent=2.0),), "narrowband") == pytest.approx(
        electron_rate(camera, "G", seen),
        rel=1e-2,  # half a nanometre of 50 where the curve begins
    )
