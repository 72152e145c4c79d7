"""Statements about lights and colours that narrowband and chart captures contradict: exchanged lights, the order
of a mosaic's colours, and a mosaic that isn't there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from lab.capture_kinds.base import Capture
from lab.capture_kinds.chart import ChartCapture
from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.diagnose.metadata.misstatement import LEFT_OUT, Misstatement, restated_camera
from lab.diagnose.policy import DEFAULT_POLICY, DecisionPolicy
from lab.errors import InputError
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import FrameCodes, RecordingSet
from lab.observables.acquisition_errors import ALIKE, alike_planes
from lab.observables.charts.chart import CHART
from lab.observables.charts.patches import patch_boxes, patch_codes
from lab.observables.flats.linearity import PHOTON_TRANSFER
from lab.observables.noise.levels import darks_near
from lab.observables.observable import Measurement
from lab.observables.spectra.narrowband import NARROWBAND
from sim.camera import CameraModel, Cfa, Side
from sim.scene.colorchecker import reflectances
from sim.sensor import mosaic
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import electron_rate

C = TypeVar("C", bound=Capture)
CLIPPED_SHARE = 0.01  # share of a plane's pixels from which on it counts as clipped
OFFSET_DN = 1.0  # uncertainty of the dark level
FEWEST_PIXELS = 8  # of a patch in a plane


@dataclass(frozen=True)
class LitPlanes:
    """The signal of a part of the frame in one light."""

    captures: tuple[str, ...]
    kind: str
    radiance: str
    wavelength_nm: float | None
    reflectance: Spectrum | None  # of a chart's patch
    rate: FloatArray  # (planes,): mean signal above dark of the mosaic's planes, row by row, DN/s; NaN where clipped
    offset: float  # uncertainty of the rates by the dark level, DN/s


def narrowband_planes(recordings: RecordingSet, side: Side) -> list[LitPlanes]:
    """Return the planes in each narrowband light: one item a wavelength, the mean of its captures."""
    darks = _dark_levels(recordings, side)
    groups: dict[float, list[NarrowbandCapture]] = {}
    for capture in _exposed(recordings.captures(NarrowbandCapture, side)):
        groups.setdefault(capture.wavelength_nm, []).append(capture)
    found = []
    for wavelength_nm, group in groups.items():
        rates = [_rates(recordings, side, capture, recordings.codes(capture), darks) for capture in group]
        found.append(
            LitPlanes(
                tuple(c.id for c in group), group[0].kind, group[0].radiance, wavelength_nm, None, np.mean(rates,
                axis=0),
                OFFSET_DN / min(c.exposure_s for c in group),
            )
        )  # fmt: skip
    return found


def chart_planes(recordings: RecordingSet, side: Side) -> list[list[LitPlanes]]:
    """Return the planes of each patch, in every light of a chart. Each plane is taken from the longest exposure that
    doesn't clip it."""
    darks = _dark_levels(recordings, side)
    groups: dict[str, list[ChartCapture]] = {}
    for capture in _exposed(recordings.captures(ChartCapture, side)):
        groups.setdefault(capture.radiance, []).append(capture)
    found = []
    for radiance, unordered in groups.items():
        group = sorted(unordered, key=lambda capture: -capture.exposure_s)
        known = reflectances(group[0].chart)
        codes = [patch_codes(recordings, capture) for capture in group]
        patches = []
        for number, (name, *_) in enumerate(patch_boxes(group[0])):
            seen = [
                _rates(recordings, side, capture, own[number], darks) for capture, own in zip(group, codes, strict=True)
            ]
            whole = np.array(seen)
            rate = whole[np.argmax(np.isfinite(whole), axis=0), np.arange(whole.shape[1])]
            offset = OFFSET_DN / group[0].exposure_s
            patches.append(
                LitPlanes(tuple(c.id for c in group), group[0].kind, radiance, None, known[name], rate, offset)
            )
        found.append(patches)
    return found


def _exposed(captures: Sequence[C]) -> list[C]:
    return [capture for capture in captures if capture.exposure_s > 0]


