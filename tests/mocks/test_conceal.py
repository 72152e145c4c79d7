"""Every effect of the library is concealed on the bench, and the bench's frames are those that the forward model
predicts.

Predictions start from the scene and the radiometer's readings and use `sim.frame.expect_sequence`; the bench exposes
frame by frame, with its own settings, clock and temperature.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Annotated, ClassVar, Literal

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import Field
from typer.testing import CliRunner

from evaluation.live import typical_spec
from mocks.bench import MARGIN_PX, OVERSAMPLE, SCREEN_OVERSAMPLE, Bench
from mocks.command import commands
from mocks.conceal import NOT_SHOWN, OF_THE_RADIOMETER, SIDES, ConcealError, _make_effect, parse
from mocks.light_path import LightSettings
from mocks.targets import ShownCells, scene
from mocks.truth import HiddenCamera, hidden_truth
from sim.camera import Side
from sim.effects.base import Effect
from sim.effects.library import effects as library
from sim.frame import Exposure, dark_electrons, expect_sequence, read_out
from sim.scene import Darkness, Scene, ScreenPattern, UniformField
from sim.sensor.electrons import dn_moments
from sim.spectrum import FloatArray, Spectrum

SHAPE = 96, 128
PATTERN = np.random.default_rng(5).integers(0, 2, (60, 80)).astype(np.uint8)


@dataclass(frozen=True)
class Take:
    """One set-up of the bench and an exposure of it."""

    target: str = "sphere"
    exposure_s: float = 0.002
    light: LightSettings = field(default_factory=lambda: LightSettings(shutter_open=True, filter_place=2))
    pattern: bool = False
    cell_px: int = 6
    wait_s: float = 0.0


FLAT, DARK = Take(), Take("cap", 2.0)
LATER = replace(FLAT, wait_s=120.0)
SWEPT = Take(exposure_s=0.02, light=LightSettings(560.0, True, 3, 3000.0))
RED = Take(exposure_s=0.05, light=LightSettings(660.0, True, 3, 3000.0))
EDGE = Take("edge-1", 0.003)
SCREEN, BOARD, CHART = Take("screen", 0.02, pattern=True), Take("charuco-02", 0.003), Take("colorchecker", 0.003)
OVERFULL = Take("screen", 0.4, pattern=True, cell_px=40)


@dataclass(frozen=True)
class Case:
    """What is concealed, and frames of which at least one shows it; `tolerance` of chi2 over the number of pixels."""

    spec: str
    takes: tuple[Take, ...]
    tolerance: float = 0.06
    side: Side = "left"
    warm_up_c: float = 0.0


CASES = (
    Case("left:adc_nonlinearity:error_dn=40", (replace(FLAT, exposure_s=0.004),)),
    Case("left:alternating_row_noise:noise_e=6", (DARK,), tolerance=0.4),
    Case("both:ambient_light:rate_e_per_s=100000,red_over_blue=3", (FLAT, replace(FLAT, light=LightSettings()))),
    Case("left:amplifier_crosstalk:share_percent=4,excess_percent=3,pedestal_e=200", (FLAT, DARK)),
    Case("left:amplifier_glow:glow_e_per_s=300,reach_mm=0.2,corner=bottom_left", (DARK,)),
    Case("left:astigmatism:defocus_x_um=40", (EDGE, SCREEN)),
    Case("left:axial_chromatic_aberration:slope_um=40", (EDGE, SCREEN)),
    Case("left:bit_weights:third_dn=3", (DARK, FLAT)),
    Case("left:black_level_drift:drift_dn_per_min=5", (LATER, replace(DARK, wait_s=60.0))),
    Case("left:blooming:share_percent=40", (OVERFULL,)),
    Case("left:brighter_fatter:loss_percent=60,shared_percent=30", (FLAT,)),
    Case("left:charge_diffusion:length_um=2.5", (EDGE, SCREEN)),
    Case("left:charge_transfer_inefficiency:parallel_ppm=1000,release_px=2", (EDGE, CHART)),
    # 1/f noise of 96 rows has the power of some five free modes: its mean square scatters by half of itself
    Case("left:coloured_line_noise:noise_e=12,exponent=1", (DARK,), tolerance=0.6),
    Case("left:column_gain:gain_percent=8", (FLAT,)),
    Case("left:column_noise:offset_e=6,odd_even_e=4", (DARK,)),
    Case("left:coma:w131_x_um=0.5", (EDGE, SCREEN)),
    # some 220 events: their squares' sum scatters by 1 / sqrt(220)
    Case("left:cosmic_rays:rate_per_cm2_s=100000,point_share=1,point_e=1000,point_spread=0.05", (DARK,), tolerance=0.3),
    Case("left:cover_glass:thickness_mm=20", (EDGE, SCREEN)),
    Case("left:crosstalk:share_percent=4", (SWEPT, SCREEN, CHART)),
    Case("left:dark_current_temperature:doublings_per_c=0.3", (replace(DARK, wait_s=300.0),), warm_up_c=8.0),
    Case("left:decentre:shift_x_um=8", (BOARD, EDGE)),
    Case("left:defocus:defocus_um=40", (EDGE, BOARD)),
    Case("left:distortion:corner_percent=3", (BOARD, EDGE, SCREEN)),
    Case("left:etaloning:strength_percent=60,thickness_um=2", (RED,)),
    Case("left:excess_noise:excess_percent=100", (FLAT,)),
    Case("left:exposure_offset:offset_us=300", (FLAT,)),
    Case("left:field_curvature:curvature_um=60,tilt_x_um=30", (EDGE,)),
    Case("left:fringes:cos_percent=-40,optical_thickness_um=2.8", (SWEPT, RED)),
    Case("left:ghost:share_percent=10", (EDGE, SCREEN)),
    Case("left:green_imbalance:imbalance_percent=6", (FLAT, SWEPT)),
    Case("left:hot_pixels:excess_e_per_s=400,share_ppm=20000", (DARK,)),
    Case("left:image_lag:lag_percent=5", (FLAT, DARK)),
    Case("left:infrared_cut_filter:cut_wavelength_nm=650,width_nm=5", (RED, CHART)),
    Case("left:inter_pixel_capacitance:share_percent=4", (SCREEN, FLAT)),
    Case("left:lateral_chromatic_aberration:slope_um=12", (EDGE, BOARD)),
    Case("both:light_flicker:modulation_percent=20,frequency_hz=100,line_time_us=80", (FLAT, SCREEN)),
    Case("left:microlens_angle:crosstalk_percent=20,loss_percent=20,red_excess=0.3", (FLAT, SWEPT, CHART)),
    Case("left:model_discrepancy:strength=1", (SCREEN, EDGE)),
    Case("left:moffat_blur:radius_um=2.5,exponent=2.5", (EDGE, SCREEN)),
    Case("both:non_uniform_illumination:gradient_x_percent=8,gradient_y_percent=4", (FLAT, SWEPT)),
    Case("left:nonlinearity:quadratic_percent=10", (FLAT, CHART)),
    Case("left:on_chip_sharpening:strength=0.5", (replace(EDGE, exposure_s=0.0006), DARK)),
    Case("left:on_chip_smoothing:strength=0.4", (EDGE, DARK)),
    Case("left:optical_low_pass_filter:displacement_x_um=2,displacement_y_um=2", (EDGE, SCREEN)),
    Case("left:other_f_number:ratio=2", (EDGE, SCREEN)),
    Case("left:persistence:share_percent=20,release_s=4", (FLAT, replace(DARK, wait_s=1.0), replace(DARK, wait_s=2.0))),
    Case("left:phase_detection_rows:loss_percent=20,period=12,first_row=5", (FLAT, SWEPT)),
    Case("left:pixel_aperture:side_change_um=1.5", (SCREEN,)),
    # the bench's lamp bends by 5 % for each 100 nm, where the library's doesn't: 0.16 of the change at 380 nm
    Case("both:lamp_ageing:reddening_percent=20", (FLAT, CHART), tolerance=0.2),
    Case("both:radiometer_nonlinearity:exponent_percent=12,growth=0.5", (SWEPT,)),
    Case("left:random_telegraph_noise:amplitude_e=40,share_percent=10", (DARK,)),
    # half of the power is in a frame's few slowest waves
    Case("left:reading_order_noise:noise_e=6,alternating_e=6,exponent=0.7", (DARK,), tolerance=0.6),
    Case("left:row_gain:gain_percent=8", (FLAT,)),
    Case("left:row_noise:noise_e=4,offset_e=4", (DARK,), tolerance=0.4),
    Case("both:screen_gamma:exponent=2.5", (SCREEN,)),
    Case("both:screen_pixel_structure:amplitude_percent=60", (replace(SCREEN, cell_px=8),)),
    Case("left:shutter_leakage:last_row_us=400,read_last=top", (FLAT,)),
    Case("both:source_bandwidth:width_nm=20", (RED, SWEPT)),
    Case("both:source_drift:drift_percent_per_min=5", (FLAT, LATER)),
    Case("left:spherical_aberration:w040_um=0.4", (EDGE, SCREEN)),
    Case("both:stereo_gain_mismatch:gain_percent=10", (CHART, SCREEN, FLAT), side="right"),
    Case("both:stray_light:share_percent=10", (RED, SWEPT)),
    Case("left:taps:gain_percent=8,quarter_offset_e=6", (FLAT, DARK)),
    Case("left:tree_rings:amplitude_percent=8,period_um=30", (FLAT, SWEPT)),
    Case("left:trefoil:w333_x_um=0.4", (EDGE, SCREEN)),
    Case("left:turbulent_air:width_um=2.5", (EDGE, SCREEN)),
    Case("left:secondary_astigmatism:cos_um=0.4", (EDGE, SCREEN)),
    Case("left:secondary_coma:cos_um=0.4", (EDGE, SCREEN)),
    Case("left:tetrafoil:cos_um=0.5", (EDGE, SCREEN)),
    Case("left:veiling_glare:share_percent=20,halo_share=0.5", (EDGE, BOARD)),
    Case("both:vibration_blur:amplitude_x_um=3", (EDGE, SCREEN)),
    Case("left:vignetting:corner_loss_percent=30", (FLAT, SCREEN)),
    Case("left:vignetting_decentre:fall_off_percent=30,centre_x=0.4", (FLAT,)),
    Case("both:wavelength_offset:offset_nm=6", (SWEPT, RED)),
)


#: What changes neither means nor variances of pixels.
BETWEEN_PIXELS = frozenset({"coloured_read_noise"})
SHORT_S = 0.001  # without dark current


def every_case() -> tuple[Case, ...]:
    """`CASES`, and each effect that they lack at its typical size, in all usual frames."""
    tried = {case.spec.split(":")[1] for case in CASES} | BETWEEN_PIXELS
    rest = sorted(set(library()) - tried - set(NOT_SHOWN))
    return (*CASES, *(Case(typical_spec(name), (FLAT, SWEPT, RED, EDGE, SCREEN, CHART, DARK)) for name in rest))


def test_no_effect_is_tried_that_the_bench_refuses() -> None:
    assert not {case.spec.split(":")[1] for case in CASES} & set(NOT_SHOWN)


def set_up(bench: Bench, take: Take) -> ShownCells:
    bench.set_wavelength(take.light.wavelength_nm)
    bench.set_filter(take.light.filter_place)
    bench.set_slit_um(take.light.slit_um)
    bench.set_shutter(take.light.shutter_open)
    bench.place(take.target)
    bench.clock.sleep(take.wait_s)
    if not take.pattern:
        return ShownCells()
    pattern = PATTERN[: 960 // take.cell_px, : 1800 // take.cell_px]
    bench.show(pattern, take.cell_px)
    return ShownCells(pattern, take.cell_px)


def read_by(bench: Bench, kind: str) -> UniformField:
    """The radiance of the sphere as a session knows it: the mean of some readings of the radiometer."""
    readings = [bench.radiance() for _ in range(8)]
    mean = np.mean([reading.value for reading in readings], axis=0)
    return UniformField(Spectrum.of(readings[0].arrays[0], mean), kind=kind)


def predicted(
    camera: HiddenCamera, exposures: Sequence[Exposure], effects: tuple[Effect, ...], gains: Sequence[float]
) -> list[tuple[FloatArray, FloatArray]]:
    """Mean and variance (DN) of every frame of a sequence, by the forward model, an unsteady source's light as it was;
    `gains` of the light."""
    found = []
    model = camera.model
    fine = any(isinstance(exposure.scene, ScreenPattern) for exposure in exposures)
    means = expect_sequence(
        model,
        exposures,
        effects,
        oversample=SCREEN_OVERSAMPLE if fine else OVERSAMPLE,
        margin_px=MARGIN_PX,
        drawn=True,
    )
    for exposure, electrons, gain in zip(exposures, means, gains, strict=True):
        dark = dark_electrons(model, exposure, effects)
        lit = dark + (electrons - dark) * gain
        out = read_out(model, exposure, effects)
        found.append(dn_moments(lit, model, 0.0, out, camera.pattern, dark_electrons=dark))
    return found


@cache
def healthy(take: Take, side: Side) -> tuple[FloatArray, FloatArray]:
    """The frames of a camera that conceals nothing."""
    bench = Bench(1, concealed={}, shape=SHAPE)
    camera = bench._truth.cameras[side]
    seen = scene(camera, take.target, take.light, set_up(bench, take))
    exposure = Exposure(seen, take.exposure_s, temperature_c=camera.model.dark_current_reference_c)
    return predicted(camera, [exposure], (), [1.0])[0]


def chi2(frame: NDArray[np.uint16], moments: tuple[FloatArray, FloatArray]) -> float:
    """Mean squared departure of a frame over its variance, where it isn't clipped."""
    mean, variance = moments
    return float(np.mean(((frame - mean) ** 2)[variance > 0.1] / variance[variance > 0.1]))


