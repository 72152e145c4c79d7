"""Statistics of dark frames: each is read once, and every measurement of dark frames takes its numbers from here.

The baseline's dark frame is black level + dark current x exposure, the same at every temperature, with normal noise and a normal
fixed pattern of independent pixels. Powers and counts, whose size may be of any order of magnitude, are kept as logarithms or
square roots: their noise then hardly depends on their size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lab.capture_kinds.dark import DarkCapture
from lab.diagnose.measurements.held_out import held_out_of
from lab.diagnose.measurements.line_spectra import Image, periodogram, pooled, pooled_along
from lab.diagnose.measurements.pixel_outliers import (
    CLIP,
    MEDIAN_OF,
    SMOOTH_PX,
    from_surroundings,
    local_variance,
    robust_std,
    sound_pixels,
    without_lines,
)
from lab.diagnose.measurements.study import Study
from lab.errors import NotDetermined
from sim.sensor.lines import Lines
from sim.spectrum import FloatArray

TEMPERATURE_STEP_C = 1.0  # dark frames whose temperatures are that close are repeats
CELLS = 4, 6  # of a frame: rows, columns
LEAST_CELL_PX = 2  # a side of the smallest frame's cells
CELL_FLOOR_DN = 0.005
MOST_CONDITIONS = 3  # exposures whose fixed pattern is looked at: the shortest, the longest, the warmest
#: Edges of the counted bins, in standard deviations of a pixel's fixed pattern; below minus the first and second the dark ones.
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
    """Statistics of what frames of one condition have in common: of their mean, and of the lower median of some, each frame's level
    subtracted."""

    frames: int
    of_median: int
    captures: tuple[str, ...]
    cells: FloatArray  # CELLS, DN
    lines: dict[
        Lines, tuple[FloatArray, FloatArray, float]
    ]  # frequency, power over the white level's, number of its modes
    white_dn2: float  # variance of independent pixels
    parity_dn: dict[Lines, float]  # mean of odd lines less that of even ones
    line_dn2: dict[Lines, float]  # variance of the lines' means beyond the pixels' own
    counts: FloatArray  # of TAIL_EDGES, upwards, then the two downwards
    spread_dn: float  # of single pixels of the median
    skewness: float  # of the bulk of these, by its quantiles at 0.5 %: z_p + z_(1 - p) = g (z_p^2 - 1) / 3


@dataclass(frozen=True)
class DarkNoise:
    """Statistics of what differs from frame to frame of one condition.

    They are taken from Helmert contrasts: every frame less the mean of those before it, scaled to the variance of one frame. Contrasts are
    independent of each other.
    """

    contrasts: int
    variance_dn2: float  # of a pixel
    pixel_dn2: float  # the same without what lines have in common
    squares: Image  # sum of squared contrasts, over its surroundings' variance
    lines: dict[Lines, tuple[FloatArray, FloatArray, float]]
    along: dict[
        Lines, tuple[FloatArray, FloatArray, FloatArray]
    ]  # within lines: frequency, power over the level, modes
    white_dn2: float
    line_dn2: dict[Lines, float]
    cells_dn2: float  # variance of a cell's mean, measured


@dataclass(frozen=True)
class DarkStatistics:
    """The statistics of one condition's dark frames."""

    condition: DarkCondition
    means: dict[str, float]
    fixed: dict[bool, DarkPattern]  # by whether they are held out; of at most `MOST_CONDITIONS` conditions
    changing: dict[bool, DarkNoise]


def conditions(study: Study) -> list[DarkCondition]:
    """Dark captures by exposure and temperature, at the gain that most have; the last third of the repeats is held out.

    Of two repeats both are seen, as noise needs both: then every third condition is held out.
    """
    captures = study.recordings.captures(DarkCapture, study.side)
    if not captures:
        raise NotDetermined("dark", "no dark captures")
    gains = [c.gain_db for c in captures]
    usual = max(dict.fromkeys(gains), key=gains.count)
    groups: list[list[DarkCapture]] = []
    for c in sorted(
        (c for c in captures if c.gain_db == usual),
        key=lambda c: (c.temperature_c is None, c.temperature_c or 0.0),
    ):
        for group in groups:
            first = group[0]
            same = first.exposure_s == c.exposure_s and (first.temperature_c is None) == (c.temperature_c is None)
            if same and abs((first.temperature_c or 0.0) - (c.temperature_c or 0.0)) <= TEMPERATURE_STEP_C:
                group.append(c)
                break
        else:
            groups.append([c])
    place = {c.id: i for i, c in enumerate(captures)}
    groups = [sorted(g, key=lambda c: (study.elapsed_s(c), place[c.id])) for g in groups]
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