def _rates(
    recordings: RecordingSet, side: Side, capture: Capture, codes: FrameCodes, darks: Mapping[float, float]
) -> FloatArray:
    """Rates (planes,) in a part of a frame, DN/s above dark."""
    camera = recordings.camera(side)
    nearest = min(darks, key=lambda exposure_s: abs(np.log(max(exposure_s, 1e-9) / capture.exposure_s)))
    planes = codes.cells if mosaic.step(camera.cfa) == 2 else (codes.every,)
    found = np.full(len(planes), np.nan)
    for k, plane in enumerate(planes):
        if plane.pixels >= FEWEST_PIXELS and plane.share_from(camera.saturation_dn) < CLIPPED_SHARE:
            found[k] = (plane.mean_dn - darks[nearest]) / capture.exposure_s
    return found


def _dark_levels(recordings: RecordingSet, side: Side) -> dict[float, float]:
    """Exposure -> mean of its first dark frame, DN, of the temperature at which most lights were taken; without dark
    frames, 0 s -> the stated black level."""
    first: dict[float, Capture] = {}
    lit = [*recordings.captures(NarrowbandCapture, side), *recordings.captures(ChartCapture, side)]
    for dark in darks_near(recordings.captures(DarkCapture, side), lit):
        first.setdefault(dark.exposure_s, dark)
    found = {exposure_s: recordings.codes(dark).every.mean_dn for exposure_s, dark in first.items()}
    return found or {0.0: recordings.camera(side).black_level_dn or 0.0}


def predicted_rates(recordings: RecordingSet, camera: CameraModel, seen: Sequence[LitPlanes]) -> dict[str, FloatArray]:
    """Channel -> electrons a second in each of the lights (n,); 0 where a light's spectrum can't be used."""

    def rate(one: LitPlanes, channel: str) -> float:
        try:
            light = recordings.spectrum(one.radiance)
        except InputError:
            return 0.0
        return electron_rate(camera, channel, light, kind=one.kind, reflectance=one.reflectance)

    return {channel: np.array([rate(one, channel) for one in seen]) for channel in camera.channels}


# --- Two lights whose statements are exchanged between their captures -------------------------------------------------


@dataclass(frozen=True)
class ExchangeRule:
    """When two lights count as exchanged. Errors are rms departures of ln(rate) from its prediction."""

    out_of_line: float  # least ratio of their error to the median error of all lights
    better: float  # largest ratio of their error after the exchange to that before
    of_each: (
        bool  # whether each light has to pass: the smaller error before, the larger one after; else the rms of both
    )


#: Share of a light's brightest channel that is added to all rates: low rates count little, as low sensitivities may
#: differ by any factor.
DIM = 0.02
LEAST_ERROR = 0.005  # of ln(rate)
CHART_COLUMNS = 6  # of patches, row by row
CURVE_ORDER = 2  # degree in the wavelength of a channel's departure from the maker's curve


def exchanged_lights(
    recordings: RecordingSet, side: Side, policy: DecisionPolicy = DEFAULT_POLICY
) -> Misstatement | None:
    """Two lights whose captures fit each other's statement and not their own: narrowband lights, else lights of a
    chart. None where none is found."""
    if not recordings.captures("narrowband", side) and not recordings.captures("chart", side):
        return None
    camera = camera_model(recordings, side, maker_curves=True)
    return _narrowband(recordings, side, camera, policy) or _chart(recordings, side, camera, policy)