@pytest.mark.parametrize("case", every_case(), ids=lambda case: case.spec.split(":")[1])
def test_the_bench_shows_what_the_forward_model_predicts(case: Case) -> None:
    bench = Bench(1, concealed=parse([case.spec]), shape=SHAPE, warm_up_c=case.warm_up_c)
    camera = bench._truth.cameras[case.side]
    (effect,) = camera.effects
    of_radiometer = effect.name in OF_THE_RADIOMETER
    frames, exposures, gains = [], [], []
    began_s = bench.clock.now() + case.takes[0].wait_s
    for take in case.takes:
        shown = set_up(bench, take)
        seen: Scene = scene(camera, take.target, take.light, shown)
        if of_radiometer:
            assert isinstance(seen, UniformField)
            seen = read_by(bench, seen.kind)
        elapsed_s, temperature_c = bench.clock.now() - began_s, bench.sensor_temperature_c(case.side)
        exposures.append(Exposure(seen, take.exposure_s, 0.0, temperature_c, elapsed_s))
        uniform = isinstance(seen, UniformField | Darkness)
        gains.append(1.0 if uniform else 1.0 + 0.01 * getattr(effect, "gain_percent", 0.0))
        frames.append(bench.expose(case.side, take.exposure_s))
    told = predicted(camera, exposures, (effect,), gains)
    untold = [
        predicted(camera, [exposure], (), [1.0])[0] if of_radiometer else healthy(take, case.side)
        for take, exposure in zip(case.takes, exposures, strict=True)
    ]
    departures = [abs(chi2(frame, moments) - 1.0) for frame, moments in zip(frames, untold, strict=True)]
    assert max(departures) > 3.0 * case.tolerance, departures
    # 12 288 pixels: one standard deviation is 0.013, more where rows or neighbours have noise in common
    for take, frame, moments in zip(case.takes, frames, told, strict=True):
        assert chi2(frame, moments) == pytest.approx(1.0, abs=case.tolerance), (take, departures)


