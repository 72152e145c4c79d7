"""Statistics of dark frames, from which all measurements of dark frames take their numbers. Each frame is read once.

The baseline's dark frame has the mean black level + dark current x exposure at every temperature, and normal noise and
a normal fixed pattern of independent pixels. The measurements state powers as logarithms and counts as square roots,
whose variance hardly depends on their size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from lab.capture_kinds.dark import DarkCapture
from lab.errors import NotDetermined
from lab.observables.codes.rounding import LEAST_ROUNDING_DN, QUANTISATION_DN2
from lab.observables.dataset import Dataset, held_out_of
from lab.observables.noise.line_spectra import periodogram, pooled, pooled_along
from lab.observables.noise.robust import (
    CLIP,
    MEDIAN_OF,
    SMOOTH_PX,
    Image,
    from_surroundings,
    local_variance,
    robust_std,
    sampled,
    without_lines,
)
from lab.observables.noise.side_levels import usual_darks
from sim.sensor.lines import Lines
from sim.spectrum import FloatArray

TEMPERATURE_STEP_C = 1.0  # dark frames whose temperatures differ by no more are repeats
CELLS = 4, 6  # of a frame: rows, columns
LEAST_CELL_PX = 2  # least side of a cell
THIRD_CODE = 0.02  # share of the variance of two codes beyond which pixels have a third
MOST_CONDITIONS = 3  # conditions whose fixed pattern is measured: the shortest, the longest, the warmest
#: Lower edges of the bins in which outlying pixels are counted, in standard deviations of a pixel's fixed pattern. The
#: first two count dark pixels as well, below their negatives.
TAIL_EDGES = 4.5, 6.0, 10.0, 20.0, 60.0, 200.0, 600.0


@dataclass(frozen=True)
class DarkCondition:
    """Dark captures of one exposure and temperature, seen and held out."""

    exposure_s: float
    temperature_c: float | None
    seen: tuple[DarkCapture, ...]
    held_out: tuple[DarkCapture, ...]

    @property
    def captures(self) -> tuple[DarkCapture, ...]:
        return (*self.seen, *self.held_out)

    @property
    def name(self) -> str:
        warm = "" if self.temperature_c is None else f" at {self.temperature_c:.0f} C"
        return f"{self.exposure_s:.4g} s{warm}"


@dataclass(frozen=True)
class DarkPattern:
    """The fixed pattern of one condition: statistics of the mean frame, and of the lower median of up to `MEDIAN_OF`
    frames. Each frame's mean is subtracted first."""

    frames: int  # of the mean
    of_median: int  # frames of the median
    captures: tuple[str, ...]
    cells: FloatArray  # means over `CELLS`, DN
    lines: dict[
        Lines, tuple[FloatArray, FloatArray, float]
    ]  # frequency (cy/px), power of the lines' means over that of white noise, modes of the latter
    white_dn2: float  # variance of a pixel by the part of the spectrum that is white
    parity_dn: dict[Lines, float]  # mean of odd lines less that of even ones
    line_dn2: dict[Lines, float]  # variance of the lines' means beyond that of independent pixels
    counts: FloatArray  # pixels in the bins of TAIL_EDGES, then in the two dark bins
    spread_dn: float  # standard deviation of single pixels of the median
    skewness: float  # g of these, by their quantiles z_p at p = 0.5 % and 99.5 %: z_p + z_(1 - p) = g (z_p^2 - 1) / 3


@dataclass(frozen=True)
class DarkNoise:
    """The temporal noise of one condition, from Helmert contrasts: frame k less the mean of those before it, times
    sqrt(k / (k + 1)).

    Contrasts have the variance of one frame and are independent of each other.
    """

    contrasts: int
    variance_dn2: float  # of a pixel
    pixel_dn2: float  # of a pixel, without row and column noise
    squares: Image  # sum of squared contrasts without row and column noise, over the local variance
    lines: dict[Lines, tuple[FloatArray, FloatArray, float]]  # as in DarkPattern
    along: dict[
        Lines, tuple[FloatArray, FloatArray, FloatArray]
    ]  # within lines: frequency (cy/px), power over that of white noise, modes
    white_dn2: float  # as in DarkPattern
    line_dn2: dict[Lines, float]  # as in DarkPattern
    cells_dn2: float  # variance of a cell's mean


@dataclass(frozen=True)
class DarkStatistics:
    """The statistics of one condition's dark frames, of seen (False) and of held-out ones (True)."""

    condition: DarkCondition
    means: dict[str, float]  # by capture: mean of the frame without defective pixels, DN
    mean_dn2: dict[str, float]  # by capture: variance of that mean by the pixels' noise, NaN where it isn't known
    fixed: dict[bool, DarkPattern]  # of at most `MOST_CONDITIONS` conditions
    changing: dict[bool, DarkNoise]


