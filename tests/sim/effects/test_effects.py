"""The contract of all effects: absent is the baseline exactly, a slope at zero, conservation."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.special import ndtr

from sim.camera import CameraModel, Geometry, Lens
from sim.effect_contract import (
    CAMERA,
    LIGHT,
    LINE,
    LINE_650,
    PLACE_UM,
    check_absence,
    check_declarations,
    prototype_complaints,
    slope_complaints,
)
from sim.effects.base import Effect
from sim.effects.library import effect, effects, list_changes, may_change
from sim.frame import (
    Exposure,
    collected_mosaic,
    expected_electrons,
    predict_frame,
)
from sim.optics.diffraction import diffraction_otf
from sim.optics.illumination import relative_illumination
from sim.optics.imaging import ZernikePupil
from sim.optics.pupil import pupil_otf, seidel
from sim.point import TRANSFER, Blur, edge_profile, halos, optical_transfer
from sim.scene.scenes import EdgeRegion, KnifeEdge, PlanarTarget, PointArray, UniformField
from sim.sensor.mosaic import PERIOD_PX
from sim.sensor.mosaic import phases as mosaic_phases
from sim.spectrum import Spectrum
from sim.stages import charge_of, signal_of
from sim.uniform import Uniform, electron_rate

ALL = list(effects().values())


def _transfer(
    one: Effect, fx: np.ndarray, fy: np.ndarray, wavelength_nm: float, place_um: tuple[float, float] = (0.0, 0.0)
) -> np.ndarray:
    """What an effect alone makes of a perfect lens's transfer; frequencies in cy/um."""
    pitch = CAMERA.pixel_pitch_um
    return np.asarray(Blur(CAMERA, (one,)).beside_lens(wavelength_nm, fx * pitch, fy * pitch, place_um))


@pytest.mark.parametrize("kind", ALL, ids=lambda k: k.name)
def test_absent_is_the_baseline_exactly(kind: type[Effect]) -> None:
    assert list(check_absence(kind)) == []


@pytest.mark.parametrize("kind", ALL, ids=lambda k: k.name)
def test_declares_what_the_diagnosis_reads(kind: type[Effect]) -> None:
    assert list(check_declarations(kind)) == []
    assert kind.name == kind.__module__.rsplit(".", 1)[-1]  # one effect, one file
    # a known part of a camera, the diagnosis' own term for what has no name, and a misstated f-number
    assert kind.is_candidate == (
        kind.name not in {"cover_glass", "empirical_law", "model_discrepancy", "other_f_number"}
    )


@pytest.mark.parametrize("kind", ALL, ids=lambda k: k.name)
def test_slope_at_zero_is_finite_and_not_nil(kind: type[Effect]) -> None:
    assert list(slope_complaints(kind)) == []


@pytest.mark.parametrize("kind", ALL, ids=lambda k: k.name)
def test_prototypes_change_something_and_stay_in_bounds(kind: type[Effect]) -> None:
    assert list(prototype_complaints(kind)) == []


@pytest.mark.parametrize("kind", ALL, ids=lambda kind: kind.name)
@pytest.mark.parametrize("pitch_um", [0.7, 30.0])
def test_cameras_of_any_pitch_have_prototypes(pitch_um: float, kind: type[Effect]) -> None:
    """From a telephone's pixels to an astronomer's: a prototype out of its bounds would end every diagnosis."""
    camera = CAMERA.model_copy(update={"pixel_pitch_um": pitch_um})
    assert all(isinstance(one, kind) for places in kind.prototypes(camera) for one in places)


def _blurs() -> list[Effect]:
    return [p for kind in ALL if may_change(kind) & TRANSFER for p in kind.prototypes(CAMERA)[0]]


@pytest.mark.parametrize("one", _blurs(), ids=lambda e: e.name)
def test_a_blur_conserves_light(one: Effect) -> None:
    """OTF 1 at zero frequency: none is lost."""
    zero = np.zeros(1)
    factor = _transfer(one, zero, zero, 480.0, PLACE_UM)
    assert float(np.real(factor[0])) == pytest.approx(1.0, abs=1e-12)


