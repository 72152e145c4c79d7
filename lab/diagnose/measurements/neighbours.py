"""What the temporal noise of repeats says: its size by level, and what neighbouring pixels have of it in common.

Frames of one setting are compared with their mean after what isn't a pixel's own has been taken out, plane by plane: the frame's
level (of flats as a factor, so that shading and pixels' responses don't count where the lamp flickers), and every row's and every
column's mean (read-out and flicker by rows; what that takes from the pixels' own noise is put back). Pixels that depart by more
than `OUTLIER` standard deviations don't count for what neighbours share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lab.diagnose.measurements.summaries import (
    CLIPPED_SHARE,
    LEVEL_REACH,
    Block,
    Effects,
    Label,
    Prediction,
    Study,
)
from lab.errors import NotDetermined
from lab.fit.rounding import variance_rounding_std
from sim.camera import Cfa
from sim.sensor import mosaic
from sim.sensor.electrons import passed_on
from sim.spectrum import FloatArray
from sim.uniform import NOISE_NODES, Uniform

VARIANCE_FLOOR = 0.002  # of a variance: what clipping and rounding leave
CORRELATION_FLOOR = 3e-4  # of a correlation: what the pixels' own shares of taken-out means leave
GAIN_STD, READ_STD = 0.3, 0.3  # of the first guesses of conversion gain and dark variance
OUTLIER = 6.0
#: Values that a level is measured by; frames beyond them cost time and teach nothing.
ENOUGH = 3_000_000
LEAST_DN2 = 0.02  # a temporal variance below which nothing but rounding is seen


#: Pairs of pixels on the mosaic, by how the report calls them: (rows down, columns to the right).
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
    """Temporal noise of the repeats of one setting: by plane of the mosaic the mean above black and the variance (DN, DN^2; None
    where it is clipped), the variance's standard uncertainty as a share of it; by `PAIRS` the correlation and its uncertainty."""

    captures: tuple[str, ...]
    exposure_s: float
    gain: float  # factor on the conversion gain, of the setting in dB
    held_out: bool
    signal: dict[str, float]
    variance: dict[str, float | None]
    relative_std: dict[str, float]
    correlation: FloatArray
    correlation_std: FloatArray

    @property
    def level(self) -> float:
        return float(np.mean(list(self.signal.values())))


# --- measuring -------------------------------------------------------------------------------------------------------------