def _narrowband(
    recordings: RecordingSet, side: Side, camera: CameraModel, policy: DecisionPolicy
) -> Misstatement | None:
    """Two narrowband lights, by the channels' rates against the sensitivity curves. A channel may depart from its curve
    by a polynomial in the wavelength."""
    seen = [one for one in narrowband_planes(recordings, side) if np.any(np.isfinite(one.rate))]
    if len(seen) < policy.least_lights or recordings.camera(side).quantum_efficiency is None:
        return None
    expected = np.array(list(predicted_rates(recordings, camera, seen).values())).T
    phases, step = mosaic.phases(camera.cfa), mosaic.step(camera.cfa)
    rate = np.array([[one.rate[[step * r + c for r, c in phases[name]]].mean() for name in phases] for one in seen])
    known = np.isfinite(rate)  # clipped channels are NaN
    usable = known.any(axis=1) & (expected.max(axis=1) > 0)
    if usable.sum() < policy.least_lights:
        return None
    seen = [one for one, is_usable in zip(seen, usable, strict=True) if is_usable]
    rate, expected, known = rate[usable], expected[usable], known[usable]
    every = np.arange(len(seen))
    brightest = np.argmax(np.where(known, expected, -1.0), axis=1)
    expected = expected * float(np.median(rate[every, brightest] / expected[every, brightest]))
    dim = np.maximum(DIM * np.nanmax(rate, axis=1), [one.offset for one in seen])
    # ln(rate) of light i less its prediction by the statement of light j: (i, j, channels)
    left = np.log(np.where(known, np.maximum(rate, 0.0), np.nan)[:, None] + dim[:, None, None]) - np.log(
        expected[None] + dim[:, None, None]
    )
    wavelength = np.array([one.wavelength_nm or 0.0 for one in seen])
    order = min(CURVE_ORDER, len(seen) // 4)
    for levels_known in (True, False) if len(phases) > 1 else (True,):
        moved = left if levels_known else left - np.nanmean(left, axis=2, keepdims=True)
        own = moved[every, every]
        curve = np.stack([_smooth(wavelength, own[:, k], order) for k in range(own.shape[1])], axis=-1)
        errors = np.sqrt(np.nanmean(np.square(moved - curve[None]), axis=2))
        if np.median(np.diag(errors)) < policy.unknown_level_error:
            rule = ExchangeRule(policy.exchanged_out_of_line, policy.exchanged_better, of_each=True)
            return _told_exchange(recordings, side, seen, errors, NARROWBAND, rule, policy.exchanged_surer)
    return None


def _chart(recordings: RecordingSet, side: Side, camera: CameraModel, policy: DecisionPolicy) -> Misstatement | None:
    """Two lights of a chart, by the ratios of the patches' rates in every channel, which don't depend on the light's
    level or the channel's sensitivity."""
    lights = chart_planes(recordings, side)
    if len(lights) < policy.least_lights:
        return None
    step = mosaic.step(camera.cfa)
    channel_of = {step * r + c: name for name, places in mosaic.phases(camera.cfa).items() for r, c in places}
    shares = [predicted_rates(recordings, camera, patches) for patches in lights]
    count = len(lights)
    place = np.array([divmod(number, CHART_COLUMNS) for number in range(len(lights[0]))], float)
    errors = np.full((count, count), np.inf)
    for i, patches in enumerate(lights):
        rate = np.array([one.rate for one in patches])
        bright = np.nanmax(rate, initial=0.0)
        for j in range(count):
            found = []
            for plane, name in channel_of.items():
                known = np.isfinite(rate[:, plane])
                if known.sum() < len(patches) // 2 or np.nanmax(rate[:, plane]) < max(
                    0.1 * bright, 10.0 * patches[0].offset
                ):
                    continue
                found.append(
                    _pattern_error(rate[known, plane], shares[j][name][known], place[known], patches[0].offset)
                )
            if found:
                errors[i, j] = float(np.mean(found))
    usable = np.isfinite(errors).all(axis=1)
    if usable.sum() < policy.least_lights:
        return None
    return _told_exchange(
        recordings,
        side,
        [p[0] for p, ok in zip(lights, usable, strict=True) if ok],
        errors[np.ix_(usable, usable)],
        CHART,
        ExchangeRule(policy.exchanged_patches_out_of_line, policy.exchanged_patches_better, of_each=False),
        policy.exchanged_surer,
    )


def _pattern_error(rate: FloatArray, expected: FloatArray, place: FloatArray, offset: float) -> float:
    """Rms of ln(rate) less ln(expected rate) of the patches, after a level and a gradient of the light are fitted."""
    if expected.max() <= 0:
        return np.inf
    dim = max(DIM * float(rate.max()), offset)
    expected = expected * float(rate.sum() / expected.sum())
    left = np.log(np.maximum(rate, 0.0) + dim) - np.log(expected + dim)
    table = np.column_stack([np.ones(len(left)), place])
    return float(np.sqrt(np.mean(np.square(left - table @ np.linalg.lstsq(table, left, rcond=None)[0]))))


def _smooth(x: FloatArray, y: FloatArray, order: int) -> FloatArray:
    """Polynomial (n,) through the finite points with the least sum of absolute residuals, by iteratively reweighted
    least squares."""
    scaled = (x - x.mean()) / max(float(np.ptp(x)), 1e-9)
    table = np.vander(scaled, order + 1)
    known = np.isfinite(y)
    weight = np.ones(int(known.sum()))
    fitted = np.zeros(len(x))
    for _ in range(20):
        root = np.sqrt(weight)
        fitted = table @ np.linalg.lstsq(table[known] * root[:, None], y[known] * root, rcond=None)[0]
        weight = 1.0 / np.maximum(np.abs(y - fitted)[known], LEAST_ERROR)
    return np.asarray(fitted)


