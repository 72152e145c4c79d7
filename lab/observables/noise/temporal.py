"""Temporal noise of repeated frames: its variance by plane of the mosaic, and the correlation between neighbouring
pixels.

Noise is the departure of a frame from the mean of its repeats. Before, the frame's level is removed in each plane of
the mosaic (as a factor for flats, so that shading and PRNU cancel where the lamp varies), and afterwards the mean of
every row and column (row and column noise, flicker). The variance that this takes from the pixels is restored. Pixels
beyond `OUTLIER` standard deviations are left out of the correlation, of its variance and of the signal that it belongs
to: hot pixels hold much of a dark frame's noise, and none of its correlation. So are frequencies: clocks of the
read-out leave tones in a frame, of another phase in the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy import fft

from lab.errors import NotDetermined
from lab.observables.dataset import CLIPPED_SHARE, Dataset, held_out_flats
from sim.camera import Cfa
from sim.sensor import mosaic
from sim.spectrum import FloatArray

OUTLIER = 6.0
#: Passes in which the standard deviation of pixels that aren't outlying settles.
PASSES = 4
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
    gain: float  # factor on the dataset's conversion gain, that of its usual setting, by the setting in dB
    held_out: bool
    signal: dict[str, float]  # mean above black, DN
    ordinary: dict[str, float]  # the same of pixels whose mean isn't outlying, to which the correlation belongs
    variance: dict[str, float | None]  # DN^2; None where the plane clips, or rounding hides the noise
    relative_std: dict[str, float]  # relative standard deviation of the variance
    correlation: FloatArray  # by `PAIRS`, (6,); NaN where it isn't determined
    correlation_covariance: FloatArray  # (6, 6)
    tones: float  # share of the variance at frequencies that stand out, which is in no correlation
    one_tone: float  # the same of a single one that only just does

    @property
    def level(self) -> float:
        """Mean signal of the planes, DN."""
        return float(np.mean(list(self.signal.values())))


def flat_repeats(dataset: Dataset) -> list[Repeats]:
    """Return the temporal noise of all repeated flat settings, seen and held-out repeats apart, darkest first."""
    out = dataset.once(held_out_flats)
    found = []
    for group in dataset.flat_levels():
        for part in ([c for c in group if c.id not in out], [c for c in group if c.id in out]):
            if len(part) > 1:
                found.append(repeats_of(dataset, part, part[0].id in out))
    return sorted(found, key=lambda r: r.level)


def dark_repeats(dataset: Dataset) -> list[Repeats]:
    """Return the temporal noise of all repeated dark settings, of three or more of which every third is held out."""
    groups = [g for g in dataset.groups("dark", lambda c: (c.exposure_s, c.temperature_c, c.gain_db)) if len(g) > 1]
    return [repeats_of(dataset, g, len(groups) >= 3 and i % 3 == 1) for i, g in enumerate(groups)]


def repeats_of(dataset: Dataset, captures: Sequence[Any], held_out: bool) -> Repeats:
    """Return the temporal noise of two or more repeats of one setting. Raises NotDetermined where the frames are too
    small."""
    cfa, lit = dataset.camera.cfa, captures[0].kind != "dark"
    first = dataset.recordings.frame(captures[0])
    least_px = LEAST_PLANE_PX * mosaic.step(cfa)
    if min(first.shape) < least_px:
        raise NotDetermined(
            "temporal_noise",
            f"frames of {first.shape[0]} x {first.shape[1]} px: after the means of rows and columns are removed, too "
            f"few values are left; {least_px} px a side are enough",
        )
    use = list(captures)[: max(2, int(np.ceil(ENOUGH / first.size)) + 1)]
    frames = [np.array(dataset.recordings.frame(c), np.float32) for c in use]
    signal, ordinary, clipped = {}, {}, {}
    for name in mosaic.planes(first, cfa):
        planes = [mosaic.planes(f, cfa)[name] for f in frames]
        clipped[name] = max(float(np.mean((p >= dataset.saturation_dn) | (p <= 0))) for p in planes)
        signal[name] = float(np.mean([p.mean(dtype=float) for p in planes])) - dataset.noise.black
        ordinary[name] = _ordinary_mean(np.mean(planes, axis=0, dtype=np.float64)) - dataset.noise.black
    level = float(np.mean(list(signal.values())))
    dark_dn = abs(dataset.noise.dark_dn_per_s) * captures[0].exposure_s
    freedom = len(frames) - 1
    bright = lit and level > 20.0 * max(dark_dn, 1.0)
    frames, alike = level_out(frames, cfa, dataset.noise.black if bright else None)
    sizes = {name: plane.shape for name, plane in mosaic.planes(first, cfa).items()}
    variance = {}
    for name, (rows, cols) in sizes.items():
        planes = [mosaic.planes(f, cfa)[name] for f in frames]
        taken = (1.0 - 1.0 / rows) * (1.0 - 1.0 / cols)
        variance[name] = alike * sum(float(np.mean(np.square(p), dtype=float)) for p in planes) / freedom / taken
        for plane in planes:
            np.divide(plane, np.float32(np.sqrt(max(variance[name], 1e-12))), out=plane)
        _leave_out(planes, alike, freedom, taken)
    tones = [_take_out_tones(frame) for frame in frames]
    correlation = _correlations(frames, alike, freedom, cfa)
    covariance = independent_correlations(first.shape, freedom, cfa)[1]
    clean = {name: share < 0.1 * CLIPPED_SHARE for name, share in clipped.items()}
    moving = min(variance.values()) > LEAST_DN2 * dataset.step_dn**2
    if not (moving and (all(clean.values()) or not lit)):
        correlation = np.full(len(PAIRS), np.nan)
    # correlation of the noise widens the standard deviations
    std = np.sqrt(np.diag(covariance))
    spread = 1.0 + float(np.sum(_NUMBER * np.square(np.where(np.abs(correlation) > 4.0 * std, correlation, 0.0))))
    return Repeats(
        captures=tuple(c.id for c in use),
        exposure_s=captures[0].exposure_s,
        gain=10.0 ** (((captures[0].gain_db or 0.0) - dataset.usual_gain_db) / 20.0),
        held_out=held_out,
        signal=signal,
        ordinary=ordinary,
        variance={n: v if clean[n] and moving else None for n, v in variance.items()},
        relative_std={
            n: float(np.sqrt(2.0 * spread / (freedom * (rows - 1) * (cols - 1)))) for n, (rows, cols) in sizes.items()
        },
        correlation=correlation,
        correlation_covariance=covariance * spread,
        tones=float(np.mean(tones)),
        one_tone=OUTLIER**2 / first.size / freedom,
    )


def _ordinary_mean(means: FloatArray) -> float:
    """Return the mean of values (rows, cols) without those beyond `OUTLIER` standard deviations."""
    kept = means
    for _ in range(PASSES):
        beyond = np.abs(kept - np.median(kept)) > OUTLIER * kept.std()
        if not beyond.any():
            break
        kept = kept[~beyond]
    return float(kept.mean())


def _leave_out(planes: Sequence[Any], alike: int, freedom: int, taken: float) -> None:
    """Set departures (rows, cols) of one plane's frames, of variance 1, to 0 beyond `OUTLIER` standard deviations of
    the others, and scale these to variance 1, in place. `taken`: share of the variance that means of lines leave."""
    for _ in range(PASSES):
        beyond = [np.abs(plane) > OUTLIER for plane in planes]
        if not any(map(np.any, beyond)):
            return
        for plane, out in zip(planes, beyond, strict=True):
            plane[out] = 0.0
        inside = 1.0 - float(np.mean(beyond))
        square = alike * sum(float(np.mean(np.square(p), dtype=float)) for p in planes) / freedom / taken
        scale = np.float32(1.0 / np.sqrt(max(square / inside, 1e-12)))
        for plane in planes:
            np.multiply(plane, scale, out=plane)


def level_out(frames: list[Any], cfa: Cfa, black_dn: float | None) -> tuple[list[Any], int]:
    """Reduce frames, in place, to departures from their mean frame without row and column means. Levels are matched by
    factors above `black_dn`, or by subtraction where that is None.

    Returns the departures, and how many frames each stands for: of two frames, those of the second are those of the
    first with the opposite sign, and are left out."""
    for name in mosaic.planes(frames[0], cfa):
        planes = [mosaic.planes(f, cfa)[name] for f in frames]
        means = [float(p.mean(dtype=float)) for p in planes]
        for plane, mean in zip(planes, means, strict=True):
            if black_dn is None:
                np.subtract(plane, np.float32(mean), out=plane)
            else:
                np.subtract(plane, np.float32(black_dn), out=plane)
                np.multiply(plane, np.float32((np.mean(means) - black_dn) / (mean - black_dn)), out=plane)
        if len(planes) == 2:
            planes, other = planes[:1], planes[1]
            np.multiply(np.subtract(planes[0], other), np.float32(0.5), out=planes[0])
        else:
            average = np.mean(planes, axis=0, dtype=np.float32)
            for plane in planes:
                np.subtract(plane, average, out=plane)
        for plane in planes:
            np.subtract(plane, plane.mean(axis=1, keepdims=True), out=plane)
            np.subtract(plane, plane.mean(axis=0, keepdims=True), out=plane)
    return (frames[:1], 2) if len(frames) == 2 else (frames, 1)


def _take_out_tones(frame: Any) -> float:
    """Take frequencies whose power is beyond `OUTLIER`^2 times the mean out of departures, in place. Return their share
    of the power. Of independent pixels the power is distributed exponentially: 2e-16 of the frequencies are beyond."""
    spectrum = fft.rfft2(frame)
    power = np.square(np.abs(spectrum))
    is_tone = power > OUTLIER**2 * power.mean()
    if not is_tone.any():
        return 0.0
    before = float(np.vdot(frame, frame))
    frame -= fft.irfft2(np.where(is_tone, spectrum, 0.0), s=frame.shape)
    return 1.0 - float(np.vdot(frame, frame)) / before


#: Number of pairs of each kind that a pixel belongs to.
_NUMBER = np.array([2.0 * len(lags) for lags in PAIRS.values()])


def _correlations(frames: Sequence[Any], alike: int, freedom: int, cfa: Cfa) -> FloatArray:
    """Correlations (6,) of standardised departures by `PAIRS`, less their expectation for independent pixels. `alike`:
    number of frames that each stands for."""
    found = []
    for lags in PAIRS.values():
        total = 0.0
        for down, right in lags:
            here, there = _moved(frames[0].shape, down, right)
            total += sum(float(np.einsum("ij,ij->", f[here], f[there], dtype=np.float64)) for f in frames)
        found.append(alike * total / (freedom * _count(frames[0].shape, lags)))
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