def held_out_flats(study: Study) -> frozenset[str]:
    """Flat captures that choice and fit don't see: the last third of a level's repeats where at least two are left on either side
    (noise is seen in pairs only), else every third level, counted from the darkest, never the brightest."""
    groups = study.flat_levels()
    size = {id(g): float(np.mean(list(study.levels(g[0]).whole.values()))) for g in groups}
    out: set[str] = set()
    for rank, group in enumerate(sorted(groups, key=lambda g: size[id(g)])):
        if len(group) >= 6:
            out |= {c.id for c in group[len(group) - len(group) // 3 :]}
        elif rank % 3 == 1 and rank < len(groups) - 1:
            out |= {c.id for c in group}
    return frozenset(out)


def flat_repeats(study: Study) -> list[Repeats]:
    """Of every level of light, what is seen and what is held out by themselves; darkest first."""
    out = study.once(held_out_flats)
    found = []
    for group in study.flat_levels():
        for part in ([c for c in group if c.id not in out], [c for c in group if c.id in out]):
            if len(part) > 1:
                found.append(measured(study, part, part[0].id in out))
    return sorted(found, key=lambda r: r.level)


def dark_repeats(study: Study) -> list[Repeats]:
    """Of every setting of dark frames, every third held out."""
    groups = [g for g in study.groups("dark", lambda c: (c.exposure_s, c.temperature_c, c.gain_db)) if len(g) > 1]
    return [measured(study, g, len(groups) >= 3 and i % 3 == 1) for i, g in enumerate(groups)]


def measured(study: Study, captures: Sequence[Any], held_out: bool) -> Repeats:
    """The noise of two repeats or more."""
    cfa, lit = study.camera.cfa, captures[0].kind != "dark"
    first = study.recordings.frame(captures[0])
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
    correlation, std = _correlations(frames, freedom, cfa)
    clean = {name: share < 0.1 * CLIPPED_SHARE for name, share in clipped.items()}
    moving = min(variance.values()) > LEAST_DN2
    if not (moving and (all(clean.values()) or not lit)):
        correlation = np.full(len(PAIRS), np.nan)
    # of coloured noise the estimates scatter more
    spread = 1.0 + float(np.sum(_NUMBER * np.square(np.where(np.abs(correlation) > 4.0 * std, correlation, 0.0))))
    return Repeats(
        captures=tuple(c.id for c in use),
        exposure_s=captures[0].exposure_s,
        gain=10.0 ** ((captures[0].gain_db or 0.0) / 20.0),
        held_out=held_out,
        signal=signal,
        variance={n: v if clean[n] and moving else None for n, v in variance.items()},
        relative_std={n: float(np.sqrt(2.0 * spread / (freedom * rows * cols))) for n, (rows, cols) in sizes.items()},
        correlation=correlation,
        correlation_std=std * np.sqrt(spread),
    )


def _level_out(frames: Sequence[Any], cfa: Cfa, black_dn: float | None) -> None:
    """Leave departures from the mean frame, in place; `black_dn` None: the frames' levels are no factors but sums."""
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


#: How many pairs of every kind a pixel has.
_NUMBER = np.array([2.0 * len(lags) for lags in PAIRS.values()])


def _correlations(frames: Sequence[Any], freedom: int, cfa: Cfa) -> tuple[FloatArray, FloatArray]:
    """Of standardised departures; what the taking out of rows' and columns' means took is put back."""
    rows, cols = frames[0].shape
    value, std = [], []
    for lags in PAIRS.values():
        total, count = 0.0, 0
        for down, right in lags:
            here = slice(0, rows - down), slice(max(0, -right), cols - max(0, right))
            there = slice(down, rows), slice(max(0, right), cols - max(0, -right))
            total += sum(float(np.einsum("ij,ij->", f[here], f[there], dtype=np.float64)) for f in frames)
            count += (rows - down) * (cols - abs(right))
        down, right = lags[0]
        period = 1 if cfa == "MONO" else 2
        same = down % period == 0 and right % period == 0
        lost = (period / cols if down == 0 else period / rows) if same and 0 in (down, right) else 0.0
        value.append(total / count / freedom + lost)
        std.append(1.0 / np.sqrt(count * freedom))
    return np.array(value), np.array(std)


# --- blocks ----------------------------------------------------------------------------------------------------------------


def variance_block(study: Study) -> Block:
    """Temporal variance of flats by channel against their mean: gain and read noise are free, the line isn't."""
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
    noise, camera = study.noise, study.camera
    rounding = [variance_rounding_std(v, (noise.prnu * level) ** 2) for v, level in zip(value, signal, strict=True)]
    covariance += np.diag(np.square(rounding))
    settings = sorted(set(factor.tolist()))
    light = study.field.light / study.field.light.mean()

    def predict(effects: Effects) -> Prediction:
        gain = noise.gain * factor
        electrons, slope = behind(signal / gain, light, effects, study)
        model = Uniform(camera, effects)
        shot = np.maximum(model.shot_e2(electrons), 0.0) * np.square(slope)
        read = (noise.read_dn / noise.gain) ** 2
        dn2 = gain[:, None] ** 2 * shot
        if not model.has_even_codes:
            dn2 = coded_variance(
                noise.black + gain[:, None] * electrons, dn2 + noise.read_dn**2, effects, study
            ) - np.square(noise.read_dn)
        mean = dn2.mean(1) + gain**2 * read
        jacobian = {"gain": GAIN_STD * dn2.mean(1)}
        for setting in settings:
            name = "read" if setting == 1.0 else f"read:{setting:.4g}"
            jacobian[name] = np.where(factor == setting, READ_STD * (noise.read_dn * setting) ** 2 + 0.05, 0.0)
        return Prediction(mean, jacobian)

    return Block(
        measurement="noise", axis="level", unit="DN", reach=LEVEL_REACH, along=np.log(np.maximum(signal, 1.0)), value=value, covariance=covariance,
        labels=tuple(Label(p[2], p[1], f"{p[0].exposure_s:.4g} s", p[0].captures, p[0].held_out) for p in points),
        reads=frozenset({"signal.response", "charge.variance_e2", "codes.codes"}), predict=predict, scale=value,
    )  # fmt: skip


def neighbour_block(study: Study) -> Block:
    """Correlation of the temporal noise of neighbouring pixels by level of light and in the dark: none where pixels are on their
    own, whatever gain, noise and level are."""
    points = [r for r in (*study.once(dark_repeats), *study.once(flat_repeats)) if np.all(np.isfinite(r.correlation))]
    if not points:
        raise NotDetermined(
            "noise_neighbours", "no repeats of dark or unclipped flat captures whose noise exceeds a code"
        )
    noise, camera = study.noise, study.camera
    lit = [r.level > max(20.0 * abs(noise.dark_dn_per_s) * r.exposure_s, 4.0 * noise.read_dn) for r in points]
    level = np.array([max(r.level, 1.0) for r in points])
    value = np.concatenate([r.correlation for r in points])
    std = np.concatenate([r.correlation_std for r in points])
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
                    passed_on(model.shared(electrons)),
                    read,
                    1.0 / 12.0 / gain**2,
                    kernel,
                )
            )
        return Prediction(np.concatenate(parts), {})

    return Block(
        measurement="noise_neighbours", axis="level", unit="DN", reach=LEVEL_REACH, along=np.repeat(np.log(level), len(names)),
        value=value, covariance=np.diag(np.square(std) + CORRELATION_FLOOR**2),
        labels=tuple(Label(r.level if bright else 0.0, name, f"{r.exposure_s:.4g} s" if bright else f"dark, {r.exposure_s:.4g} s", r.captures, r.held_out)
                     for r, bright in zip(points, lit, strict=True) for name in names),
        reads=frozenset({"signal.filters", "charge.correlation"}), predict=predict, scale=np.ones(len(value)),
    )  # fmt: skip