@dataclass(frozen=True)
class _Exchange:
    """An exchange of two lights: their numbers, and the rms of their errors before and after it."""

    first: int
    second: int
    before: float
    after: float


def _told_exchange(
    recordings: RecordingSet,
    side: Side,
    seen: Sequence[LitPlanes],
    errors: FloatArray,
    measurement: Measurement,
    rule: ExchangeRule,
    surer: float,
) -> Misstatement | None:
    """Return the exchange of two lights that fits, None where none passes `rule`, or where another with one of its
    lights leaves an error that isn't larger by 1 / `surer`. `errors` (n, n): of the captures of
    light i with the statement of light j."""
    typical = max(float(np.median(np.diag(errors))), LEAST_ERROR)
    every = [
        _Exchange(i, j, _rms(errors[i, i], errors[j, j]), _rms(errors[i, j], errors[j, i]))
        for i in range(len(seen))
        for j in range(i)
    ]
    best = min(every, key=lambda e: e.after - e.before)
    one, other = best.first, best.second
    rivals = [e for e in every if {e.first, e.second} & {one, other} and e is not best]
    before, after = best.before, best.after
    if rule.of_each:
        before, after = min(errors[one, one], errors[other, other]), max(errors[one, other], errors[other, one])
    if before < rule.out_of_line * typical or after > rule.better * before:
        return None
    if any(e.after < best.after / surer and e.before - e.after > 0.5 * (best.before - best.after) for e in rivals):
        return None
    lights = [seen[one], seen[other]]
    names = [_name(light) for light in lights]
    captures = tuple(name for light in lights for name in light.captures)
    of = [f"{light.captures[0]}{' ..' if len(light.captures) > 1 else ''}" for light in lights]
    return Misstatement(
        measurement=measurement,
        where=" and ".join(names),
        shape="two stated lights contradict their captures, and each fits the other's",
        check=f"The captures {of[0]} of the {side} camera, stated with {names[0]}, fit {names[1]}, and {of[1]}, "
        f"stated with {names[1]}, fit {names[0]} "
        f"(rms {100 * best.before:.1f} % as stated, {100 * best.after:.1f} % exchanged): they are left out; "
        "if they were exchanged, exchange the two lights, or the frames.",
        chi2_stated=(best.before / typical) ** 2,
        chi2_corrected=(best.after / typical) ** 2,
        n=2,
        captures=captures,
        corrected=recordings.without(set(captures)),
        correction=LEFT_OUT,
    )


def _rms(first: float, second: float) -> float:
    return float(np.sqrt(0.5 * (first**2 + second**2)))


def _name(light: LitPlanes) -> str:
    return light.radiance if light.wavelength_nm is None else f"{light.wavelength_nm:g} nm"


# --- A sensor without colour filters that is stated with a mosaic -----------------------------------------------------


def misstated_mosaic(
    recordings: RecordingSet, side: Side, policy: DecisionPolicy = DEFAULT_POLICY
) -> Misstatement | None:
    """Return a stated mosaic whose planes are alike in every light (`lab.observables.acquisition_errors`); None where
    they differ. The maker's curves are of colours, and are left out."""
    found = alike_planes(recordings, side)
    if found is None:
        return None
    return Misstatement(
        measurement=PHOTON_TRANSFER,
        where=f"{found.lights} light{'s' if found.lights > 1 else ''}",
        shape="the stated mosaic contradicts planes that are alike",
        check=found.told(side),
        # planes of colours differ by more than `ALIKE`
        chi2_stated=3.0 * found.lights * (ALIKE / max(found.largest, 1e-3 * ALIKE)) ** 2,
        chi2_corrected=3.0 * found.lights,
        n=3 * found.lights,
        captures=found.captures,
        corrected=restated_camera(recordings, side, cfa="MONO", quantum_efficiency=None),
    )


# ----------------------------------------------------------------------------------------------------------------------
# A stated arrangement of the mosaic's colours that the recordings contradict: planes respond to lights as another
# channel's sensitivity predicts.