@pytest.mark.parametrize(("correlation", "decay"), [(-0.3, 0.0), (0.4, 0.4)])
def test_read_noise_of_neighbours_is_correlated_as_stated(correlation: float, decay: float) -> None:
    """12 288 pixels: one standard deviation is 0.009, and 0.02 with what neighbours have in common."""
    concealed = parse([f"left:coloured_read_noise:correlation={correlation},decay={decay}"])
    bench = Bench(1, concealed=concealed, shape=SHAPE)
    set_up(bench, DARK)
    camera = bench._truth.cameras["left"]
    exposure = Exposure(Darkness(), SHORT_S, temperature_c=camera.model.dark_current_reference_c)
    mean, variance = predicted(camera, [exposure], camera.effects, [1.0])[0]
    away = (bench.expose("left", SHORT_S) - mean) / np.sqrt(variance)
    share = (camera.model.read_noise_e * camera.model.conversion_gain_dn_per_e) ** 2 / float(np.median(variance))
    assert share > 0.5
    for distance, stated in ((1, correlation), (2, correlation * decay)):
        found = float(np.mean(away[:, distance:] * away[:, :-distance]))
        assert found == pytest.approx(share * stated, abs=0.06)


@pytest.mark.parametrize("name", ["stray_light:share_percent=20", "source_drift:drift_percent_per_min=10"])
def test_what_goes_wrong_behind_the_radiometer_is_not_in_its_readings(name: str) -> None:
    told, plain = (Bench(1, concealed=concealed, shape=(8, 8)) for concealed in (parse([f"both:{name}"]), {}))
    for bench in (told, plain):
        set_up(bench, SWEPT)
        bench.expose("left", 0.1)
        bench.clock.sleep(60.0)
    assert np.array_equal(told.radiance().value, plain.radiance().value)