def _acting(field: str) -> list[Effect]:
    """Of every effect that may change a field, the first prototype that does."""
    every = ([one for group in kind.prototypes(CAMERA) for one in group] for kind in ALL if field in may_change(kind))
    return [next(one for one in prototypes if field in list_changes(one)) for prototypes in every]


@pytest.mark.parametrize("one", _acting("charge.collected"), ids=lambda e: e.name)
def test_pixels_of_a_colour_keep_their_mean(one: Effect) -> None:
    """In even light, by colour: levels don't ask what pixels of one colour do unlike others. And in proportion."""
    even = np.full((PERIOD_PX, PERIOD_PX), 1000.0)
    after = charge_of(CAMERA, (one,)).collect_light(even.copy())
    assert np.any(after != even)
    np.testing.assert_allclose(charge_of(CAMERA, (one,)).collect_light(2.0 * even), 2.0 * after, rtol=1e-12)
    for colour, phases in mosaic_phases(CAMERA.cfa).items():
        means = [after[row::2, col::2].mean() for row, col in phases]
        assert np.mean(means) == pytest.approx(1000.0, rel=1e-12), colour


@pytest.mark.parametrize("one", _acting("signal.read_spectrum"), ids=lambda e: e.name)
def test_coloured_read_noise_keeps_its_variance(one: Effect) -> None:
    power = signal_of(CAMERA, (one,)).read_power(np.fft.fftfreq(1000))
    assert np.ptp(power) > 0.0 and power.min() > 0.0
    assert power.mean() == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize("one", _acting("signal.gains") + _acting("signal.line_gains"), ids=lambda e: e.name)
def test_gains_by_place_keep_the_mean_of_the_frame(one: Effect) -> None:
    gains = signal_of(CAMERA, (one,)).gain_map((CAMERA.rows, CAMERA.cols))
    assert gains is not None and np.ptp(gains) > 0.0
    assert gains.mean() == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize("one", _acting("charge.exchange") + _acting("charge.kernels"), ids=lambda e: e.name)
def test_charge_between_pixels_is_conserved(one: Effect) -> None:
    """Far from the rim, whatever two unequal pixels hold; and equal pixels exchange none."""
    frame = np.full((17, 17), 1000.0)
    even = charge_of(CAMERA, (one,)).move_charge(frame.copy())
    np.testing.assert_allclose(even, frame, rtol=1e-12)
    frame[8, 8] = 6000.0
    assert charge_of(CAMERA, (one,)).move_charge(frame.copy()).sum() == pytest.approx(frame.sum(), rel=1e-12)


@pytest.mark.parametrize("one", _acting("signal.response"), ids=lambda e: e.name)
def test_no_electrons_are_read_as_none(one: Effect) -> None:
    assert signal_of(CAMERA, (one,)).read(np.zeros(1))[0] == 0.0


def test_charge_that_moves_is_conserved() -> None:
    """Crosstalk in a uniform mosaic: what one colour loses another gains (mirrored at the rim, exact inside)."""
    frame = np.zeros((16, 16))
    frame[8, 8] = 100.0
    one = effect("crosstalk")(share_percent=3.0)
    after = collected_mosaic(CAMERA, frame, (one,), exposure_s=1.0, elapsed_s=0.0)
    assert after.sum() == pytest.approx(100.0, rel=1e-12)
    assert after[8, 9] == pytest.approx(3.0)


def test_a_double_image_lies_where_its_phase_turns() -> None:
    """H = 1 - q + q exp(-2 pi i f . d): half a turn at f = 1 / (2 d) leaves 1 - 2 q, a whole one all."""
    one = effect("double_image")(share_percent=10.0, displacement_x_px=5.0, displacement_y_px=-4.0)
    fx = np.array([0.0, 0.1, 0.2, 0.0]) / CAMERA.pixel_pitch_um
    fy = np.array([0.0, 0.0, 0.0, 0.0625]) / CAMERA.pixel_pitch_um
    np.testing.assert_allclose(_transfer(one, fx, fy, 550.0), [1.0, 0.8, 1.0, 0.9 + 0.1j], atol=1e-12)