def dark_frames(study: Study) -> list[DarkStatistics]:
    """Every dark capture, read once. Raises NotDetermined where there are none, or the frames are too small to be split into cells."""
    every = conditions(study)
    least_px = LEAST_CELL_PX * max(CELLS)
    if min(study.camera.rows, study.camera.cols) < least_px:
        raise NotDetermined(
            "dark", f"frames of {study.camera.rows} x {study.camera.cols} px: their cells need {least_px} px a side"
        )
    usual = [c for c in every if study.temperature_c is None or c.temperature_c is None or abs(c.temperature_c - study.temperature_c) < 2.0] or every  # fmt: skip
    warmest = max(every, key=lambda c: (c.temperature_c or 0.0, c.exposure_s))
    picked = list(dict.fromkeys([usual[0].name, usual[-1].name, warmest.name]))[:MOST_CONDITIONS]
    sound = study.once(sound_pixels)
    return [_read(study, c, c.name in picked, sound) for c in every]


def _read(study: Study, condition: DarkCondition, with_pattern: bool, sound: NDArray[np.bool_]) -> DarkStatistics:
    """`sound` (rows, cols): the pixels that count in the frames' means."""
    means: dict[str, float] = {}
    mean = np.zeros((study.camera.rows, study.camera.cols), np.float32)
    contrasts: dict[bool, list[Image]] = {False: [], True: []}
    stacks: dict[bool, list[Image]] = {False: [], True: []}
    for k, capture in enumerate(condition.captures):
        frame = study.recordings.frame(capture).astype(np.float32)
        means[capture.id] = float(frame.mean(dtype=np.float64, where=sound))
        level = float(frame.mean(dtype=np.float64))
        held_out = k >= len(condition.seen)
        frame -= np.float32(level)
        if k:
            contrasts[held_out].append((frame - mean) * np.float32(np.sqrt(k / (k + 1.0))))
        mean += (frame - mean) / np.float32(k + 1)
        if with_pattern:
            stacks[held_out].append(frame)
    changing = {out: _changing(part) for out, part in contrasts.items() if part}
    # without a contrast of these frames (a single one) any other's variance is taken
    variance = next((c.variance_dn2 for c in changing.values()), None)
    ids = {False: [c.id for c in condition.seen], True: [c.id for c in condition.held_out]}
    fixed = {out: _fixed(part, tuple(ids[out]), variance) for out, part in stacks.items() if part}
    return DarkStatistics(condition, means, fixed, changing)


def _changing(contrasts: list[Image]) -> DarkNoise:
    total = np.zeros_like(contrasts[0])
    variance: list[float] = []
    pixel: list[float] = []
    white: list[float] = []
    cells: list[float] = []
    rows, cols, along_rows, along_cols = [], [], [], []
    excess: dict[Lines, list[float]] = {"rows": [], "columns": []}
    for contrast in contrasts:
        std = robust_std(contrast)
        cut = np.clip(contrast, -CLIP * std, CLIP * std)
        rest, spare = without_lines(contrast, cut)
        for lines, value in spare.items():
            excess[lines].append(value)
        variance.append(float(np.mean(np.square(cut), dtype=np.float64)))
        own = robust_std(rest)
        pixel.append(float(np.mean(np.square(np.clip(rest, -CLIP * own, CLIP * own)), dtype=np.float64)))
        total += np.square(rest)
        cells.append(float(np.mean(np.square(cell_means(cut)))))
        if len(white) < 6:  # more spectra don't add much
            power = periodogram(cut)
            white.append(power.level)
            rows.append(power.line("rows"))
            cols.append(power.line("columns"))
            along_rows.append(power.along("rows"))
            along_cols.append(power.along("columns"))
    local = local_variance(total, len(contrasts))
    return DarkNoise(
        contrasts=len(contrasts),
        variance_dn2=float(np.mean(variance)),
        pixel_dn2=float(np.mean(pixel)),
        squares=(total / local).astype(np.float32),
        lines={"rows": pooled(rows), "columns": pooled(cols)},
        along={"rows": pooled_along(along_rows), "columns": pooled_along(along_cols)},
        white_dn2=float(np.mean(white)),
        line_dn2={lines: max(float(np.mean(values)), 0.0) for lines, values in excess.items()},
        cells_dn2=float(np.mean(cells)),
    )


