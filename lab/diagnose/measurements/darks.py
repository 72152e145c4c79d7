"""Dark frames: their means, the black level, and the dark signal over the field."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lab.capture_kinds.base import Capture
from lab.capture_kinds.dark import DarkCapture
from lab.diagnose.measurements.block import Block, Label, Measurement, Prediction
from lab.diagnose.measurements.line_means import LineMeans
from lab.diagnose.measurements.line_spectra import periodogram, pooled, pooled_along
from lab.errors import NotDetermined
from lab.measure.noise_figures import (
    BLACK_FLOOR_DN,
    CLIP,
    MEDIAN_OF,
    SMOOTH_PX,
    STATED_BLACK_DN,
    STATED_BLACK_SHARE,
    Image,
    from_surroundings,
    local_variance,
    robust_std,
    sound_pixels,
    without_lines,
)
from lab.measure.reads import ADDED, DARK_CURRENT, LAG, LINES
from lab.measure.study import Study, held_out_of
from sim.effects.base import Effects
from sim.sensor.lines import Lines
from sim.spectrum import FloatArray
from sim.uniform import Uniform, noise_values

TEMPERATURE_STEP_C = 1.0  # dark frames whose temperatures differ by no more are repeats
CELLS = 4, 6  # of a frame: rows, columns
LEAST_CELL_PX = 2  # least side of a cell
CELL_FLOOR_DN = 0.005  # standard deviation of a cell's mean beside noise
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
    fixed: dict[bool, DarkPattern]  # of at most `MOST_CONDITIONS` conditions
    changing: dict[bool, DarkNoise]


def conditions(study: Study) -> list[DarkCondition]:
    """Dark captures by exposure and temperature, at the most frequent gain. The last third of the repeats is held out.

    Two repeats stay together, as temporal noise needs both: in every third condition both are held out. Raises
    NotDetermined without dark captures.
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
    """Return the statistics of all dark captures by condition. Raises NotDetermined where there are none, or where the
    frames are too small to be split into cells."""
    every = conditions(study)
    least_px = LEAST_CELL_PX * max(CELLS)
    if min(study.camera.rows, study.camera.cols) < least_px:
        raise NotDetermined(
            "dark", f"frames of {study.camera.rows} x {study.camera.cols} px: their cells need {least_px} px a side"
        )
    usual = [
        c
        for c in every
        if study.temperature_c is None or c.temperature_c is None or abs(c.temperature_c - study.temperature_c) < 2.0
    ] or every
    warmest = max(every, key=lambda c: (c.temperature_c or 0.0, c.exposure_s))
    picked = list(dict.fromkeys([usual[0].name, usual[-1].name, warmest.name]))[:MOST_CONDITIONS]
    sound = study.once(sound_pixels)
    return [_read(study, c, c.name in picked, sound) for c in every]


def _read(study: Study, condition: DarkCondition, with_pattern: bool, sound: NDArray[np.bool_]) -> DarkStatistics:
    """Return the statistics of one condition. `sound` (rows, cols): mask of the pixels that count in the frames'
    means."""
    means: dict[str, float] = {}
    mean = np.zeros((study.camera.rows, study.camera.cols), np.float32)
    changing: dict[bool, _Contrasts] = {}
    fixed: dict[bool, _Mean] = {}
    for k, capture in enumerate(condition.captures):
        frame = study.recordings.frame(capture).astype(np.float32)
        means[capture.id] = float(frame.mean(dtype=np.float64, where=sound))
        level = float(frame.mean(dtype=np.float64))
        held_out = k >= len(condition.seen)
        frame -= np.float32(level)
        if k:
            changing.setdefault(held_out, _Contrasts(mean.shape)).add(
                (frame - mean) * np.float32(np.sqrt(k / (k + 1.0)))
            )
        mean += (frame - mean) / np.float32(k + 1)
        if with_pattern:
            fixed.setdefault(held_out, _Mean(mean.shape)).add(frame, capture.id)
    return DarkStatistics(
        condition,
        means,
        {out: part.pattern() for out, part in fixed.items()},
        {out: part.noise() for out, part in changing.items()},
    )