def test_a_healthy_bench_conceals_nothing() -> None:
    truth = hidden_truth(3, {})
    for side in SIDES:
        assert truth.cameras[side].effects == ()
        # white: neighbours have nothing in common, columns no offset
        prnu, dsnu = truth.cameras[side].pattern.prnu, truth.cameras[side].pattern.dsnu_e
        assert abs(np.mean(prnu[:, 1:] * prnu[:, :-1]) / prnu.var()) < 4.0 / np.sqrt(prnu.size)
        assert dsnu.mean(axis=0).var() / dsnu.var() * len(dsnu) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 640.0))


@pytest.mark.parametrize(
    ("spec", "complaint"),
    [
        ("middle:defocus:defocus_um=3", "'middle' is no side"),
        ("left:frobnication:x=1", "no effect named 'frobnication'; `calibench effects` lists them"),
        ("left:defocus:depth=3", "no parameter 'depth'; write PARAMETER=VALUE with defocus_um"),
        ("left:defocus:defocus_um", "no parameter 'defocus_um'; write PARAMETER=VALUE"),
        ("left:defocus:defocus_um=900", "above the upper limit 200.0 um"),
        ("left:defocus:defocus_um=22um", "defocus_um: '22um' is no number; give one, which is in um, without a unit"),
        ("left:defocus:defocus_um=nan", "'nan' is no number"),
        ("left:Defocuss:defocus_um=2", "did you mean defocus? `calibench effects` lists them"),
        ("left:defocus", "nothing of defocus would be there"),
        ("left:source_drift:drift_percent_per_min=1", "write both:source_drift"),
        ("both:stereo_time_offset:delay_ms=3", "every target of this bench stands still"),
        ("left:amplifier_glow:glow_e_per_s=1,corner=middle", "'top_left'"),
        ("left:defocus:defocus_um=1,defocus_um=2", "given twice"),
    ],
)
def test_what_cannot_be_concealed_is_one_line(spec: str, complaint: str) -> None:
    with pytest.raises(ConcealError) as raised:
        parse([spec])
    assert complaint in str(raised.value)
    assert spec in str(raised.value)
    assert "\n" not in str(raised.value)