def test_low_pass_filter_has_its_null_at_half_the_inverse_displacement() -> None:
    one = effect("optical_low_pass_filter")(displacement_x_um=2.0)
    factor = _transfer(one, np.array([0.25]), np.array([0.1]), 550.0)
    assert abs(factor[0]) < 1e-12  # cos(pi / 2)


def test_defocus_agrees_with_a_pupil_summed_by_brute_force() -> None:
    """Overlap of two discs on a fine grid; the grid's rim is good to 2e-3."""
    one = effect("defocus")(defocus_um=25.0)
    w020, wavelength = 25.0 / (8.0 * 16.0), 0.55
    cutoff = 1.0 / (wavelength * 4.0)
    x = np.linspace(-1.0, 1.0, 801)
    u, v = np.meshgrid(x, x)
    for share in (0.1, 0.3, 0.5, 0.8):
        s = 2.0 * share
        inside = ((u - s / 2) ** 2 + v**2 < 1) & ((u + s / 2) ** 2 + v**2 < 1)
        phase = 2.0 * np.pi / wavelength * w020 * 2.0 * s * u
        brute = float(np.cos(phase[inside]).sum()) / float((u**2 + v**2 < 1).sum())
        factor = _transfer(one, np.array([share * cutoff]), np.zeros(1), 550.0)
        assert float(factor[0]) * float(diffraction_otf(share * cutoff, 550.0, 4.0)) == pytest.approx(brute, abs=3e-3)


def test_astigmatism_with_equal_and_opposite_foci_is_defocus_along_one_axis() -> None:
    """Along x and y the modulus is that of the two defoci; symmetric, so that swapping the axes swaps the contrasts."""
    kind = effect("astigmatism")
    f, zero = np.linspace(0.01, 0.3, 10), np.zeros(10)
    one = _transfer(kind(defocus_x_um=15.0, defocus_y_um=0.0), f, zero, 550.0)
    other = _transfer(kind(defocus_x_um=0.0, defocus_y_um=15.0), zero, f, 550.0)
    np.testing.assert_allclose(one, other, atol=1e-9)
    np.testing.assert_allclose(one, _transfer(effect("defocus")(defocus_um=15.0), f, zero, 550.0), atol=1e-3)


def test_aberrations_agree_with_the_general_pupil() -> None:
    """`sim.optics.pupil` sums any path error to 1e-6; these have 16 or 32 nodes: 1e-5 below half a wave."""
    f, turn = np.linspace(0.02, 0.4, 9), np.deg2rad(35.0)
    fx, fy = f * np.cos(turn), f * np.sin(turn)
    base = pupil_otf(fx, fy, 550.0, 4.0, seidel())
    cases = {
        effect("defocus")(defocus_um=20.0): seidel(defocus_um=20.0 / 128.0),
        effect("spherical_aberration")(w040_um=0.25): seidel(spherical_um=0.25),
        # x^2 wx - y^2 wy = (wx + wy) x^2 - wy r^2
        effect("astigmatism")(defocus_x_um=15.0, defocus_y_um=10.0): seidel(
            defocus_um=-10.0 / 128.0, astigmatism_um=25.0 / 128.0
        ),
    }
    for one, path in cases.items():
        factor = _transfer(one, fx, fy, 550.0)
        np.testing.assert_allclose(factor * base, pupil_otf(fx, fy, 550.0, 4.0, path), atol=1e-5)


def test_glare_leaves_an_edge_its_levels_mean() -> None:
    """I' = (1 - g) I + g <I>: both plateaus move by g / 2 of the contrast towards the middle."""
    one = effect("veiling_glare")(share_percent=4.0)
    far = np.array([-30.0, 30.0])
    plain, veiled = (edge_profile(CAMERA, "G", LIGHT, 5.0, far, acting) for acting in ((), (one,)))
    np.testing.assert_allclose(veiled - 0.5, 0.96 * (plain - 0.5), atol=2e-3)