# --- predicting ------------------------------------------------------------------------------------------------------------


def channel_planes(study: Study) -> dict[str, list[str]]:
    """The mosaic's planes by channel."""
    names = list(mosaic.planes(np.zeros((2, 2)), study.camera.cfa))
    return {channel: [n for n in names if n[0] == channel] for channel in study.channels}


def behind(signal_e: FloatArray, light: FloatArray, effects: Effects, study: Study) -> tuple[FloatArray, FloatArray]:
    """Electrons (levels, points of the field) behind measured mean signals (levels,) in uniform light that falls off as `light`
    says (of mean 1), and the response's slope there: the effects' response undone by three fixed-point steps."""
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
    """Temporal variance (DN^2) of normal variables of means `dn` and variances `dn2` after the converter's codes."""
    values = dn[..., None] + np.sqrt(dn2)[..., None] * NOISE_NODES
    return np.asarray(Uniform(study.camera, effects).codes(values).var(axis=-1))


def correlations(
    cfa: Cfa,
    planes: Sequence[str],
    shot_e2: FloatArray,
    share: FloatArray,
    read_e2: float,
    rounding_e2: float,
    kernel: FloatArray | None,
) -> FloatArray:
    """What pairs of pixels have in common, by `PAIRS`, in light that is uniform but for the mosaic: the mean over the phases.

    By plane: shot noise's variance and the share of each neighbour's departure that a pixel takes over; read noise is each pixel's
    own; `kernel` filters both within a plane; rounding comes last and is each pixel's own.
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
    """Sum of each pixel's four neighbours, nothing beyond the rim."""
    wide = np.zeros((values.shape[0] + 2, values.shape[1] + 2))
    wide[1:-1, 1:-1] = values
    return np.asarray(wide[:-2, 1:-1] + wide[2:, 1:-1] + wide[1:-1, :-2] + wide[1:-1, 2:])


def _phase_of(cfa: Cfa) -> dict[str, tuple[int, int]]:
    index = np.arange(4).reshape(2, 2)
    return {name: divmod(int(plane[0, 0]), 2) for name, plane in mosaic.planes(index, cfa).items()}