class _Contrasts:
    """What contrasts tell of the temporal noise. They are added one by one and not kept: a condition may have hundreds
    of frames."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._squares: Image = np.zeros(shape, np.float32)  # sum of squared contrasts without row and column noise
        self._variance: list[float] = []
        self._pixel: list[float] = []
        self._cells: list[float] = []
        self._excess: dict[Lines, list[float]] = {"rows": [], "columns": []}
        self._white: list[float] = []
        self._lines: dict[Lines, list[tuple[FloatArray, FloatArray, float]]] = {"rows": [], "columns": []}
        self._along: dict[Lines, list[tuple[FloatArray, FloatArray, FloatArray]]] = {"rows": [], "columns": []}

    def add(self, contrast: Image) -> None:
        std = robust_std(contrast)
        cut = np.clip(contrast, -CLIP * std, CLIP * std)
        rest, spare = without_lines(contrast, cut)
        for lines, value in spare.items():
            self._excess[lines].append(value)
        self._variance.append(float(np.mean(np.square(cut), dtype=np.float64)))
        own = robust_std(rest)
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

    def __init__(self, shape: tuple[int, ...]) -> None:
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
        return _pattern(mean, self._first, tuple(self._captures))


def _pattern(mean: Image, part: list[Image], captures: tuple[str, ...]) -> DarkPattern:
    """Return the fixed pattern of the mean of the frames of `captures`, and of the median of `part`, the first of
    them."""
    away, local = from_surroundings(part)
    z = away / local
    edges = np.array([-np.inf, -TAIL_EDGES[1], -TAIL_EDGES[0], *TAIL_EDGES, np.inf])
    counts = np.histogram(z, edges)[0].astype(float)
    low, high = np.quantile(z, [0.005, 0.995])
    # spectra and cells are of the mean frame, with defective pixels clipped
    std = robust_std(mean)
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
        spread_dn=float(np.median(local)),
        skewness=float(np.clip(3.0 * (low + high) / 5.63, 0.0, 1.0)),
    )


def cell_means(image: Image) -> FloatArray:
    """Means over `CELLS` of an image, (4, 6)."""
    r = np.linspace(0, image.shape[0], CELLS[0] + 1).astype(int)
    c = np.linspace(0, image.shape[1], CELLS[1] + 1).astype(int)
    total = np.add.reduceat(np.add.reduceat(image.astype(float), r[:-1], 0), c[:-1], 1)
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
        f"the temporal noise of dark frames is {noise:.2f} DN, below the limit of {limit_dn} DN: codes are too coarse "
        "to show how it is distributed; a higher gain would"
    )


def captures_of(frames: DarkStatistics, held_out: bool) -> tuple[str, ...]:
    """Ids of a condition's seen or held-out captures."""
    return tuple(c.id for c in (frames.condition.held_out if held_out else frames.condition.seen))


# --- The mean of dark frames by exposure, temperature and time; and the measured black level against the stated one ---


#: Most points of the grid on which the dark current over the field is evaluated. A grid much coarser than the pixels
#: moves the laws' origin and the cells' borders: with 50 DN of glow in a corner, a cell's mean is then off by a hundred
#: standard deviations.
MOST_POINTS = 1e6


def dark_current_map(study: Study, effects: Effects) -> Callable[[float | None], FloatArray]:
    """Function of the temperature (C) that returns the dark current (rows, cols), e/s: by pixel, or by squares of
    pixels where the frame has more than `MOST_POINTS` pixels."""
    camera = study.camera
    down = math.ceil(math.sqrt(camera.rows * camera.cols / MOST_POINTS))
    coarse = camera.model_copy(
        update={
            "rows": camera.rows // down,
            "cols": camera.cols // down,
            "pixel_pitch_um": camera.pixel_pitch_um * down,
        }
    )
    return Uniform(coarse, effects).dark_e_per_s


def added_dark_e_per_s(study: Study, effects: Effects) -> Callable[[float | None], float]:
    """Function of the temperature (C) that returns the change of the mean dark current by effects, without defective
    pixels, e/s."""
    if not Uniform(study.camera, effects).changes_dark_current:
        return lambda temperature_c: 0.0
    at = dark_current_map(study, effects)
    return cache(lambda temperature_c: float(at(temperature_c).mean()) - study.camera.dark_current_e_per_s)


def added_dark_dn(study: Study, effects: Effects) -> Callable[[Capture], float]:
    """Function of a capture that returns the change of its mean dark signal by effects, DN."""
    rate_at = added_dark_e_per_s(study, effects)
    return lambda capture: study.noise.gain * rate_at(capture.temperature_c) * capture.exposure_s


