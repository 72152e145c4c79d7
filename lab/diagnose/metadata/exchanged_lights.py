"""Two lights whose statements are exchanged between their captures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lab.diagnose.measurements.block import Measurement
from lab.diagnose.measurements.chart import CHART
from lab.diagnose.measurements.narrowband import NARROWBAND
from lab.diagnose.metadata.lit_planes import LitPlanes, chart_planes, narrowband_planes, predicted
from lab.diagnose.metadata.misstatement import Misstatement
from lab.diagnose.policy import DEFAULT_POLICY, DecisionPolicy
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import RecordingSet
from sim.camera import CameraModel, Side
from sim.sensor import mosaic
from sim.spectrum import FloatArray


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
    expected = np.array(list(predicted(recordings, camera, seen).values())).T
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
            return _told(recordings, side, seen, errors, NARROWBAND, rule, policy.exchanged_surer)
    return None


def _chart(recordings: RecordingSet, side: Side, camera: CameraModel, policy: DecisionPolicy) -> Misstatement | None:
    """Two lights of a chart, by the ratios of the patches' rates in every channel, which don't depend on the light's
    level or the channel's sensitivity."""
    lights = chart_planes(recordings, side)
    if len(lights) < policy.least_lights:
        return None
    step = mosaic.step(camera.cfa)
    channel_of = {step * r + c: name for name, places in mosaic.phases(camera.cfa).items() for r, c in places}
    shares = [predicted(recordings, camera, patches) for patches in lights]
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
    return _told(
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


def _told(
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
        f"(rms {100 * best.before:.1f} % as stated, {100 * best.after:.1f} % exchanged): exchange the two lights, or "
        "the frames.",
        chi2_stated=(best.before / typical) ** 2,
        chi2_corrected=(best.after / typical) ** 2,
        n=2,
        captures=captures,
        corrected=_exchanged(recordings, *lights),
    )


def _rms(first: float, second: float) -> float:
    return float(np.sqrt(0.5 * (first**2 + second**2)))


def _name(light: LitPlanes) -> str:
    return light.radiance if light.wavelength_nm is None else f"{light.wavelength_nm:g} nm"


def _exchanged(recordings: RecordingSet, one: LitPlanes, other: LitPlanes) -> RecordingSet:
    """Return the recordings with the statements of the two lights exchanged."""
    keys = ("radiance", "wavelength_nm", "bandwidth_nm")
    by_id = {c.id: c for c in recordings.manifest.captures}
    update: dict[str, dict[str, Any]] = {}
    for mine, theirs in ((one, other), (other, one)):
        for number, name in enumerate(mine.captures):
            source = by_id[theirs.captures[number % len(theirs.captures)]]
            update[name] = {key: getattr(source, key) for key in keys if hasattr(source, key)}
    captures = tuple(c.model_copy(update=update.get(c.id, {})) for c in recordings.manifest.captures)
    return recordings.under(recordings.manifest.model_copy(update={"captures": captures}))