def test_scattered_light_has_no_fall_off_of_its_own() -> None:
    """A uniform field under glare g: (1 - g) of the shaded field and g of its mean, by channel; the mean stays."""
    fall_off, glare = effect("vignetting")(corner_loss_percent=30.0), effect("veiling_glare")(share_percent=4.0)
    camera = CAMERA.model_copy(update={"cfa": "MONO", "quantum_efficiency": {"Y": LINE_650}})
    field = Exposure(UniformField(LIGHT), 1.0)
    plain, veiled = (expected_electrons(camera, field, acting) for acting in ((fall_off,), (fall_off, glare)))
    assert np.ptp(plain) > 0.01 * plain.mean()
    np.testing.assert_allclose(veiled, 0.96 * plain + 0.04 * plain.mean(), rtol=1e-6)


def test_what_glare_leaves_about_its_source_is_between_the_two() -> None:
    """Far within the halo an edge's plateaus come as near as by an even veil, far beyond it they stay."""
    reach_um = 12.0 * CAMERA.pixel_pitch_um
    reach = reach_um / (0.5 * CAMERA.pixel_pitch_um * np.hypot(CAMERA.rows, CAMERA.cols))
    one = effect("veiling_glare")(share_percent=4.0, halo_share=1.0, halo_reach=float(reach))
    assert halos(CAMERA, (one,)) == [(0.04, pytest.approx(12.0))]
    at = np.array([-60.0, -4.0, 4.0, 60.0])
    plain, veiled = (edge_profile(CAMERA, "G", LIGHT, 5.0, at, acting) for acting in ((), (one,)))
    np.testing.assert_allclose(veiled, 0.96 * plain + 0.04 * ndtr(at / 12.0), atol=1e-4)


def test_infrared_filter_halves_at_its_cut_and_falls() -> None:
    one = effect("infrared_cut_filter")(cut_wavelength_nm=650.0, width_nm=6.0)
    t = Uniform(CAMERA, (one,)).transmittance(np.array([550.0, 650.0, 700.0]))
    assert t[1] == pytest.approx(0.5)
    assert all(a > b for a, b in pairwise(t))


def test_a_radiometers_error_is_a_power_or_grows_with_the_level() -> None:
    weak, strong = (0.002 * np.ones(3), 0.03 * np.ones(3))
    for growth, exponents in ((0.0, np.log([0.2, 3.0])), (1e-6, np.log([0.2, 3.0])), (1.0, np.array([-0.8, 2.0]))):
        one = effect("radiometer_nonlinearity")(exponent_percent=5.0, growth=growth)
        for level, exponent in zip((weak, strong), exponents, strict=True):
            found = Uniform(CAMERA, (one,)).radiance(np.array([500.0, 550.0, 600.0]), level, "narrowband")
            np.testing.assert_allclose(found, level * np.exp(0.05 * exponent), rtol=1e-6)


def test_bandwidth_keeps_the_light() -> None:
    """A wider line holds as many watts; the sum at 1 nm of a 14 nm line is exact to 1e-3."""
    wavelength, value = LINE.arrays
    one = effect("source_bandwidth")(width_nm=8.0)
    wider = Uniform(CAMERA, (one,)).radiance(wavelength, value, "narrowband")
    assert np.trapezoid(wider, wavelength) == pytest.approx(np.trapezoid(value, wavelength), rel=1e-3)
    assert wider.max() < value.max()


def test_unknown_effect_is_refused_with_the_list() -> None:
    with pytest.raises(KeyError, match="defocus"):
        effect("nonsense")


# --- aberrations -----------------------------------------------------------------------------------------------------


