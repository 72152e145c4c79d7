"""Temporal noise of darks and flats: its variance by level, and what neighbouring pixels share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from lab.diagnose.measurements.block import LEVEL_REACH, Block, Label, Measurement, Prediction
from lab.errors import NotDetermined
from lab.measure.rounding import variance_rounding_std
from lab.measure.study import CLIPPED_SHARE, Study, held_out_flats
from sim.camera import Cfa
from sim.effects.base import Effects
from sim.sensor import mosaic
from sim.sensor.electrons import solve_passed_share
from sim.spectrum import FloatArray
from sim.uniform import Uniform, noise_values

OUTLIER = 6.0
#: Pixel values from which a level is measured; further frames wouldn't improve it noticeably.
ENOUGH = 3_000_000
LEAST_PLANE_PX = 4  # least side of a plane of the mosaic
LEAST_DN2 = 0.02  # temporal variance below which rounding hides the noise
#: Pairs of neighbouring pixels: name in the report -> displacements (rows down, columns to the right).
PAIRS: dict[str, tuple[tuple[int, int], ...]] = {
    "next in the row": ((0, 1),),
    "next in the column": ((1, 0),),
    "next across corners": ((1, 1), (1, -1)),
    "second in the row": ((0, 2),),
    "second in the column": ((2, 0),),
    "second across corners": ((2, 2), (2, -2)),
}


@dataclass(frozen=True)
class Repeats:
    """Temporal noise of the repeats of one setting; dictionaries are by plane of the mosaic."""

    captures: tuple[str, ...]
    exposure_s: float
    gain: float  # factor on the study's conversion gain, that of its usual setting, by the setting in dB
    held_out: bool
    signal: dict[str, float]  # mean above black, DN
    variance: dict[str, float | None]  # DN^2; None where the plane clips, or rounding hides the noise
    relative_std: dict[str, float]  # relative standard deviation of the variance
    correlation: FloatArray  # by `PAIRS`, (6,); NaN where it isn't determined
    correlation_covariance: FloatArray  # (6, 6)

    @property
    def level(self) -> float:
        """Mean signal of the planes, DN."""
        return float(np.mean(list(self.signal.values())))


def flat_repeats(study: Study) -> list[Repeats]:
    """Return the temporal noise of all repeated flat settings, seen and held-out repeats apart, darkest first."""
    out = study.once(held_out_flats)
    found = []
    for group in study.flat_levels():
        for part in ([c for c in group if c.id not in out], [c for c in group if c.id in out]):
            if len(part) > 1:
                found.append(repeats_of(study, part, part[0].id in out))
    return sorted(found, key=lambda r: r.level)


def dark_repeats(study: Study) -> list[Repeats]:
    """Return the temporal noise of all repeated dark settings, of three or more of which every third is held out."""
    groups = [g for g in study.groups("dark", lambda c: (c.exposure_s, c.temperature_c, c.gain_db)) if len(g) > 1]
    return [repeats_of(study, g, len(groups) >= 3 and i % 3 == 1) for i, g in enumerate(groups)]


def repeats_of(study: Study, captures: Sequence[Any], held_out: bool) -> Repeats:
    """Return the temporal noise of two or more repeats of one setting. Raises NotDetermined where the frames are too
    small."""
    cfa, lit = study.camera.cfa, captures[0].kind != "dark"
    first = study.recordings.frame(captures[0])
    least_px = LEAST_PLANE_PX * mosaic.step(cfa)
    if min(first.shape) < least_px:
        raise NotDetermined(
            "temporal_noise",
            f"frames of {first.shape[0]} x {first.shape[1]} px: after the means of rows and columns are removed, too "
            f"few values are left; {least_px} px a side are enough",
        )
    use = list(captures)[: max(2, int(np.ceil(ENOUGH / first.size)) + 1)]
    frames = [np.array(study.recordings.frame(c), np.float32) for c in use]
    signal, clipped = {}, {}
    for name in mosaic.planes(first, cfa):
        planes = [mosaic.planes(f, cfa)[name] for f in frames]
        clipped[name] = max(float(np.mean((p >= study.saturation_dn) | (p <= 0))) for p in planes)
        signal[name] = float(np.mean([p.mean(dtype=float) for p in planes])) - study.noise.black
    level = float(np.mean(list(signal.values())))
    dark_dn = abs(study.noise.dark_dn_per_s) * captures[0].exposure_s
    _level_out(frames, cfa, study.noise.black if lit and level > 20.0 * max(dark_dn, 1.0) else None)
    freedom = len(frames) - 1
    sizes = {name: plane.shape for name, plane in mosaic.planes(first, cfa).items()}
    variance = {}
    for name, (rows, cols) in sizes.items():
        planes = [mosaic.planes(f, cfa)[name] for f in frames]
        taken = (1.0 - 1.0 / rows) * (1.0 - 1.0 / cols)
        variance[name] = sum(float(np.mean(np.square(p), dtype=float)) for p in planes) / freedom / taken
        for plane in planes:
            np.divide(plane, np.float32(np.sqrt(max(variance[name], 1e-12))), out=plane)
            plane[np.abs(plane) > OUTLIER] = 0.0
    correlation = _correlations(frames, freedom, cfa)
    covariance = independent_correlations(first.shape, freedom, cfa)[1]
    clean = {name: share < 0.1 * CLIPPED_SHARE for name, share in clipped.items()}
    moving = min(variance.values()) > LEAST_DN2
    if not (moving and (all(clean.values()) or not lit)):
        correlation = np.full(len(PAIRS), np.nan)
    # correlation of the noise widens the standard deviations
    std = np.sqrt(np.diag(covariance))
    spread = 1.0 + float(np.sum(_NUMBER * np.square(np.where(np.abs(correlation) > 4.0 * std, correlation, 0.0))))
    return Repeats(
        captures=tuple(c.id for c in use),
        exposure_s=captures[0].exposure_s,
        gain=10.0 ** (((captures[0].gain_db or 0.0) - study.usual_gain_db) / 20.0),
        held_out=held_out,
        signal=signal,
        variance={n: v if clean[n] and moving else None for n, v in variance.items()},
        relative_std={
            n: float(np.sqrt(2.0 * spread / (freedom * (rows - 1) * (cols - 1)))) for n, (rows, cols) in sizes.items()
        },
        correlation=correlation,
        correlation_covariance=covariance * spread,
    )


def _level_out(frames: Sequence[Any], cfa: Cfa, black_dn: float | None) -> None:
    """Reduce frames, in place, to departures from their mean frame without row and column means. Levels are matched by
    factors above `black_dn`, or by subtraction where that is None."""
    for name in mosaic.planes(frames[0], cfa):
        planes = [mosaic.planes(f, cfa)[name] for f in frames]
        means = [float(p.mean(dtype=float)) for p in planes]
        for plane, mean in zip(planes, means, strict=True):
            if black_dn is None:
                np.subtract(plane, np.float32(mean), out=plane)
            else:
                np.subtract(plane, np.float32(black_dn), out=plane)
                np.multiply(plane, np.float32((np.mean(means) - black_dn) / (mean - black_dn)), out=plane)
        average = np.mean(planes, axis=0, dtype=np.float32)
        for plane in planes:
            np.subtract(plane, average, out=plane)
            np.subtract(plane, plane.mean(axis=1, keepdims=True), out=plane)
            np.subtract(plane, plane.mean(axis=0, keepdims=True), out=plane)


#: Number of pairs of each kind that a pixel belongs to.
_NUMBER = np.array([2.0 * len(lags) for lags in PAIRS.values()])


def _correlations(frames: Sequence[Any], freedom: int, cfa: Cfa) -> FloatArray:
    """Correlations (6,) of standardised departures by `PAIRS`, less their expectation for independent pixels."""
    found = []
    for lags in PAIRS.values():
        total = 0.0
        for down, right in lags:
            here, there = _moved(frames[0].shape, down, right)
            total += sum(float(np.einsum("ij,ij->", f[here], f[there], dtype=np.float64)) for f in frames)
        found.append(total / (freedom * _count(frames[0].shape, lags)))
    return np.array(found) - independent_correlations(frames[0].shape, freedom, cfa)[0]


@cache
def independent_correlations(shape: tuple[int, int], freedom: int, cfa: Cfa) -> tuple[FloatArray, FloatArray]:
    """Expectation (k,) and covariance (k, k), by `PAIRS`, of the correlations of normal, independent pixels of `shape`
    after the means of rows and columns were taken out of each plane of the mosaic.

    The departures are P z with P = G_rows x G_cols and G = 1 - sum_a u_a u_a' / n_a, where u_a marks the n_a places of
    phase a of the mosaic. A number is z'PAPz / count with A the sum of shifts S_down x S_right: its expectation is
    tr(PA), the covariance of two tr(PAPB) + tr(PAPB'), and these traces factor by rows and columns. Pairs within a
    plane are divided by the plane's measured variance with M = freedom (rows - 1) (columns - 1) degrees of freedom.
    Direction and length of a normal vector are independent, so that the expectation stays and the second moments take
    the factor M / (M + 2): exact for planes of one size."""
    period = mosaic.step(cfa)
    pairs = list(PAIRS.values())
    count = np.array([_count(shape, lags) for lags in pairs], float)
    rows, cols = (_MeansTakenOut(n, period) for n in shape)
    expected = np.array([sum(rows.trace(d) * cols.trace(r) for d, r in lags) for lags in pairs]) / count
    covariance = np.array(
        [
            [
                sum(
                    rows.trace(d, sign * e) * cols.trace(r, sign * s)
                    for d, r in one
                    for e, s in other
                    for sign in (1, -1)
                )
                for other in pairs
            ]
            for one in pairs
        ]
    ) / np.outer(count, count)  # fmt: skip
    within = np.array([all(d % period == 0 and r % period == 0 for d, r in lags) for lags in pairs])
    m = freedom * float(np.prod([n // period - 1 for n in shape]))
    both = np.outer(within, within)
    planes = period**2
    share = np.where(both, m / (m + 2.0), 1.0)
    lost = np.where(both, 2.0 / (m + 2.0) * freedom * np.outer(expected, expected) / planes, 0.0)
    return expected, (share * covariance - lost) / freedom


class _MeansTakenOut:
    """Along one side of n places: G = 1 - sum_a u_a u_a' / n_a takes out the mean of every phase a of the mosaic."""

    def __init__(self, n: int, period: int) -> None:
        self.n = n
        self._marks = np.zeros((n, period))
        for a in range(period):
            self._marks[a::period, a] = 1.0 / np.sqrt(len(range(a, n, period)))

    def trace(self, *steps: int) -> float:
        """tr(G S_a) or tr(G S_a G S_b), S_a the shift by a places with nothing beyond the ends."""
        u = self._marks
        if len(steps) == 1:
            return self._shifts(steps[0]) - float(np.sum(u * _shifted(u, steps[0])))
        a, b = steps
        ab = float(np.sum(u * _shifted(_shifted(u, b), a)))
        ba = float(np.sum(u * _shifted(_shifted(u, a), b)))
        inner = (u.T @ _shifted(u, a)) @ (u.T @ _shifted(u, b))
        return self._shifts(a, b) - ab - ba + float(np.trace(inner))

    def _shifts(self, *steps: int) -> float:
        """tr(S_a) or tr(S_a S_b)."""
        return float(max(self.n - abs(steps[0]), 0)) if sum(steps) == 0 else 0.0


def _shifted(values: FloatArray, step: int) -> FloatArray:
    """S_step values, (n, k): row i is row i + step of `values`, zero beyond."""
    out = np.zeros_like(values)
    n = len(values)
    if abs(step) < n:
        out[max(-step, 0) : n - max(step, 0)] = values[max(step, 0) : n + min(step, 0)]
    return out


def _moved(shape: tuple[int, int], down: int, right: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Slices of a frame that pair each pixel with the one `down` rows below and `right` columns to the right."""
    rows, cols = shape
    here = slice(0, rows - down), slice(max(0, -right), cols - max(0, right))
    there = slice(down, rows), slice(max(0, right), cols - max(0, -right))
    return here, there


def _count(shape: tuple[int, int], lags: Sequence[tuple[int, int]]) -> int:
    """Number of pairs with these displacements in a frame."""
    return sum((shape[0] - down) * (shape[1] - abs(right)) for down, right in lags)


# --- The temporal variance of flats against their mean: the photon transfer curve -------------------------------------


VARIANCE_FLOOR = 0.002  # relative standard deviation of a variance beside chance: rounding, a few clipped pixels
GAIN_STD, READ_STD = 0.3, 0.3  # relative prior standard deviations of conversion gain and dark variance


def variance_block(study: Study) -> Block:
    """Temporal variance of flats by channel, DN^2, against their mean signal.

    Nuisance parameters: conversion gain, and read noise at each gain setting. Raises NotDetermined for fewer than four
    variances."""
    of_channel = channel_planes(study)
    points: list[tuple[Repeats, str, float, float, float]] = []
    for repeats in study.once(flat_repeats):
        for channel, names in of_channel.items():
            values = [repeats.variance[n] for n in names]
            known = [v for v in values if v is not None]
            if len(known) < len(values):
                continue
            std = float(np.mean([repeats.relative_std[n] for n in names])) / np.sqrt(len(names))
            level = float(np.mean([repeats.signal[n] for n in names]))
            points.append((repeats, channel, level, float(np.mean(known)), std))
    if len(points) < 4:
        raise NotDetermined(
            "noise", "fewer than two repeats of unclipped flat captures: temporal noise isn't determined"
        )
    signal = np.array([p[2] for p in points])
    value = np.array([p[3] for p in points])
    factor = np.array([p[0].gain for p in points])
    covariance = np.diag(np.square(value) * (np.square([p[4] for p in points]) + VARIANCE_FLOOR**2))
    noise = study.noise
    rounding = [variance_rounding_std(v, (noise.prnu * level) ** 2) for v, level in zip(value, signal, strict=True)]
    covariance += np.diag(np.square(rounding))
    settings = sorted(set(factor.tolist()))

    def predict(effects: Effects) -> Prediction:
        shot_dn2 = shot_variance(study, signal, noise.gain * factor, effects)
        mean = shot_dn2 + np.square(noise.read_dn * factor)
        jacobian = {"gain": GAIN_STD * shot_dn2}
        for setting in settings:
            name = "read" if setting == 1.0 else f"read:{setting:.4g}"
            jacobian[name] = np.where(factor == setting, READ_STD * (noise.read_dn * setting) ** 2 + 0.05, 0.0)
        return Prediction(mean, jacobian)

    return Block(
        measurement=NOISE, reach=LEVEL_REACH, along=np.log(np.maximum(signal, 1.0)), value=value, covariance=covariance,
        labels=tuple(Label(p[2], p[1], f"{p[0].exposure_s:.4g} s", p[0].captures, p[0].held_out) for p in points),
        reads=frozenset({"signal.response", "charge.variance_e2", "codes.codes"}), predict=predict, scale=value,
    )  # fmt: skip


def shot_variance(study: Study, signal_dn: FloatArray, gain_dn_per_e: FloatArray, effects: Effects) -> FloatArray:
    """Variance (n,), DN^2, of uniform light without read noise, at mean signals above black (n,), DN, of captures with
    the given gains (n,)."""
    noise, model = study.noise, Uniform(study.camera, effects)
    light = study.field.light / study.field.light.mean()
    electrons, slope = behind(signal_dn / gain_dn_per_e, light, effects, study)
    shot = np.maximum(model.shot_e2(electrons), 0.0) * np.square(slope)
    dn2 = gain_dn_per_e[:, None] ** 2 * shot
    if not model.has_even_codes:
        dn = noise.black + gain_dn_per_e[:, None] * electrons
        dn2 = coded_variance(dn, dn2 + noise.read_dn**2, effects, study) - np.square(noise.read_dn)
    return np.asarray(dn2.mean(1))


def channel_planes(study: Study) -> dict[str, list[str]]:
    """Channel -> names of its planes of the mosaic."""
    names = list(mosaic.planes(np.zeros((2, 2)), study.camera.cfa))
    return {channel: [n for n in names if n[0] == channel] for channel in study.channels}


def behind(signal_e: FloatArray, light: FloatArray, effects: Effects, study: Study) -> tuple[FloatArray, FloatArray]:
    """Electrons (levels, points of the field) that give the measured mean signals (levels,), e, and the response's
    slope there.

    `light` (points,): relative illumination, of mean 1. A nonlinear response is inverted by three fixed-point steps.
    """
    model = Uniform(study.camera, effects)
    electrons = np.maximum(signal_e[:, None] * light, 1e-3)
    if model.is_linear:
        return electrons, np.ones_like(electrons)
    response = model.response
    wanted = np.maximum(signal_e, 1e-3)
    for _ in range(3):
        out = response(electrons).mean(1)
        electrons = np.maximum(electrons * (wanted / np.maximum(out, 1e-6))[:, None], 1e-3)
    step = 1e-3 * electrons
    return electrons, (response(electrons + step) - response(electrons - step)) / (2.0 * step)


def coded_variance(dn: FloatArray, dn2: FloatArray, effects: Effects, study: Study) -> FloatArray:
    """Variance (DN^2) of normal variables of means `dn` and variances `dn2`, in a converter's codes, by quadrature."""
    values = dn[..., None] + np.sqrt(dn2)[..., None] * noise_values(1)
    return np.asarray(Uniform(study.camera, effects).codes(values).var(axis=-1))


NOISE = Measurement(
    "noise",
    title="temporal noise against signal",
    order=220,
    axis="level",
    unit="DN",
    make=variance_block,
    quantity="temporal variance, DN²",
    of_variances=True,
)


# --- The correlation of the temporal noise of neighbouring pixels, in the dark and in uniform light -------------------


CORRELATION_FLOOR = 3e-4  # standard deviation of a correlation beside chance


def neighbour_block(study: Study) -> Block:
    """Correlation of the temporal noise of neighbouring pixels (`PAIRS`), by level of light and in the dark.

    It is 0 where pixels are independent, whatever gain, noise and level are. Raises NotDetermined without repeats whose
    noise exceeds a code.
    """
    points = [r for r in (*study.once(dark_repeats), *study.once(flat_repeats)) if np.all(np.isfinite(r.correlation))]
    if not points:
        raise NotDetermined(
            "noise_neighbours", "no repeats of dark or unclipped flat captures whose noise exceeds a code"
        )
    noise, camera = study.noise, study.camera
    lit = [r.level > max(20.0 * abs(noise.dark_dn_per_s) * r.exposure_s, 4.0 * noise.read_dn) for r in points]
    level = np.array([max(r.level, 1.0) for r in points])
    value = np.concatenate([r.correlation for r in points])
    covariance = block_diag(*(r.correlation_covariance for r in points))
    names = list(PAIRS)

    def predict(effects: Effects) -> Prediction:
        model = Uniform(camera, effects)
        kernel = model.filter_kernel()
        if kernel is None and not model.shares_shot_noise:
            return Prediction(np.zeros(len(value)), {})
        parts = []
        for r in points:
            gain = noise.gain * r.gain
            electrons = np.array([max(s, 0.0) / gain for s in r.signal.values()])
            read = max(noise.read_dn**2 - 1.0 / 12.0, 0.1 * noise.read_dn**2) / noise.gain**2
            parts.append(
                correlations(
                    camera.cfa,
                    list(r.signal),
                    np.maximum(model.shot_e2(electrons), 0.0),
                    solve_passed_share(model.neighbour_correlation(electrons)),
                    read,
                    1.0 / 12.0 / gain**2,
                    kernel,
                )
            )
        return Prediction(np.concatenate(parts), {})

    return Block(
        measurement=NOISE_NEIGHBOURS, reach=LEVEL_REACH, along=np.repeat(np.log(level), len(names)),
        value=value, covariance=covariance + CORRELATION_FLOOR**2 * np.eye(len(value)),
        labels=tuple(Label(r.level if bright else 0.0, name, f"{r.exposure_s:.4g} s" if bright else f"dark, {r.exposure_s:.4g} s", r.captures, r.held_out)  # noqa: E501
                     for r, bright in zip(points, lit, strict=True) for name in names),
        reads=frozenset({"signal.filters", "charge.correlation"}), predict=predict, scale=np.ones(len(value)),
    )  # fmt: skip


def correlations(
    cfa: Cfa,
    planes: Sequence[str],
    shot_e2: FloatArray,
    share: FloatArray,
    read_e2: float,
    rounding_e2: float,
    kernel: FloatArray | None,
) -> FloatArray:
    """Predicted correlations by `PAIRS` in uniform light, (6,): means over the phases of the mosaic.

    `shot_e2` and `share` (planes,): variance of the shot noise, and share of each neighbour's departure from its mean
    that a pixel takes over. Read noise (`read_e2`) is independent. `kernel` filters both within a plane. Rounding
    (`rounding_e2`) is added last and is independent.
    """
    period = 1 if cfa == "MONO" else 2
    at = dict.fromkeys(planes, (0, 0)) if period == 1 else _phase_of(cfa)
    variance, taken = np.zeros((period, period)), np.zeros((period, period))
    for name, v, g in zip(planes, shot_e2, share, strict=True):
        variance[at[name]], taken[at[name]] = v, g
    taps = np.ones((1, 1)) if kernel is None else kernel
    half = taps.shape[0] // 2 * period + 1
    reach = half + 2
    size = 2 * reach + 1
    offset = np.arange(size) - reach
    found = np.zeros(len(PAIRS))
    weights: dict[tuple[int, int], FloatArray] = {}  # (shot and read noise, size, size)
    for phase in np.ndindex(period, period):
        row, col = (phase[0] + offset) % period, (phase[1] + offset) % period
        own, g = variance[np.ix_(row, col)], taken[np.ix_(row, col)]
        shifted = _four_neighbours(own)
        norm = 1.0 / np.sqrt(1.0 + np.square(g) * shifted / np.maximum(own, 1e-12))
        read = np.zeros((size, size))
        middle = taps.shape[0] // 2
        for (i, j), tap in np.ndenumerate(taps):
            read[reach + (i - middle) * period, reach + (j - middle) * period] = tap
        shot = read * norm
        passed = read * norm * g
        shot = shot + _four_neighbours(passed)
        weights[phase] = np.stack([shot * np.sqrt(own), read * np.sqrt(read_e2)])
    total = {p: float(np.vdot(w, w)) + rounding_e2 for p, w in weights.items()}
    for k, lags in enumerate(PAIRS.values()):
        parts = []
        for phase, here in weights.items():
            for down, right in lags:
                other = (phase[0] + down) % period, (phase[1] + right) % period
                mine = here[:, max(down, 0) : size + min(down, 0), max(right, 0) : size + min(right, 0)]
                theirs = weights[other][:, max(-down, 0) : size - max(down, 0), max(-right, 0) : size - max(right, 0)]
                parts.append(float(np.sum(mine * theirs)) / np.sqrt(total[phase] * total[other]))
        found[k] = np.mean(parts)
    return found


def _four_neighbours(values: FloatArray) -> FloatArray:
    """Sum of each pixel's four neighbours, with zeros beyond the border."""
    wide = np.zeros((values.shape[0] + 2, values.shape[1] + 2))
    wide[1:-1, 1:-1] = values
    return np.asarray(wide[:-2, 1:-1] + wide[2:, 1:-1] + wide[1:-1, :-2] + wide[1:-1, 2:])


def _phase_of(cfa: Cfa) -> dict[str, tuple[int, int]]:
    """(row, column) of each plane in the period of the mosaic."""
    index = np.arange(4).reshape(2, 2)
    return {name: divmod(int(plane[0, 0]), 2) for name, plane in mosaic.planes(index, cfa).items()}


NOISE_NEIGHBOURS = Measurement(
    "noise_neighbours",
    title="noise correlation of neighbouring pixels",
    order=230,
    axis="level",
    unit="DN",
    make=neighbour_block,
    quantity="correlation",
    of_variances=True,
)