def contrast_weights(condition: DarkCondition, held_out: bool) -> FloatArray:
    """Return the weights (contrasts, frames) of a condition's frames in the contrasts of its seen or held-out part."""
    n, seen = len(condition.captures), len(condition.seen)
    weights = np.zeros((max(n - 1, 0), n))
    for k in range(1, n):
        weights[k - 1, :k] = -np.sqrt(k / (k + 1.0)) / k
        weights[k - 1, k] = np.sqrt(k / (k + 1.0))
    return weights[max(seen - 1, 0) :] if held_out else weights[: max(seen - 1, 0)]


def conditions(dataset: Dataset) -> list[DarkCondition]:
    """Dark captures by exposure and temperature, at the usual gain. The last third of the repeats is held out.

    Two repeats stay together, as temporal noise needs both: in every third condition both are held out. Raises
    NotDetermined without dark captures.
    """
    captures = usual_darks(dataset.recordings, dataset.side)
    if not captures:
        raise NotDetermined("dark", "no dark captures")
    groups: list[list[DarkCapture]] = []
    for c in sorted(captures, key=lambda c: (c.temperature_c is None, c.temperature_c or 0.0)):
        for group in groups:
            first = group[0]
            same = first.exposure_s == c.exposure_s and (first.temperature_c is None) == (c.temperature_c is None)
            if same and abs((first.temperature_c or 0.0) - (c.temperature_c or 0.0)) <= TEMPERATURE_STEP_C:
                group.append(c)
                break
        else:
            groups.append([c])
    place = {c.id: i for i, c in enumerate(captures)}
    groups = [sorted(g, key=lambda c: (dataset.elapsed_s(c), place[c.id])) for g in groups]
    groups.sort(key=lambda g: (g[0].exposure_s, g[0].temperature_c or 0.0))
    found = []
    for i, group in enumerate(groups):
        if len(group) == 2:
            out = {c.id for c in group} if len(groups) >= 3 and i % 3 == 1 else set()
        else:
            out = held_out_of(group, i, len(groups))
        warm = [c.temperature_c for c in group if c.temperature_c is not None]
        found.append(
            DarkCondition(
                group[0].exposure_s,
                float(np.mean(warm)) if warm else None,
                tuple(c for c in group if c.id not in out),
                tuple(c for c in group if c.id in out),
            )
        )
    return found


def usual_conditions(dataset: Dataset, every: Sequence[DarkCondition]) -> Sequence[DarkCondition]:
    """Return the conditions at the usual temperature; all where none is."""
    return [
        c
        for c in every
        if dataset.temperature_c is None
        or c.temperature_c is None
        or abs(c.temperature_c - dataset.temperature_c) < 2.0
    ] or every


def dark_frames(dataset: Dataset) -> list[DarkStatistics]:
    """Return the statistics of all dark captures by condition. Raises NotDetermined where there are none, or where the
    frames are too small to be split into cells."""
    every = conditions(dataset)
    least_px = LEAST_CELL_PX * max(CELLS)
    if min(dataset.camera.rows, dataset.camera.cols) < least_px:
        raise NotDetermined(
            "dark", f"frames of {dataset.camera.rows} x {dataset.camera.cols} px: their cells need {least_px} px a side"
        )
    usual = usual_conditions(dataset, every)
    warmest = max(every, key=lambda c: (c.temperature_c or 0.0, c.exposure_s))
    picked = list(dict.fromkeys([usual[0].name, usual[-1].name, warmest.name]))[:MOST_CONDITIONS]
    means = {
        name: (float(mean_dn), level.mean_variance_dn2)
        for level in dataset.darks.levels
        for name, mean_dn in zip(level.captures, level.frame_means(), strict=True)
    }
    return [_read(dataset, c, c.name in picked, means) for c in every]


def _read(
    dataset: Dataset, condition: DarkCondition, with_pattern: bool, means: dict[str, tuple[float, float]]
) -> DarkStatistics:
    """Return the statistics of one condition. `means`: of all frames, with their variance."""
    mean = np.zeros((dataset.camera.rows, dataset.camera.cols), np.float32)
    changing: dict[bool, _Contrasts] = {}
    fixed: dict[bool, _Mean] = {}
    for k, capture in enumerate(condition.captures):
        frame = dataset.recordings.frame(capture).astype(np.float32)
        level = float(frame.mean(dtype=np.float64))
        held_out = k >= len(condition.seen)
        frame -= np.float32(level)
        if k:
            changing.setdefault(held_out, _Contrasts(mean.shape, dataset.step_dn)).add(
                (frame - mean) * np.float32(np.sqrt(k / (k + 1.0)))
            )
        mean += (frame - mean) / np.float32(k + 1)
        if with_pattern:
            fixed.setdefault(held_out, _Mean(mean.shape, dataset.step_dn)).add(frame, capture.id)
    return DarkStatistics(
        condition,
        {c.id: means[c.id][0] for c in condition.captures},
        {c.id: means[c.id][1] for c in condition.captures},
        {out: part.pattern() for out, part in fixed.items()},
        {out: part.noise() for out, part in changing.items()},
    )