def test_axial_colour_is_each_wavelengths_own_defocus() -> None:
    """dz = 8 um t + 3 um t^2: at 650 nm 11 um, at 450 nm -5 um, at 550 nm none."""
    one = effect("axial_chromatic_aberration")(slope_um=8.0, curvature_um=3.0)
    f, none = np.linspace(0.0, 0.4, 9), np.zeros(9)
    for wavelength_nm, dz in ((650.0, 11.0), (450.0, 5.0)):
        wanted = _transfer(effect("defocus")(defocus_um=dz), f, none, wavelength_nm)
        np.testing.assert_allclose(_transfer(one, f, none, wavelength_nm), wanted, atol=1e-12)
    np.testing.assert_array_equal(_transfer(one, f, none, 550.0), 1.0)


def test_field_curvature_is_each_places_own_defocus() -> None:
    """c r^2 + a x + b y in half diagonals: 0.6 along columns and -0.8 along rows with c = 10, a = 5, b = 2 um make 11.4
    um.
    """
    half_um = 0.5 * CAMERA.pixel_pitch_um * float(np.hypot(CAMERA.rows, CAMERA.cols))
    one = effect("field_curvature")(curvature_um=10.0, tilt_x_um=5.0, tilt_y_um=2.0)
    f, none = np.linspace(0.0, 0.4, 9), np.zeros(9)
    there = 0.6 * half_um, -0.8 * half_um
    wanted = _transfer(effect("defocus")(defocus_um=11.4), f, none, 550.0)
    np.testing.assert_allclose(_transfer(one, f, none, 550.0, there), wanted, atol=1e-12)
    np.testing.assert_array_equal(_transfer(one, f, none, 550.0), 1.0)


def test_coma_moves_detail_along_it_and_leaves_it_even_across() -> None:
    """W131 r^2 x: along x the transfer has a phase that isn't in proportion to frequency, along y it is real."""
    one = effect("coma")(w131_x_um=0.3)
    f, none = np.linspace(0.02, 0.3, 8), np.zeros(8)
    along, across = _transfer(one, f, none, 550.0), _transfer(one, none, f, 550.0)
    np.testing.assert_allclose(along * pupil_otf(f, none, 550.0, 4.0, seidel()),
                               pupil_otf(f, none, 550.0, 4.0, seidel(coma_um=(0.3, 0.0))), atol=1e-6)  # fmt: skip
    slope = np.unwrap(np.angle(along)) / f
    assert np.ptp(slope) > 0.1 * np.abs(slope).max()
    np.testing.assert_allclose(np.imag(across), 0.0, atol=1e-9)


def test_axial_colour_swaps_the_channels_through_focus() -> None:
    """Red focuses behind: with the sensor moved back red gains and blue loses, and only the sum of the paths says
    so.
    """
    f = np.full(1, 0.3)
    colour = effect("axial_chromatic_aberration")(slope_um=-15.0)
    moved = effect("defocus")(defocus_um=8.0)
    contrast = {
        acting: [float(np.real(optical_transfer(CAMERA, c, LIGHT, f, 0 * f, acting))[0]) for c in "RB"]
        for acting in ((), (colour,), (colour, moved))
    }
    red, blue = np.array(contrast[(colour, moved)]) / np.array(contrast[(colour,)])
    assert red > 1.0 > blue


def test_aberrations_add_up_in_the_pupil() -> None:
    """W040 with W020 = -W040 is the best focus of spherical aberration: better than either alone, as the sum of the
    paths is.
    """
    spherical = effect("spherical_aberration")(w040_um=0.5)
    # defocus has one sign alone; astigmatism of equal and opposite parts doesn't: -x^2 - y^2 in two steps
    back = effect("axial_chromatic_aberration")(slope_um=-0.5 * 8.0 * 16.0)
    camera = CAMERA.model_copy(update={"fill_factor": 1.0, "quantum_efficiency": dict.fromkeys("RGB", LINE_650)})
    f = np.linspace(0.05, 0.5, 6)
    both = optical_transfer(camera, "G", None, f, 0 * f, (spherical, back))
    um = f / camera.pixel_pitch_um
    wanted = pupil_otf(um, 0 * um, 650.0, 4.0, seidel(spherical_um=0.5, defocus_um=-0.5)) * np.sinc(f)
    np.testing.assert_allclose(both, wanted, atol=1e-6)
    alone = optical_transfer(camera, "G", None, f, 0 * f, (spherical,))
    assert np.all(np.real(both) > np.real(alone))