def _fixed(frames: list[Image], captures: tuple[str, ...], variance_dn2: float | None) -> DarkPattern:
    mean: Image = np.asarray(np.mean(frames, axis=0, dtype=np.float32))
    part = frames[:MEDIAN_OF]
    away, local = from_surroundings(part)
    z = away / local
    edges = np.array([-np.inf, -TAIL_EDGES[1], -TAIL_EDGES[0], *TAIL_EDGES, np.inf])
    counts = np.histogram(z, edges)[0].astype(float)
    low, high = np.quantile(z, [0.005, 0.995])
    # smooth structure and lines: the mean, defective pixels clipped
    std = robust_std(mean)
    smooth = ndimage.uniform_filter(np.clip(mean, -8.0 * std, 8.0 * std), SMOOTH_PX, mode="mirror")
    spread = np.sqrt(local_variance(np.square(mean - smooth), 1))
    mean = smooth + np.clip(mean - smooth, -CLIP * spread, CLIP * spread)
    power = periodogram(mean)
    _, excess = without_lines(mean, mean)
    return DarkPattern(
        frames=len(frames),
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
        spread_dn=float(np.median(local)),
        skewness=float(np.clip(3.0 * (low + high) / 5.63, 0.0, 1.0)),
    )


def cell_means(image: Image) -> FloatArray:
    r = np.linspace(0, image.shape[0], CELLS[0] + 1).astype(int)
    c = np.linspace(0, image.shape[1], CELLS[1] + 1).astype(int)
    total = np.add.reduceat(np.add.reduceat(image.astype(float), r[:-1], 0), c[:-1], 1)
    return np.asarray(total / np.outer(np.diff(r), np.diff(c)))


#: Quantities of the stages that dark frames' pixels and lines depend on.
DEFECTS = frozenset({"charge.defects", "signal.telegraph"})


def fine_conditions(step: str, frames: Sequence[DarkStatistics], least_dn: float) -> list[DarkStatistics]:
    """Conditions whose temporal noise is at least `least_dn`. Raises NotDetermined where there are none."""
    every = [f for f in frames if f.changing]
    if not every:
        raise NotDetermined(step, "no two dark frames of the same exposure and temperature")
    fine = [f for f in every if all(c.pixel_dn2 > least_dn**2 for c in f.changing.values())]
    if not fine:
        raise NotDetermined(step, too_coarse(every, least_dn))
    return fine


def by_part(frames: Sequence[DarkStatistics]) -> dict[bool, list[DarkNoise]]:
    """The temporal statistics by whether they are held out; without a part that has none."""
    parts = {out: [f.changing[out] for f in frames if out in f.changing] for out in (False, True)}
    return {out: part for out, part in parts.items() if part}


def too_coarse(frames: Sequence[DarkStatistics], limit_dn: float) -> str:
    noise = min(np.sqrt(c.pixel_dn2) for f in frames for c in f.changing.values())
    return f"the temporal noise of dark frames is {noise:.2f} DN, below the limit of {limit_dn} DN: codes are too coarse to show how it is distributed; a higher gain would"


def captures_of(frames: DarkStatistics, held_out: bool) -> tuple[str, ...]:
    return tuple(c.id for c in (frames.condition.held_out if held_out else frames.condition.seen))