class _Rows(Effect):
    name: ClassVar[str] = "rows"
    period: Annotated[Literal[4, 8], Field(description="rows from one to the next")] = 8
    first_row: Annotated[int, Field(description="first of them", ge=0, lt=8)] = 0


def test_integer_choices_are_concealed() -> None:
    assert _make_effect("left:rows:period=4,first_row=3", _Rows, "period=4,first_row=3") == _Rows(period=4, first_row=3)
    for text, complaint in (("period=5", "Input should be 4 or 8"), ("first_row=9", "less than 8")):
        with pytest.raises(ConcealError, match=complaint):
            _make_effect(f"left:rows:{text}", _Rows, text)


def test_an_effect_is_concealed_once() -> None:
    with pytest.raises(ConcealError, match="on the left already"):
        parse(["both:defocus:defocus_um=3", "left:defocus:defocus_um=4"])


def test_effects_of_the_rig_are_the_same_for_both() -> None:
    one = parse(["both:source_drift:drift_percent_per_min=1"])["left"]
    with pytest.raises(ConcealError, match="of the rig"):
        Bench(concealed={"left": one})


@pytest.mark.parametrize(
    ("arguments", "environment", "complaint"),
    [
        (("--conceal", "left:defocus:depth=3"), "", "no parameter 'depth'"),
        ((), "left:defocus:defocus_um=3; left:defocus:depth=3", "no parameter 'depth'"),
        (("--healthy", "--conceal", "left:defocus:defocus_um=3"), "", "--healthy conceals nothing"),
        (("--warm-up", "nan"), "", "--warm-up nan: beyond 40 degrees"),
    ],
)
def test_the_command_refuses_in_one_line(arguments: tuple[str, ...], environment: str, complaint: str) -> None:
    done = CliRunner().invoke(commands, ["bench", *arguments], env={"CALIBENCH_CONCEAL": environment})
    assert done.exit_code == 2
    assert complaint in done.stderr
    assert done.stderr.count("\n") == 1