def test_a_cameras_own_pupil_takes_aberrations_in() -> None:
    """A lens with defocus of its own and one with the effect are one and the same."""
    f = np.linspace(0.0, 0.6, 7)
    own = ZernikePupil(coefficients=(0, 0, 0, 0.1), index="noll", unit="um")
    w020 = 2.0 * np.sqrt(3.0) * 0.1
    camera = CAMERA.model_copy(update={"lens": CAMERA.lens.model_copy(update={"imaging": own})})
    more = effect("defocus")(defocus_um=5.0)
    total = effect("defocus")(defocus_um=5.0 + 8.0 * 16.0 * w020)
    np.testing.assert_allclose(
        optical_transfer(camera, "G", LIGHT, f, f, (more,)),
        optical_transfer(CAMERA, "G", LIGHT, f, f, (total,)),
        atol=1e-6,
    )


def test_cover_glass_is_the_spherical_aberration_of_its_thickness() -> None:
    """2 mm of n = 1.52 at f/4: W040 = t (n^2 - 1) / (128 n^3 N^4); left unfocused, t (1 - 1/n) of defocus comes on
    top.
    """
    kind, f = effect("cover_glass"), np.linspace(0.0, 0.4, 9)
    w040 = 2000.0 * (1.52**2 - 1) / (128 * 1.52**3 * 4.0**4)
    wanted = _transfer(effect("spherical_aberration")(w040_um=w040), f, 0 * f, 550.0)
    np.testing.assert_allclose(_transfer(kind(thickness_mm=2.0), f, 0 * f, 550.0), wanted, atol=1e-12)
    blurred = _transfer(kind(thickness_mm=0.05, refocused=False), f, 0 * f, 550.0)
    defocus = _transfer(effect("defocus")(defocus_um=50.0 * (1 - 1 / 1.52)), f, 0 * f, 550.0)
    # 0.05 mm of glass has 3e-4 um of spherical aberration
    np.testing.assert_allclose(blurred, defocus, atol=5e-3)


def test_a_quartz_plate_splits_blue_further() -> None:
    """Null at 1 / (2 d): d is as stated at 589.3 nm, 4 % more at 400 nm."""
    one = effect("optical_low_pass_filter")(displacement_x_um=2.0, plate="quartz")
    for wavelength_nm, d in ((589.3, 2.0), (400.0, 2.083)):
        assert _transfer(one, np.array([0.5 / d]), np.zeros(1), wavelength_nm)[0] == pytest.approx(0.0, abs=1e-3)


def test_an_interference_filter_darkens_red_towards_the_corners() -> None:
    """At 20 degrees and n = 1.8 an edge at 620 nm moves to 609 nm; glass stays."""
    coating = effect("infrared_cut_filter")(cut_wavelength_nm=620.0, effective_index=1.8)
    glass = effect("infrared_cut_filter")(cut_wavelength_nm=620.0)
    sine = np.sin(np.deg2rad(20.0))
    axis, corner = (electron_rate(CAMERA, "R", LIGHT, (coating,), sin_theta=s) for s in (0.0, sine))
    assert corner < 0.95 * axis
    assert axis == pytest.approx(electron_rate(CAMERA, "R", LIGHT, (glass,), sin_theta=sine))


# --- where light lands -----------------------------------------------------------------------------------------------


POINTS = np.array([(row, col) for row in (3.0, 11.5, 20.0) for col in (4.0, 15.5, 27.0)])