class _Contrasts:
    """What contrasts tell of the temporal noise. They are added one by one and not kept: a condition may have hundreds
    of frames."""

    def __init__(self, shape: tuple[int, ...], step_dn: float) -> None:
        self._step_dn = step_dn
        self._squares: Image = np.zeros(shape, np.float32)  # sum of squared contrasts without row and column noise
        self._variance: list[float] = []
        self._pixel: list[float] = []
        self._cells: list[float] = []
        self._excess: dict[Lines, list[float]] = {"rows": [], "columns": []}
        self._white: list[float] = []
        self._lines: dict[Lines, list[tuple[FloatArray, FloatArray, float]]] = {"rows": [], "columns": []}
        self._along: dict[Lines, list[tuple[FloatArray, FloatArray, FloatArray]]] = {"rows": [], "columns": []}

    def add(self, contrast: Image) -> None:
        std = robust_std(contrast, self._step_dn)
        cut = np.clip(contrast, -CLIP * std, CLIP * std)
        rest, spare = without_lines(contrast, cut)
        for lines, value in spare.items():
            self._excess[lines].append(value)
        self._variance.append(float(np.mean(np.square(cut), dtype=np.float64)))
        own = robust_std(rest, self._step_dn)
        self._pixel.append(float(np.mean(np.square(np.clip(rest, -CLIP * own, CLIP * own)), dtype=np.float64)))
        self._squares += np.square(rest)
        self._cells.append(float(np.mean(np.square(cell_means(cut)))))
        if len(self._white) < 6:  # more spectra add little
            power = periodogram(cut)
            self._white.append(power.level)
            for lines in self._excess:
                self._lines[lines].append(power.line(lines))
                self._along[lines].append(power.along(lines))

    def noise(self) -> DarkNoise:
        local = local_variance(self._squares, len(self._variance))
        return DarkNoise(
            contrasts=len(self._variance),
            variance_dn2=float(np.mean(self._variance)),
            pixel_dn2=float(np.mean(self._pixel)),
            squares=(self._squares / local).astype(np.float32),
            lines={lines: pooled(parts) for lines, parts in self._lines.items()},
            along={lines: pooled_along(parts) for lines, parts in self._along.items()},
            white_dn2=float(np.mean(self._white)),
            line_dn2={lines: max(float(np.mean(values)), 0.0) for lines, values in self._excess.items()},
            cells_dn2=float(np.mean(self._cells)),
        )


class _Mean:
    """The mean of frames that are added one by one. Only the first `MEDIAN_OF` are kept, for their median."""

    def __init__(self, shape: tuple[int, ...], step_dn: float) -> None:
        self._step_dn = step_dn
        self._total: Image = np.zeros(shape, np.float32)
        self._first: list[Image] = []
        self._captures: list[str] = []

    def add(self, frame: Image, capture: str) -> None:
        self._total += frame
        self._captures.append(capture)
        if len(self._first) < MEDIAN_OF:
            self._first.append(frame)

    def pattern(self) -> DarkPattern:
        mean = self._total / np.float32(len(self._captures))
        return _pattern(mean, self._first, tuple(self._captures), self._step_dn)


def _pattern(mean: Image, part: list[Image], captures: tuple[str, ...], step_dn: float) -> DarkPattern:
    """Return the fixed pattern of the mean of the frames of `captures`, and of the median of `part`, the first of
    them."""
    away, local = from_surroundings(part, step_dn)
    z = np.divide(away, local, out=away)
    edges = np.array([-np.inf, -TAIL_EDGES[1], -TAIL_EDGES[0], *TAIL_EDGES, np.inf])
    counts = np.histogram(z[np.abs(z) >= TAIL_EDGES[0]], edges)[0].astype(float)
    low, high = np.quantile(sampled(z), [0.005, 0.995])
    # spectra and cells are of the mean frame, with defective pixels clipped
    std = robust_std(mean, step_dn)
    smooth = ndimage.uniform_filter(np.clip(mean, -8.0 * std, 8.0 * std), SMOOTH_PX, mode="mirror")
    spread = np.sqrt(local_variance(np.square(mean - smooth), 1))
    mean = smooth + np.clip(mean - smooth, -CLIP * spread, CLIP * spread)
    power = periodogram(mean)
    _, excess = without_lines(mean, mean)
    return DarkPattern(
        frames=len(captures),
        of_median=len(part),
        captures=captures,
        cells=cell_means(mean),
        lines={"rows": pooled([power.line("rows")]), "columns": pooled([power.line("columns")])},
        white_dn2=power.level,
        parity_dn={
            "rows": float(mean[1::2].mean() - mean[::2].mean()),
            "columns": float(mean[:, 1::2].mean() - mean[:, ::2].mean()),
        },
        line_dn2={lines: max(value, 0.0) for lines, value in excess.items()},
        counts=np.concatenate([counts[3:], counts[1::-1]]),
        spread_dn=float(np.median(sampled(local))),
        skewness=float(np.clip(3.0 * (low + high) / 5.63, 0.0, 1.0)),
    )