MOSAICS: tuple[Cfa, ...] = ("RGGB", "BGGR", "GRBG", "GBRG")
# Errors are rms departures of ln(rate) from its prediction.
#: Share of a light's brightest plane that is added to all rates: low rates count little, as low sensitivities may
#: differ by any factor.
DIM_PLANE = 0.05
ROUNDS = 6  # steps that halve what is left of the channels' gains


def misstated_mosaic_phase(
    recordings: RecordingSet, side: Side, policy: DecisionPolicy = DEFAULT_POLICY
) -> Misstatement | None:
    """Return a stated mosaic that fits the planes' rates worse than another one; None where it fits.

    r = ln(rate of a plane) - ln(predicted rate of its channel) - level of the light - gain of the channel, over
    narrowband lights and patches of a chart. The mosaic with the least rms of r is the best. Where no sensitivity
    curves are stated, typical ones are used: wrong colours are wrong by factors.
    """
    stated = recordings.camera(side).cfa
    if stated == "MONO":
        return None
    patches = [one for light in chart_planes(recordings, side) for one in light]
    narrow = narrowband_planes(recordings, side)
    seen = [one for one in (*narrow, *patches) if np.isfinite(one.rate).sum() > 1]
    seen = [one for one in seen if np.nanmax(one.rate) > policy.mosaic_bright * one.offset]
    if len(seen) < policy.mosaic_least_lights:
        return None
    camera = camera_model(recordings, side, maker_curves=True)
    rates = predicted_rates(recordings, camera, seen)
    errors = {cfa: _error(seen, rates, cfa, policy.mosaic_most_gain) for cfa in MOSAICS}
    best, second = sorted(MOSAICS, key=lambda cfa: errors[cfa])[:2]
    if best == stated or errors[stated] < policy.mosaic_least_error:
        return None
    if errors[best] > min(policy.mosaic_better * errors[stated], policy.mosaic_surer * errors[second]):
        return None
    n = 4 * len(seen)
    # the numbers' standard deviation is estimated by the best mosaic's error
    std = max(errors[best], policy.mosaic_least_error / 3.0)
    return Misstatement(
        measurement=NARROWBAND if narrow else CHART,
        where="all lights",
        shape="the stated mosaic contradicts the colours that its planes see",
        check=f"The planes of the {side} camera answer the lights as a mosaic {best} does (rms "
        f"{100 * errors[best]:.0f} %), but cfa = {stated} is "
        f"stated (rms {100 * errors[stated]:.0f} %): correct cfa to {best}, or crop or turn the frames by even "
        "numbers of pixels, and fit again.",
        chi2_stated=n * (errors[stated] / std) ** 2,
        chi2_corrected=n * (errors[best] / std) ** 2,
        n=n,
        captures=tuple(dict.fromkeys(name for one in seen for name in one.captures)),
        corrected=restated_camera(recordings, side, cfa=best),
    )


def _error(seen: list[LitPlanes], rates: dict[str, FloatArray], cfa: Cfa, most_gain: float) -> float:
    """Rms of r (see `misstated_mosaic_phase`) for the mosaic `cfa`; logarithms of gains are `most_gain` at most."""
    rate = np.array([one.rate for one in seen])  # NaN where clipped
    expected = np.where(np.isfinite(rate), np.array([rates[channel] for channel in cfa]).T, np.nan)
    expected = expected * (np.nansum(rate, axis=1) / np.maximum(np.nansum(expected, axis=1), 1e-300))[:, None]
    dim = np.maximum(DIM_PLANE * np.nanmax(rate, axis=1), [one.offset for one in seen])[:, None]
    left = np.log(np.maximum(rate, 0.0) + dim) - np.log(expected + dim)
    channels = np.array(list(cfa))
    gain = dict.fromkeys(cfa, 0.0)
    for _ in range(ROUNDS):
        moved = left - np.array([gain[channel] for channel in cfa])
        moved = moved - np.nanmedian(moved, axis=1, keepdims=True)
        for channel in gain:
            own = moved[:, channels == channel]
            step = float(np.median(own[np.isfinite(own)])) if np.isfinite(own).any() else 0.0
            gain[channel] = float(np.clip(gain[channel] + 0.5 * step, -most_gain, most_gain))
    final = left - np.array([gain[channel] for channel in cfa])
    final = final - np.nanmean(final, axis=1, keepdims=True)
    return float(np.sqrt(np.nanmean(np.square(final))))