def dark_level_block(study: Study) -> Block:
    """Mean of every dark frame without defective pixels, DN.

    Nuisance parameters: black level and dark current. Effects may add an offset that drifts with time or temperature,
    dark current, image lag, and the converter's error at these codes. Raises NotDetermined without dark captures."""
    frames = study.once(dark_frames)
    captures = [(c, f.condition, c in f.condition.held_out) for f in frames for c in f.condition.captures]
    value = np.array([f.means[c.id] for f in frames for c in f.condition.captures])
    exposures = np.array([c.exposure_s for c, *_ in captures])
    noise, gain = study.noise, study.noise.gain
    base = noise.black + noise.dark_dn_per_s * exposures
    lines = LineMeans(study, [(c, None) for c, *_ in captures])

    def predict(effects: Effects) -> Prediction:
        offset, more, carried = study.offset(effects), added_dark_dn(study, effects), study.carried_e(effects)
        mean = base.copy()
        for i, (capture, _, _) in enumerate(captures):
            lag_e = np.mean([carried(capture, c) for c in study.channels])
            mean[i] += offset(capture) + more(capture) + gain * float(lag_e)
        model = Uniform(study.camera, effects)
        if not model.has_even_codes:
            mean = model.codes(mean[:, None] + gain * study.camera.read_noise_e * noise_values(1)).mean(axis=1)
        return Prediction(mean, study.free_offsets(exposures) | lines.jacobian(effects))

    # noise of less than about half a code doesn't dither: rounding moves the mean, by its place between two codes
    coarse = np.array([_rounding_dn(f) for f in frames for _ in f.condition.captures])
    same = np.array([[a[1] is b[1] for b in captures] for a in captures])
    # the coordinate of smoothness: 10 degrees count as twice the range of exposures
    reach = float(max(np.ptp(exposures), 1e-3))
    warmer = np.array(
        [
            0.0 if k.temperature_c is None or noise.dark_c is None else k.temperature_c - noise.dark_c
            for _, k, _ in captures
        ]
    )
    return Block(
        measurement=DARK, reach=reach, value=value, along=exposures + 2.0 * reach * warmer / 10.0,
        covariance=np.diag(np.full(len(value), noise.jitter_dn**2 + BLACK_FLOOR_DN**2)) + same * np.outer(coarse,
        coarse),
        labels=tuple(Label(c.exposure_s, "all", k.name, (c.id,), out) for c, k, out in captures),
        reads=LAG | DARK_CURRENT | {"signal.offset_dn", "codes.codes"}, scattered_by=LINES, predict=predict,
        scale=np.ones(len(value)),
    )  # fmt: skip


def _rounding_dn(frames: DarkStatistics) -> float:
    """Largest shift of a mean by rounding, DN: exp(-2 pi^2 variance) / pi, with the variance before rounding."""
    changing = next((c.variance_dn2 for c in frames.changing.values()), None)
    if changing is None:
        return 0.1
    return float(np.exp(-2.0 * np.pi**2 * max(changing - 1.0 / 12.0, 0.0)) / np.pi)


def black_level_block(study: Study) -> Block:
    """Return the measured black level against the stated one, DN. No effect changes it: a wrong statement is no effect.

    Raises NotDetermined where none is stated.
    """
    stated = study.stated.black_level_dn
    if stated is None:
        raise NotDetermined("black_level", "the black level isn't stated: nothing to hold the dark frames against")
    shortest = min(conditions(study), key=lambda c: c.exposure_s)
    std = float(np.hypot(STATED_BLACK_SHARE * stated, STATED_BLACK_DN)) + study.noise.black_std
    return Block(
        measurement=BLACK_LEVEL, reach=1.0, value=np.array([study.noise.black]),
        covariance=np.array([[std**2]]),
        labels=(Label(0.0, "all", "stated level", tuple(c.id for c in shortest.captures), False),),
        reads=frozenset(), predict=lambda effects: Prediction(np.array([stated]), {}), scale=np.array([max(stated,
        1.0)]),
    )  # fmt: skip


DARK = Measurement(
    "dark",
    title="mean level of dark frames",
    order=100,
    axis="exposure",
    unit="s",
    make=dark_level_block,
    quantity="mean level, DN",
    is_level=True,
    conditions="exposure and temperature",
)


BLACK_LEVEL = Measurement(
    "black_level",
    title="black level against the stated one",
    order=110,
    axis="exposure",
    unit="s",
    make=black_level_block,
    quantity="black level, DN",
)