def _centres(
    camera: CameraModel, points: np.ndarray, line: Spectrum, acting: tuple[Effect, ...], around: np.ndarray
) -> np.ndarray:
    """Centroids [row, col] of small dots, over 3 x 3 px `around` places, in a frame without mosaic or fall-off."""
    dots = PointArray(tuple(map(tuple, points.tolist())), 1.5, line.scale(0.0), line)
    frame = expected_electrons(camera, Exposure(dots, 1.0), acting, oversample=6, margin_px=16)
    row, col = np.indices(frame.shape)
    frame = frame / relative_illumination(camera, row, col)
    windows = [frame * ((np.abs(row - r) < 2) & (np.abs(col - c) < 2)) for r, c in np.rint(around)]
    return np.array([[np.sum(w * row) / w.sum(), np.sum(w * col) / w.sum()] for w in windows])


@pytest.mark.parametrize(
    ("one", "wavelength_nm"),
    [
        (effect("lateral_chromatic_aberration")(slope_um=1.5, curvature_um=0.5), 650.0),
        (effect("lateral_chromatic_aberration")(slope_um=1.5, curvature_um=0.5), 450.0),
        (effect("distortion")(corner_percent=2.0), 550.0),
        (effect("decentre")(shift_x_um=0.5, shift_y_um=-0.35), 550.0),
    ],
    ids=lambda v: v.name if isinstance(v, Effect) else str(v),
)
def test_light_lands_where_the_law_says(one: Effect, wavelength_nm: float) -> None:
    """Dots on a frame of 24 x 32 px of 3 um: as if they had been drawn where the law puts them."""
    line = Spectrum.of([wavelength_nm - 1e-3, wavelength_nm, wavelength_nm + 1e-3], [0.0, 1.0, 0.0])
    flat = Spectrum.of([300.0, 900.0], [0.5, 0.5])
    camera = CAMERA.model_copy(update={"cfa": "MONO", "quantum_efficiency": {"Y": flat}, "dark_current_e_per_s": 0.0})
    y, x = ((POINTS - (11.5, 15.5)) * 3.0).T
    corner = 0.5 * np.hypot(24.0, 32.0) * 3.0
    t = (wavelength_nm - 550.0) / 100.0
    r2 = (x**2 + y**2) / corner**2
    right, down = {
        "lateral_chromatic_aberration": ((1.5 * t + 0.5 * t * t) / corner * x, (1.5 * t + 0.5 * t * t) / corner * y),
        "distortion": (0.02 * r2 * x, 0.02 * r2 * y),
        "decentre": (
            (0.5 * (3 * x * x + y * y) - 0.7 * x * y) / corner**2,
            (-0.35 * (x * x + 3 * y * y) + x * y) / corner**2,
        ),
    }[one.name]
    law = np.stack([down, right], axis=1) / 3.0
    assert np.abs(law).max() > 0.1
    moved = _centres(camera, POINTS, line, (one,), POINTS + law)
    # the scale changes by 5 % at most, and with it the dots' width: a hundredth of a pixel
    np.testing.assert_allclose(moved, _centres(camera, POINTS + law, line, (), POINTS + law), atol=0.015)
    plain = _centres(camera, POINTS, line, (), POINTS + law)
    assert np.abs(moved - plain).max() > 0.05


def test_a_uniform_field_stays_uniform_where_light_is_moved() -> None:
    for name in ("lateral_chromatic_aberration", "distortion", "decentre"):
        one = effect(name)(**dict.fromkeys(effect(name).quantities(), 5.0))
        scene = Exposure(UniformField(LIGHT), 0.01)
        np.testing.assert_array_equal(predict_frame(CAMERA, scene, (one,)), predict_frame(CAMERA, scene))