def cell_means(image: Image, cells: tuple[int, int] = CELLS) -> FloatArray:
    """Return the means of an image over `cells`, rows and columns of equal parts."""
    r = np.linspace(0, image.shape[0], cells[0] + 1).astype(int)
    c = np.linspace(0, image.shape[1], cells[1] + 1).astype(int)
    total = np.add.reduceat(np.add.reduceat(image, r[:-1], 0, dtype=float), c[:-1], 1)
    return np.asarray(total / np.outer(np.diff(r), np.diff(c)))


#: Quantities of the stages by which an effect makes pixels defective.
DEFECTS = frozenset({"charge.defects", "signal.telegraph"})


def fine_conditions(step: str, frames: Sequence[DarkStatistics], least_dn: float) -> list[DarkStatistics]:
    """Conditions whose temporal noise, of a pixel, exceeds `least_dn`. Raises NotDetermined for `step` where there are
    none."""
    every = [f for f in frames if f.changing]
    if not every:
        raise NotDetermined(step, "no two dark frames of the same exposure and temperature")
    fine = [f for f in every if all(c.pixel_dn2 > least_dn**2 for c in f.changing.values())]
    if not fine:
        raise NotDetermined(step, too_coarse(every, least_dn))
    return fine


def by_part(frames: Sequence[DarkStatistics]) -> dict[bool, list[DarkNoise]]:
    """Return the temporal statistics of all conditions: seen (False) and held out (True), each only where there are
    any."""
    parts = {out: [f.changing[out] for f in frames if out in f.changing] for out in (False, True)}
    return {out: part for out, part in parts.items() if part}


def too_coarse(frames: Sequence[DarkStatistics], limit_dn: float) -> str:
    """Return the reason why dark frames of so little noise aren't judged, in one line."""
    noise = min(np.sqrt(c.pixel_dn2) for f in frames for c in f.changing.values())
    return (
        f"the temporal noise of dark frames is {noise:.2f} DN, below the limit of {limit_dn:g} DN: codes are too "
        "coarse to show how it is distributed; a higher gain would"
    )


def spread_dn2(frames: Sequence[DarkStatistics], step_dn: float) -> FloatArray:
    """Return the variance (conditions,) of pixels about their frame's mean before rounding to `step_dn`, by temporal
    noise and fixed pattern, DN^2. The pattern is the smallest one of the conditions. Of pixels at two codes alone it
    may be anything small, and is taken as 0: at a share p of one of them they have the variance p (1 - p)."""
    patterns = [
        max(part.white_dn2 - f.changing[out].white_dn2 / part.frames, 0.0)
        for f in frames
        for out, part in f.fixed.items()
        if out in f.changing
    ]
    pattern, found = min(patterns, default=0.0), []
    for f in frames:
        moving = next((c.variance_dn2 for c in f.changing.values()), None)
        single = min((part.white_dn2 for part in f.fixed.values()), default=0.0)  # one frame has both
        total = single if moving is None else moving + pattern
        share = float(np.mean(list(f.means.values()))) / step_dn % 1.0
        has_third_code = total > (1.0 + THIRD_CODE) * share * (1.0 - share) * step_dn**2
        found.append(total - QUANTISATION_DN2 * step_dn**2 if has_third_code else 0.0)
    return np.maximum(np.array(found), 0.0)


def rounding_waves_of_change_dn(change_dn: FloatArray, std_dn: float, step_dn: float) -> list[FloatArray]:
    """Return the errors by rounding, one standard deviation each, of differences that a change (n,) of means makes, DN:
    none where rounding is dithered.

    `std_dn`: of the error of a mean, a wave of one step of unknown phase. Equal means have equal errors.
    """
    turn = 2.0 * np.pi * change_dn / step_dn
    waves = [std_dn * np.sin(turn), std_dn * (np.cos(turn) - 1.0)]
    return [wave for wave in waves if np.abs(wave).max(initial=0.0) > LEAST_ROUNDING_DN * step_dn]


def captures_of(frames: DarkStatistics, held_out: bool) -> tuple[str, ...]:
    """Ids of a condition's seen or held-out captures."""
    return tuple(c.id for c in (frames.condition.held_out if held_out else frames.condition.seen))