# ----------------------------------------------------------------------------------------------------------------------
# The dark signal by place in the frame: glow of the read-out, other dark current that isn't uniform, and what read-out
# adds by itself.


CELL_PX = 4  # the least side of a cell


def dark_field_block(study: Study) -> Block:
    """Means over 4 x 6 cells of the mean dark frame of each condition, less the frame's mean, DN.

    The level of each mean frame is a nuisance parameter. Raises NotDetermined where cells are narrower than `CELL_PX`.
    """
    frames = [f for f in study.once(dark_frames) if f.fixed]
    points = [(f, out, part) for f in frames for out, part in f.fixed.items()]
    rows, cols = CELLS
    count = rows * cols
    if min(study.camera.rows // rows, study.camera.cols // cols) < CELL_PX:
        raise NotDetermined(
            "dark_field",
            f"frames of {study.camera.rows} x {study.camera.cols} px: too small to be split into cells, which need "
            f"{rows * CELL_PX} x {cols * CELL_PX} px",
        )
    value = np.concatenate([part.cells.ravel() - part.cells.mean() for *_, part in points])
    row, col = (g.ravel() for g in np.meshgrid(np.arange(rows), np.arange(cols), indexing="ij"))
    size = study.camera.rows * study.camera.cols / count
    changing: list[float] = []
    fixed: list[float] = []
    line_dn2: dict[Lines, float] = {"rows": 0.0, "columns": 0.0}
    for f, _, part in points:
        moving = next(iter(f.changing.values()), None)
        white = moving.white_dn2 if moving is not None else part.white_dn2
        cell = max(moving.cells_dn2, white / size) if moving is not None else white / size
        changing.append(cell / part.frames)
        fixed.append(max(part.white_dn2 - white / part.frames, 0.0) / size)
        for lines, most in line_dn2.items():
            noise = moving.line_dn2[lines] / part.frames if moving is not None else 0.0
            line_dn2[lines] = max(most, part.line_dn2[lines] - noise)
    pattern = np.eye(count) * float(np.max(fixed))
    pattern += (row[:, None] == row) * line_dn2["rows"] * rows / study.camera.rows
    pattern += (col[:, None] == col) * line_dn2["columns"] * cols / study.camera.cols
    covariance = np.kron(np.ones((len(points), len(points))), pattern) + np.diag(
        np.repeat(changing, count) + CELL_FLOOR_DN**2
    )
    exposures = np.array([f.condition.exposure_s for f, *_ in points])
    half = 0.5 * np.hypot(rows, cols)
    radius = np.hypot(row - (rows - 1) / 2, col - (cols - 1) / 2) / half

    def predict(effects: Effects) -> Prediction:
        mean = np.zeros(len(value))
        model = Uniform(study.camera, effects)
        if model.adds_signal:
            added = cell_means(model.added_e.astype(np.float32))
            mean += np.tile((study.noise.gain * (added - added.mean())).ravel(), len(points))
        if model.changes_dark_current:
            dark_at = dark_current_map(study, effects)
            for i, (f, *_) in enumerate(points):
                cells = cell_means(dark_at(f.condition.temperature_c).astype(np.float32))
                here = study.noise.gain * f.condition.exposure_s * (cells - cells.mean())
                mean[i * count : (i + 1) * count] += here.ravel()
        jacobian = {}
        for i in range(len(points)):
            column = np.zeros(len(value))
            column[i * count : (i + 1) * count] = 1.0
            jacobian[f"dark_field:{i}"] = column
        return Prediction(mean, jacobian)

    longest = max(float(exposures.max()), 1e-9)
    return Block(
        measurement=DARK_FIELD, reach=0.5, value=value, covariance=np.asarray(covariance, float),
        labels=tuple(Label(float(radius[k]), "all", f.condition.name, part.captures, out) for f, out,
        part in points for k in range(count)),
        reads=DARK_CURRENT | ADDED, predict=predict, scale=np.repeat(np.maximum(exposures / longest, 0.1), count),
    )  # fmt: skip


DARK_FIELD = Measurement(
    "dark_field",
    title="dark signal over the field",
    order=130,
    axis="field",
    unit="of half the diagonal",
    make=dark_field_block,
    quantity="dark signal less the frame's mean, DN",
    conditions="exposure and temperature",
)