def test_lateral_colour_moves_an_edge_as_it_moves_a_dot() -> None:
    """A vertical edge 12 px right of the axis, seen in red: the edge's profile is moved by the law at the edge's
    middle.
    """
    one = effect("lateral_chromatic_aberration")(slope_um=3.0)
    edge = KnifeEdge((EdgeRegion((4, 24, 20, 31), 0.0),), LIGHT.scale(0.1), LIGHT)
    camera = CAMERA.model_copy(update={"cfa": "MONO", "quantum_efficiency": {"Y": LINE_650}})
    plain, moved = (expected_electrons(camera, Exposure(edge, 1.0), acting) for acting in ((), (one,)))
    plain, moved = (f / relative_illumination(camera, *np.indices(f.shape)) for f in (plain, moved))
    # the sum along a row falls by contrast x shift in px: 3 um x 11.5 px / 20 px / 3 um a px at the middle, col 27
    contrast = plain[12, 31] - plain[12, 20]
    shift = (plain[12].sum() - moved[12].sum()) / contrast
    assert shift == pytest.approx(3.0 * 11.5 / 20.0 / 3.0, rel=0.02)


def test_a_pinholes_scene_is_distorted_as_the_geometry_says() -> None:
    """A board seen by an ideal pinhole, then distorted, is the board seen through the geometry: barrel of 4 % in the
    corner.
    """
    matrix = ((90.0, 0.0, 46.5), (0.0, 90.0, 34.5), (0.0, 0.0, 1.0))
    geometry = Geometry(camera_matrix=matrix, distortion=(-0.1, 0.01, 2e-3, -1e-3))
    camera = CAMERA.model_copy(update={"rows": 72, "cols": 96, "cfa": "MONO", "quantum_efficiency": {"Y": LINE_650}})
    texture = (np.indices((14, 18)).sum(axis=0) % 2).astype(np.uint8)
    board = PlanarTarget(texture, 10.0, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (-90.0, -70.0, 100.0),
                         Geometry(camera_matrix=matrix), LIGHT.scale(0.1), LIGHT)  # fmt: skip
    lens = Lens(f_number=4.0, focal_length_mm=8.0)
    camera = camera.model_copy(update={"lens": lens})
    seen = expected_electrons(camera, Exposure(replace(board, geometry=geometry), 1.0))
    moved = expected_electrons(camera, Exposure(board, 1.0), (effect("distortion")(geometry=geometry),))
    away = np.abs(moved - seen) / np.ptp(seen)
    assert np.sqrt(np.mean(away**2)) < 0.006
    assert np.mean(np.abs(expected_electrons(camera, Exposure(board, 1.0)) - seen)) / np.ptp(seen) > 0.05


def test_distortion_that_folds_the_image_is_refused() -> None:
    board = Exposure(PointArray(((5.0, 5.0),), 1.0, LIGHT.scale(0.1), LIGHT), 1.0)
    folded = Geometry(camera_matrix=((10.0, 0.0, 15.5), (0.0, 10.0, 11.5), (0.0, 0.0, 1.0)), distortion=(-0.5,))
    with pytest.raises(ValueError, match="folds the image"):
        expected_electrons(CAMERA, board, (effect("distortion")(geometry=folded),))


def test_distortion_bends_an_edge() -> None:
    """A vertical edge 19.5 px right of the axis: at the frame's ends it lies further out than in the middle, by the
    law.
    """
    one = effect("distortion")(corner_percent=5.0)
    camera = CAMERA.model_copy(update={"rows": 96, "cols": 96, "cfa": "MONO", "quantum_efficiency": {"Y": LINE_650}})
    edge = KnifeEdge((EdgeRegion((0, 60, 96, 75), 0.0),), LIGHT.scale(0.1), LIGHT)
    frames = [expected_electrons(camera, Exposure(edge, 1.0), acting) for acting in ((), (one,))]
    plain, moved = (f / relative_illumination(camera, *np.indices(f.shape)) for f in frames)
    contrast = plain[48, 90] - plain[48, 40]
    shift = (plain - moved).sum(axis=1)[[2, 48, 93]] / contrast
    # the edge lies at column 67, 19.5 px from the axis; R is 67.9 px
    x, y = 19.5, np.array([45.5, 0.5, 45.5])
    np.testing.assert_allclose(shift, 0.05 * x * (x**2 + y**2) / 67.9**2, rtol=0.08, atol=0.01)
