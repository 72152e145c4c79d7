"""What dark frames say: level and noise by exposure, temperature and time, lines that share a disturbance, a glow, odd pixels.

Every dark capture is read once (`dark_frames`). The baseline's dark frame is black level + dark current x exposure, the same at
every temperature, with normal noise and a normal fixed pattern in single pixels: all of these are free. Numbers whose size is
free over decades (powers, counts) are kept as logarithms or roots, in which their noise doesn't depend on what made them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage
from scipy.special import betainc, chdtrc, chdtri, digamma, gammaln, ndtr, polygamma, xlogy

from lab.capture_kinds.dark import DarkCapture
from lab.diagnose.measurements.summaries import (
    BLACK_FLOOR_DN,
    LAG,
    STATED_BLACK_DN,
    STATED_BLACK_SHARE,
    Block,
    Effects,
    Label,
    Prediction,
    Study,
    held_out_of,
)
from lab.errors import NotDetermined
from sim.sensor.lines import Lines
from sim.spectrum import FloatArray
from sim.uniform import Uniform

Image = NDArray[np.float32]

TEMPERATURE_STEP_C = 1.0  # dark frames whose temperatures are that close are repeats
CELLS = 4, 6  # of a frame: rows, columns
CELL_FLOOR_DN = 0.005
MOST_CONDITIONS = 3  # exposures whose fixed pattern is looked at: the shortest, the longest, the warmest
BANDS = 6  # of a spectrum over lines
LEVEL_BAND = 0.04, 0.2  # cy/px, along both axes: where a spectrum's level is taken
POWER_FLOOR = 0.02  # of a band's power: what isn't quite white in a healthy read-out
VARIANCE_FLOOR = 0.004  # of a temporal variance
LEAST_COUNTED_DN = 0.6  # the same of single pixels, whose far tail counts
LEAST_LINE_DN = 0.3  # the same of lines' means
LEAST_NOISE_DN = 0.4  # below, codes are too coarse to say what the temporal noise is
CLIP = 4.5  # standard deviations at which single pixels are cut off where they don't count
MEDIAN_OF = 5  # frames at most, whose median is looked at for odd pixels
#: Edges of the counted bins, in standard deviations of a pixel's fixed pattern; below minus the first and second the dark ones.
TAIL_EDGES = 4.5, 6.0, 10.0, 20.0, 60.0
#: Of the first edge, which one pixel in 1e5 passes by chance: edges of the bins of temporal variance.
BLINK_EDGES = 1.0, 1.6, 2.6, 5.0, 12.0
BLINK_CHANCE = 1e-5
SMOOTH_PX, LOCAL_PX = 9, 33  # boxes over which a pixel's surroundings and their noise are taken
JUMPS = 256  # draws of which frames of a jumping pixel are high
#: What a root of a count may be off by beside chance (about 1 where many are expected): one odd pixel more is no finding.
COUNT_STD = 0.6


# --- reading ----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Condition:
    """Dark captures of one exposure and temperature: those that choice and fit may see, and those that they don't."""

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
class Fixed:
    """What some frames of one condition have in common: their mean and the lower median of some of them, both less black level."""

    frames: int
    of_median: int
    captures: tuple[str, ...]
    cells: FloatArray  # CELLS, DN
    lines: dict[
        Lines, tuple[FloatArray, FloatArray, float]
    ]  # frequency, power over the white level's, number of its modes
    white_dn2: float  # power of single pixels
    parity_dn: dict[Lines, float]  # odd lines less even ones
    line_dn2: dict[Lines, float]  # variance of the lines' means beyond the pixels' own
    counts: FloatArray  # of TAIL_EDGES, upwards, then the two downwards
    spread_dn: float  # of single pixels of the median
    skewness: float  # of the bulk of these, by its quantiles at 0.5 %: z_p + z_(1 - p) = g (z_p^2 - 1) / 3


@dataclass(frozen=True)
class Changing:
    """What differs from frame to frame of one condition: contrasts of every frame to the mean of those before it, each with the
    variance of one frame and independent of the others (Helmert)."""

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
class Frames:
    """All that is kept of one condition."""

    condition: Condition
    means: dict[str, float]
    fixed: dict[bool, Fixed]  # held out or seen; only those of `MOST_CONDITIONS`
    changing: dict[bool, Changing]


def conditions(study: Study) -> list[Condition]:
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
            Condition(
                group[0].exposure_s,
                float(np.mean(warm)) if warm else None,
                tuple(c for c in group if c.id not in out),
                tuple(c for c in group if c.id in out),
            )
        )
    return found


def dark_frames(study: Study) -> list[Frames]:
    """Every dark capture, read once."""
    every = conditions(study)
    usual = [c for c in every if study.temperature_c is None or c.temperature_c is None or abs(c.temperature_c - study.temperature_c) < 2.0] or every  # fmt: skip
    warmest = max(every, key=lambda c: (c.temperature_c or 0.0, c.exposure_s))
    picked = list(dict.fromkeys([usual[0].name, usual[-1].name, warmest.name]))[:MOST_CONDITIONS]
    return [_read(study, c, c.name in picked) for c in every]


def _read(study: Study, condition: Condition, with_pattern: bool) -> Frames:
    means: dict[str, float] = {}
    mean = np.zeros((study.camera.rows, study.camera.cols), np.float32)
    contrasts: dict[bool, list[Image]] = {False: [], True: []}
    stacks: dict[bool, list[Image]] = {False: [], True: []}
    for k, capture in enumerate(condition.captures):
        frame = study.recordings.frame(capture).astype(np.float32)
        means[capture.id] = level = float(frame.mean(dtype=np.float64))
        held_out = k >= len(condition.seen)
        frame -= np.float32(level)
        if k:
            contrasts[held_out].append((frame - mean) * np.float32(np.sqrt(k / (k + 1.0))))
        mean += (frame - mean) / np.float32(k + 1)
        if with_pattern:
            stacks[held_out].append(frame)
    changing = {out: _changing(part) for out, part in contrasts.items() if part}
    # the first frame of a condition all of which is held out has no contrast, and neither has a lone one
    variance = next((c.variance_dn2 for c in changing.values()), None)
    ids = {False: [c.id for c in condition.seen], True: [c.id for c in condition.held_out]}
    fixed = {out: _fixed(part, tuple(ids[out]), variance) for out, part in stacks.items() if part}
    return Frames(condition, means, fixed, changing)


def _changing(contrasts: list[Image]) -> Changing:
    total = np.zeros_like(contrasts[0])
    variance: list[float] = []
    pixel: list[float] = []
    white: list[float] = []
    cells: list[float] = []
    rows, cols, along_rows, along_cols = [], [], [], []
    excess: dict[Lines, list[float]] = {"rows": [], "columns": []}
    for contrast in contrasts:
        std = _robust_std(contrast)
        cut = np.clip(contrast, -CLIP * std, CLIP * std)
        rest, spare = _without_lines(contrast, cut)
        for lines, value in spare.items():
            excess[lines].append(value)
        variance.append(float(np.mean(np.square(cut), dtype=np.float64)))
        own = _robust_std(rest)
        pixel.append(float(np.mean(np.square(np.clip(rest, -CLIP * own, CLIP * own)), dtype=np.float64)))
        total += np.square(rest)
        cells.append(float(np.mean(np.square(_cell_means(cut)))))
        if len(white) < 6:  # spectra of more are known well enough
            power = _power(cut)
            white.append(power.level)
            rows.append(power.line("rows"))
            cols.append(power.line("columns"))
            along_rows.append(power.along("rows"))
            along_cols.append(power.along("columns"))
    local = _local_variance(total, len(contrasts))
    return Changing(
        contrasts=len(contrasts),
        variance_dn2=float(np.mean(variance)),
        pixel_dn2=float(np.mean(pixel)),
        squares=(total / local).astype(np.float32),
        lines={"rows": _pooled(rows), "columns": _pooled(cols)},
        along={"rows": _pooled_along(along_rows), "columns": _pooled_along(along_cols)},
        white_dn2=float(np.mean(white)),
        line_dn2={lines: max(float(np.mean(values)), 0.0) for lines, values in excess.items()},
        cells_dn2=float(np.mean(cells)),
    )


def _fixed(frames: list[Image], captures: tuple[str, ...], variance_dn2: float | None) -> Fixed:
    mean: Image = np.asarray(np.mean(frames, axis=0, dtype=np.float32))
    part = frames[:MEDIAN_OF]
    level = [f - _row_means(f)[:, None] for f in part]
    median: Image = np.sort(np.array(level), axis=0)[(len(part) - 1) // 2]
    # odd pixels: against their surroundings, lines taken out, in units of the surroundings' own spread
    std = _robust_std(median)
    flat, _ = _without_lines(median, np.clip(median, -CLIP * std, CLIP * std))
    step = 2
    for r in range(step):
        for c in range(step):
            phase = flat[r::step, c::step]
            phase -= np.float32(np.mean(np.clip(phase, -CLIP * std, CLIP * std)))
    around = ndimage.uniform_filter(np.clip(flat, -CLIP * std, CLIP * std), SMOOTH_PX, mode="mirror")
    steep = np.clip(flat - around, -CLIP * std, CLIP * std)
    # a second pass keeps hot pixels beside a glow from pulling at it
    around += ndimage.uniform_filter(steep, SMOOTH_PX, mode="mirror")
    away = flat - around
    local = np.sqrt(np.maximum(_local_variance(np.square(away), 1), 0.25)) * np.sqrt(
        SMOOTH_PX**2 / (SMOOTH_PX**2 - 1.0)
    )
    z = away / local
    edges = np.array([-np.inf, -TAIL_EDGES[1], -TAIL_EDGES[0], *TAIL_EDGES, np.inf])
    counts = np.histogram(z, edges)[0].astype(float)
    low, high = np.quantile(z, [0.005, 0.995])
    # smooth structure and lines: the mean, odd pixels cut off
    std = _robust_std(mean)
    smooth = ndimage.uniform_filter(np.clip(mean, -8.0 * std, 8.0 * std), SMOOTH_PX, mode="mirror")
    spread = np.sqrt(_local_variance(np.square(mean - smooth), 1))
    mean = smooth + np.clip(mean - smooth, -CLIP * spread, CLIP * spread)
    power = _power(mean)
    _, excess = _without_lines(mean, mean)
    return Fixed(
        frames=len(frames),
        of_median=len(part),
        captures=captures,
        cells=_cell_means(mean),
        lines={"rows": _pooled([power.line("rows")]), "columns": _pooled([power.line("columns")])},
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


def _robust_std(image: Image) -> float:
    """Standard deviation of the bulk: what lies beyond five of it doesn't count. Half a code at least."""
    low, high = np.quantile(image.ravel()[:: max(image.size // 200_000, 1)], [0.02, 0.98])
    std = max(float(high - low) / 4.107, 0.3)
    for _ in range(3):
        inside = image[np.abs(image) < 5.0 * std]
        std = max(float(inside.std(dtype=np.float64)), 0.25)
    return std


def _row_means(image: Image) -> Image:
    std = _robust_std(image)
    return np.asarray(np.clip(image, -CLIP * std, CLIP * std).mean(axis=1))


def _without_lines(image: Image, cut: Image) -> tuple[Image, dict[Lines, float]]:
    """An image less the means of its rows and columns (of `cut`), and the variance that neighbouring lines' means have beyond what
    single pixels give them: by their differences, which nothing smooth changes."""
    rows, cols = cut.mean(axis=1, dtype=np.float64), cut.mean(axis=0, dtype=np.float64)
    own = float(np.var(np.diff(cut, axis=1), dtype=np.float64)) / 2.0
    spare: dict[Lines, float] = {
        "rows": float(np.var(np.diff(rows))) / 2.0 - own / cut.shape[1],
        "columns": float(np.var(np.diff(cols))) / 2.0 - own / cut.shape[0],
    }
    mean = float(cut.mean(dtype=np.float64))
    return (image - (rows - mean)[:, None].astype(np.float32) - cols[None, :].astype(np.float32)), spare


def _local_variance(squares: Image, freedom: int) -> Image:
    """Variance of a pixel by its surroundings, pixels far beyond it cut off."""
    usual = float(np.mean(np.minimum(squares, 16.0 * freedom * np.median(squares) / 0.45)))
    cap = np.float32(64.0 * usual)
    rough = ndimage.uniform_filter(np.minimum(squares, cap), LOCAL_PX, mode="mirror")
    cap_here = 16.0 * rough if freedom == 1 else (1.0 + 12.0 / np.sqrt(freedom)) * rough
    fine = ndimage.uniform_filter(np.minimum(squares, cap_here), LOCAL_PX, mode="mirror")
    return np.asarray(np.maximum(fine / np.float32(freedom), np.float32(1e-3)))


def _cell_means(image: Image) -> FloatArray:
    r = np.linspace(0, image.shape[0], CELLS[0] + 1).astype(int)
    c = np.linspace(0, image.shape[1], CELLS[1] + 1).astype(int)
    total = np.add.reduceat(np.add.reduceat(image.astype(float), r[:-1], 0), c[:-1], 1)
    return np.asarray(total / np.outer(np.diff(r), np.diff(c)))


# --- spectra ----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Power:
    """Periodogram of one image, of level sigma^2 for white noise; the rows' frequencies by the columns' (only from 0 on)."""

    table: FloatArray
    rows: FloatArray
    cols: FloatArray
    cells: int

    @property
    def _level(self) -> FloatArray:
        low, high = LEVEL_BAND
        inside = ((np.abs(self.rows) >= low) & (np.abs(self.rows) <= high))[:, None] & (
            (self.cols >= low) & (self.cols <= high)
        )[None, :]
        return self.table[inside]

    @property
    def level(self) -> float:
        return max(float(self._level.mean()), 1e-12)

    def line(self, lines: Lines) -> tuple[FloatArray, FloatArray, float]:
        """(frequency, power over the level) of the lines' means, up to and without 0.5 cy/px; number of the level's modes."""
        table, frequency = (self.table[:, 0], self.rows) if lines == "rows" else (self.table[0], self.cols)
        use = (frequency > 0) & (frequency < 0.4999)
        return frequency[use], table[use] / self.level, float(self._level.size)

    def along(self, lines: Lines) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(frequency, power over the level, modes) within rows (columns), mean over these without what a line has in common."""
        if lines == "rows":
            inside, frequency = self.table[np.abs(self.rows) > 1.5 / len(self.rows)], self.cols
            power, modes = inside.mean(axis=0), float(len(inside))
        else:
            inside, frequency = self.table[:, self.cols > 0.75 / len(self.cols)], self.rows
            power, modes = inside.mean(axis=1), float(inside.shape[1])
            # negative frequencies are others
            power = 0.5 * (power + np.roll(power[::-1], 1))
            modes *= 2.0
        use = (frequency > 0) & (frequency <= LEVEL_BAND[0])
        return frequency[use], power[use] / self.level, np.full(int(use.sum()), modes)


def _power(image: Image) -> _Power:
    spectrum = fft.rfft2(image - np.float32(image.mean(dtype=np.float64)))
    table = (spectrum.real.astype(float) ** 2 + spectrum.imag.astype(float) ** 2) / image.size
    return _Power(table, fft.fftfreq(image.shape[0]), fft.rfftfreq(image.shape[1]), image.size)


def _pooled(parts: list[tuple[FloatArray, FloatArray, float]]) -> tuple[FloatArray, FloatArray, float]:
    """Mean over contrasts of (frequency, relative power); its level's modes add up."""
    return parts[0][0], np.mean([p for _, p, _ in parts], axis=0), float(sum(m for *_, m in parts))


def _pooled_along(parts: list[tuple[FloatArray, FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray, FloatArray]:
    return parts[0][0], np.mean([p for _, p, _ in parts], axis=0), np.sum([m for *_, m in parts], axis=0)


@dataclass(frozen=True)
class _Bands:
    """A spectrum's bands: their edges in the list of frequencies, and their middles."""

    first: NDArray[np.intp]
    last: NDArray[np.intp]
    middle: FloatArray

    @staticmethod
    def of(frequency: FloatArray, count: int, power: float = 1.0) -> _Bands:
        """`power` above 1: narrower ones towards low frequencies, of two frequencies at least."""
        share = np.linspace(0.0, 1.0, min(count, max(len(frequency) // 3, 1)) + 1) ** power
        edges = np.unique(np.rint(len(frequency) * share).astype(int))
        edges = edges[np.append(np.diff(edges) > 1, True)]
        edges[0] = 0
        middle = np.array([frequency[a:b].mean() for a, b in pairwise(edges)])
        return _Bands(edges[:-1], edges[1:], middle)

    def mean(self, power: FloatArray) -> FloatArray:
        return np.array([power[a:b].mean() for a, b in zip(self.first, self.last, strict=True)])

    @property
    def modes(self) -> FloatArray:
        return (self.last - self.first).astype(float)


def _log_mean_bias(modes: FloatArray | float) -> FloatArray:
    """Of the logarithm of a mean of exponential variables."""
    return np.asarray(digamma(modes) - np.log(modes))


def _log_mean_variance(modes: FloatArray | float) -> FloatArray:
    # of few modes the logarithm has a long lower tail
    return np.asarray(polygamma(1, modes) * (1.0 + 1.0 / np.asarray(modes)))


# --- level ------------------------------------------------------------------------------------------------------------------


#: Quantities of the stages that dark frames' pixels and lines depend on.
DEFECTS = frozenset({"charge.defects", "signal.telegraph"})
LINES = frozenset({"signal.lines"})


def _dark_map(study: Study, effects: Effects, temperature_c: float | None) -> FloatArray:
    """Dark current (e/s) of pixels as large as a cell's twelfth: laws are of whole frames, of which nothing is smaller here."""
    camera = study.camera
    down = max(min(camera.rows // (12 * CELLS[0]), camera.cols // (12 * CELLS[1])), 1)
    coarse = camera.model_copy(
        update={
            "rows": camera.rows // down,
            "cols": camera.cols // down,
            "pixel_pitch_um": camera.pixel_pitch_um * down,
        }
    )
    return Uniform(coarse, effects).dark_e_per_s(temperature_c)


def _more_dark_e_per_s(study: Study, effects: Effects, temperature_c: float | None) -> float:
    """What effects add to the mean dark current of pixels that are like their neighbours."""
    if not Uniform(study.camera, effects).changes_dark_current:
        return 0.0
    return float(_dark_map(study, effects, temperature_c).mean()) - study.camera.dark_current_e_per_s


def dark_block(study: Study) -> Block:
    """Mean of every dark frame: black level and dark current are free; what remains is time, temperature and the frame before."""
    frames = study.once(dark_frames)
    captures = [(c, f.condition, c in f.condition.held_out) for f in frames for c in f.condition.captures]
    value = np.array([f.means[c.id] for f in frames for c in f.condition.captures])
    exposures = np.array([c.exposure_s for c, *_ in captures])
    noise, gain = study.noise, study.noise.gain
    base = noise.black + noise.dark_dn_per_s * exposures

    def predict(effects: Effects) -> Prediction:
        mean = base + np.array([study.offset(c, effects) for c, *_ in captures])
        more = {t: _more_dark_e_per_s(study, effects, t) for t in {k.temperature_c for _, k, _ in captures}}
        for i, (capture, condition, _) in enumerate(captures):
            carried = np.mean([study.carried_e(capture, c, effects) for c in study.channels])
            mean[i] += gain * (more[condition.temperature_c] * capture.exposure_s + float(carried))
        return Prediction(mean, study.free_offsets(exposures))

    # codes as coarse as all noise round a level up or down, with where it lies between two
    coarse = np.array([_rounding_dn(f) for f in frames for _ in f.condition.captures])
    same = np.array([[a[1] is b[1] for b in captures] for a in captures])
    # smooth along the exposure at one temperature; ten degrees are as far as all exposures
    reach = float(max(np.ptp(exposures), 1e-3))
    warmer = np.array([0.0 if k.temperature_c is None or study.temperature_c is None else k.temperature_c - study.temperature_c for _, k, _ in captures])  # fmt: skip
    return Block(
        measurement="dark", axis="exposure", unit="s", reach=reach, value=value, along=exposures + 2.0 * reach * warmer / 10.0,
        covariance=np.diag(np.full(len(value), noise.jitter_dn**2 + BLACK_FLOOR_DN**2)) + same * np.outer(coarse, coarse),
        labels=tuple(Label(c.exposure_s, "all", k.name, (c.id,), out) for c, k, out in captures),
        reads=LAG | {"signal.offset_dn", "charge.dark_current"}, predict=predict, scale=np.ones(len(value)),
        conditions="exposure and temperature",
    )  # fmt: skip


def _rounding_dn(frames: Frames) -> float:
    """By how much rounding may move a level: exp(-2 pi^2 variance) / pi codes at most."""
    changing = next((c.variance_dn2 for c in frames.changing.values()), None)
    if changing is None:
        return 0.1
    return float(np.exp(-2.0 * np.pi**2 * max(changing - 1.0 / 12.0, 0.0)) / np.pi)


def black_level_block(study: Study) -> Block:
    """The black level that the darks show against the stated one: no effect is about a level that is wrong from the start."""
    stated = study.stated.black_level_dn
    if stated is None:
        raise NotDetermined("black_level", "the black level isn't stated: nothing to hold the dark frames against")
    shortest = min(conditions(study), key=lambda c: c.exposure_s)
    std = float(np.hypot(STATED_BLACK_SHARE * stated, STATED_BLACK_DN)) + study.noise.black_std
    return Block(
        measurement="black_level", axis="exposure", unit="s", reach=1.0, value=np.array([study.noise.black]),
        covariance=np.array([[std**2]]),
        labels=(Label(0.0, "all", "stated level", tuple(c.id for c in shortest.captures), False),),
        reads=frozenset(), predict=lambda effects: Prediction(np.array([stated]), {}), scale=np.array([max(stated, 1.0)]),
    )  # fmt: skip


# --- noise ------------------------------------------------------------------------------------------------------------------


def dark_noise_block(study: Study) -> Block:
    """Temporal variance of dark frames by exposure and temperature: it grows with the dark charge, and not with an offset."""
    frames = study.once(dark_frames)
    points = [(f, out, c) for f in frames for out, c in f.changing.items()]
    if not points:
        raise NotDetermined("dark_noise", "no two dark frames of the same exposure and temperature")
    value = np.array([c.variance_dn2 for *_, c in points])
    if np.sqrt(value.min()) < LEAST_NOISE_DN:
        raise NotDetermined("dark_noise", _too_coarse([f for f, *_ in points], LEAST_NOISE_DN))
    size = study.camera.rows * study.camera.cols
    noise = study.noise
    exposures = np.array([f.condition.exposure_s for f, *_ in points])
    count = np.array([c.contrasts for *_, c in points])
    lines = np.array(
        [
            c.line_dn2["rows"] ** 2 / study.camera.rows + c.line_dn2["columns"] ** 2 / study.camera.cols
            for *_, c in points
        ]
    )
    # codes as coarse as the noise round it up or down, with where the level lies between two
    bare = np.maximum(value - 1.0 / 12.0, 0.0)
    coarse = (4.0 * bare + 0.1) * np.exp(-2.0 * np.pi**2 * bare)
    covariance = np.diag(
        2.0 * value**2 / (size * count) + 2.0 * lines / count + (VARIANCE_FLOOR * value) ** 2 + coarse**2
    )
    dark = noise.gain * noise.dark_dn_per_s * exposures
    shortest = float(value[int(np.argmin(exposures))])
    base = shortest + dark - float(dark.min())
    # without flats nothing measures the gain; where it isn't stated either, it is anything
    flats = len(study.flat_levels()) > 1
    gain_std = 0.05 if flats else 0.3 if study.stated.conversion_gain_dn_per_e is not None else 10.0

    def predict(effects: Effects) -> Prediction:
        mean = base.copy()
        shot = dark.copy()
        model, grid = Uniform(study.camera, effects), np.linspace(0.0, 0.5, 65)
        lines = sum((float(np.mean(one.spectrum_e2(grid, fixed=False))) for one in model.lines), 0.0)
        for i, (f, *_) in enumerate(points):
            t, temperature = f.condition.exposure_s, f.condition.temperature_c
            shot[i] += noise.gain**2 * _more_dark_e_per_s(study, effects, temperature) * t
            mean[i] += shot[i] - dark[i]
            mean[i] += _defect_variance(model, noise.gain, t, float(value[i])) + noise.gain**2 * lines
        jacobian = {
            "dark_read": np.full(len(points), 0.5 * shortest + 0.1),
            "dark": noise.gain * exposures * noise.dark_std,
        }
        jacobian["gain" if flats else "dark_gain"] = gain_std * shot
        return Prediction(mean, jacobian)

    return Block(
        measurement="dark_noise", axis="exposure", unit="s", reach=float(max(np.ptp(exposures), 1e-3)), value=value,
        covariance=covariance,
        labels=tuple(Label(f.condition.exposure_s, "all", f.condition.name, _captures(f, out), out) for f, out, _ in points),
        reads=DEFECTS | {"charge.dark_current", "signal.lines"}, predict=predict, scale=value,
        conditions="exposure and temperature",
    )  # fmt: skip


def _fine(step: str, frames: Sequence[Frames], least_dn: float) -> list[Frames]:
    """Conditions whose frames differ by at least so much noise; NotDetermined where there are none."""
    every = [f for f in frames if f.changing]
    if not every:
        raise NotDetermined(step, "no two dark frames of the same exposure and temperature")
    fine = [f for f in every if all(c.pixel_dn2 > least_dn**2 for c in f.changing.values())]
    if not fine:
        raise NotDetermined(step, _too_coarse(every, least_dn))
    return fine


def _by_part(frames: Sequence[Frames]) -> dict[bool, list[Changing]]:
    """What changes from frame to frame, of what choice and fit may see and of what is held out; neither if there is none."""
    parts = {out: [f.changing[out] for f in frames if out in f.changing] for out in (False, True)}
    return {out: part for out, part in parts.items() if part}


def _too_coarse(frames: Sequence[Frames], limit_dn: float) -> str:
    noise = min(np.sqrt(c.pixel_dn2) for f in frames for c in f.changing.values())
    return f"the temporal noise of dark frames is {noise:.2f} DN, below the limit of {limit_dn} DN: codes are too coarse to show how it is distributed; a higher gain would"


def _captures(frames: Frames, held_out: bool) -> tuple[str, ...]:
    return tuple(c.id for c in (frames.condition.held_out if held_out else frames.condition.seen))


def _defect_variance(model: Uniform, gain: float, exposure_s: float, variance_dn2: float) -> float:
    """What defective pixels add to the mean variance (DN^2), contrasts cut off at CLIP standard deviations."""
    cut = CLIP * np.sqrt(variance_dn2)
    more = 0.0
    for hot in model.hot:
        share, excess_e_per_s = hot.nodes()
        noisy = variance_dn2 + gain**2 * excess_e_per_s * exposure_s
        more += float(share @ (_cut_square(np.zeros_like(noisy), noisy, cut) - variance_dn2))
    for jumps in model.telegraph:
        share, distance_e = jumps.nodes()
        # two frames: both high or both low half of the time
        apart = gain * distance_e / np.sqrt(2.0)
        still = np.full_like(apart, variance_dn2)
        apart_square = _cut_square(apart, still, cut)
        more += float(share @ (0.5 * (apart_square - variance_dn2)))
    return more


def _cut_square(mean: FloatArray, variance: FloatArray, cut: float) -> FloatArray:
    """Mean of the square of a normal variable that is cut off at +-cut."""
    s = np.sqrt(variance)
    a, b = (-cut - mean) / s, (cut - mean) / s
    pa, pb = (np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi) for x in (a, b))
    inside = ndtr(b) - ndtr(a)
    square = (mean**2 + variance) * inside + 2.0 * mean * s * (pa - pb) + variance * (a * pa - b * pb)
    return np.asarray(square + cut**2 * (1.0 - inside))


# --- lines ------------------------------------------------------------------------------------------------------------------


def temporal_line_block(lines: Lines, study: Study) -> Block:
    """Spectrum of what all pixels of a row (column) share in one frame and not in the next, over that of single pixels."""
    frames = study.once(dark_frames)
    name = "row_noise" if lines == "rows" else "column_noise"
    fine = _fine(f"dark_{name}", frames, LEAST_LINE_DN)
    parts = _by_part(fine)
    frequency = next(iter(parts.values()))[0].lines[lines][0]
    # a ripple of some rows' period lies where noise that neighbouring rows share has its bend
    bands = _Bands.of(frequency, 8, 1.5)
    length = study.camera.cols if lines == "rows" else study.camera.rows
    value, variance, labels, inverse = [], [], [], []
    for out, part in parts.items():
        weight = np.array([min(c.contrasts, 6) for c in part], float)
        power = np.average([c.lines[lines][1] for c in part], axis=0, weights=weight)
        modes, level = bands.modes * weight.sum(), sum(c.lines[lines][2] for c in part)
        value.append(np.log(bands.mean(power)) - _log_mean_bias(modes))
        variance.append(_log_mean_variance(modes) + 1.0 / level + POWER_FLOOR**2)
        inverse.append(np.full(len(modes), float(np.average([1.0 / c.white_dn2 for c in part], weights=weight))))
        ids = tuple(i for f in fine if out in f.changing for i in _captures(f, out))
        labels += [Label(float(x), "all", "temporal", ids, out) for x in bands.middle]
    over = np.concatenate(inverse) * study.noise.gain**2 * length
    sets = len(parts)

    def predict(effects: Effects) -> Prediction:
        total = np.zeros(len(frequency))
        for one in Uniform(study.camera, effects).lines:
            if one.lines == lines:
                total += one.spectrum_e2(frequency, fixed=False)
        return Prediction(np.log1p(over * np.tile(bands.mean(total), sets)), {})

    n = len(labels)
    return Block(
        measurement=f"dark_{name}", axis="spatial_frequency", unit="cy/px", reach=0.1, value=np.concatenate(value),
        covariance=np.diag(np.concatenate(variance)), labels=tuple(labels), reads=LINES,
        predict=predict, scale=np.ones(n),
    )  # fmt: skip


def fixed_line_block(lines: Lines, study: Study) -> Block:
    """The same of what they share in every frame: the shortest exposure's mean; and how odd lines differ from even ones."""
    frames = study.once(dark_frames)
    name = "row_pattern" if lines == "rows" else "column_pattern"
    first = next(f for f in frames if f.fixed)
    if min(part.white_dn2 for part in first.fixed.values()) < 1e-3:
        raise NotDetermined(
            f"dark_{name}", "dark frames have no noise and no pattern: codes are too coarse to show one"
        )
    frequency = next(iter(first.fixed.values())).lines[lines][0]
    bands = _Bands.of(frequency, BANDS)
    length = study.camera.cols if lines == "rows" else study.camera.rows
    size = study.camera.rows * study.camera.cols
    value: list[FloatArray] = []
    labels: list[Label] = []
    factor: list[FloatArray] = []
    share = _fixed_share(first)
    for out, part in first.fixed.items():
        _, power, _ = part.lines[lines]
        value.append(np.log(bands.mean(power)) - _log_mean_bias(bands.modes))
        labels += [Label(float(x), "all", "fixed", part.captures, out) for x in bands.middle]
        factor.append(np.full(len(bands.middle), study.noise.gain**2 * length / part.white_dn2))
    pieces = len(first.fixed)
    one = np.diag(_log_mean_variance(bands.modes))
    kin = np.array([[1.0 if a == b else share[a] * share[b] for b in first.fixed] for a in first.fixed])
    covariance = np.kron(kin, one) + np.eye(pieces * len(one)) * (POWER_FLOOR**2 + 0.01**2)
    parity = np.array([part.parity_dn[lines] for part in first.fixed.values()])
    pixel = np.array([4.0 * part.white_dn2 / size for part in first.fixed.values()])
    offset = np.array([4.0 * part.line_dn2[lines] * length / size for part in first.fixed.values()])
    parity_cov = (
        np.sqrt(np.outer(pixel, pixel)) * kin + np.sqrt(np.outer(offset, offset)) + np.eye(pieces) * CELL_FLOOR_DN**2
    )
    n = len(covariance)
    whole = np.zeros((n + pieces, n + pieces))
    whole[:n, :n], whole[n:, n:] = covariance, parity_cov
    labels += [Label(0.5, "all", "odd and even", part.captures, out) for out, part in first.fixed.items()]
    std = np.sqrt(np.diag(parity_cov))

    def predict(effects: Effects) -> Prediction:
        still, moving, odd = np.zeros(len(frequency)), np.zeros(len(frequency)), 0.0
        for one in Uniform(study.camera, effects).lines:
            if one.lines == lines:
                still += one.spectrum_e2(frequency, fixed=True)
                moving += one.spectrum_e2(frequency, fixed=False)
                odd += one.odd_even_e
        parts = zip(factor, first.fixed.values(), strict=True)
        power = np.concatenate([np.log1p(f * bands.mean(still + moving / part.frames)) for f, part in parts])
        return Prediction(np.concatenate([power, np.full(pieces, study.noise.gain * odd)]), {})

    return Block(
        measurement=f"dark_{name}", axis="spatial_frequency", unit="cy/px", reach=0.1,
        value=np.concatenate([*value, parity]), covariance=whole, labels=tuple(labels),
        reads=LINES, predict=predict,
        scale=np.concatenate([np.ones(n), 10.0 * std]), conditions="pattern",
    )  # fmt: skip


def _fixed_share(frames: Frames) -> dict[bool, float]:
    """Share of a mean frame's pixel variance that is fixed, and so the same in seen and held-out frames."""
    changing = next((c.white_dn2 for c in frames.changing.values()), None)
    if changing is None:
        return dict.fromkeys(frames.fixed, 0.0)
    return {
        out: float(np.clip(1.0 - changing / part.frames / part.white_dn2, 0.0, 1.0))
        for out, part in frames.fixed.items()
    }


def along_block(study: Study) -> Block:
    """Spectrum within rows and columns at low frequencies, over that of the band above: white noise has none to spare."""
    fine = _fine("dark_correlation", study.once(dark_frames), LEAST_LINE_DN)
    value, variance, labels = [], [], []
    for out, part in _by_part(fine).items():
        ids = tuple(i for f in fine if out in f.changing for i in _captures(f, out))
        weight = np.array([min(c.contrasts, 6) for c in part], float)
        for lines in ("rows", "columns"):
            frequency = part[0].along[lines][0]
            if len(frequency) < 1:
                continue
            power = np.average([c.along[lines][1] for c in part], axis=0, weights=weight)
            modes = np.sum([c.along[lines][2] for c in part], axis=0)
            level = sum(c.lines[lines][2] for c in part)
            bands = _Bands.of(frequency, 3)
            total = np.array([modes[a:b].sum() for a, b in zip(bands.first, bands.last, strict=True)])
            value.append(np.log(bands.mean(power)))
            variance.append(1.0 / total + 1.0 / level + POWER_FLOOR**2)
            labels += [Label(float(x), "all", f"along {lines}", ids, out) for x in bands.middle]
    if not labels:
        raise NotDetermined("dark_correlation", "the frames are too small to show noise that neighbours share")
    n = len(labels)
    # what lines share leaves no trace within them: where there is one, it wasn't the lines
    return Block(
        measurement="dark_correlation", axis="spatial_frequency", unit="cy/px", reach=0.03, value=np.concatenate(value),
        covariance=np.diag(np.concatenate(variance)), labels=tuple(labels), reads=LINES,
        predict=lambda effects: Prediction(np.zeros(n), {}), scale=np.ones(n), conditions="direction",
    )  # fmt: skip


# --- places -----------------------------------------------------------------------------------------------------------------


def dark_field_block(study: Study) -> Block:
    """Cells of the mean dark frame by exposure; each frame's level is free."""
    frames = [f for f in study.once(dark_frames) if f.fixed]
    points = [(f, out, part) for f in frames for out, part in f.fixed.items()]
    rows, cols = CELLS
    count = rows * cols
    if min(study.camera.rows // rows, study.camera.cols // cols) < 4:
        raise NotDetermined("dark_field", "the frames are too small to be split into cells")
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
        if Uniform(study.camera, effects).changes_dark_current:
            for i, (f, *_) in enumerate(points):
                cells = _cell_means(_dark_map(study, effects, f.condition.temperature_c).astype(np.float32))
                here = study.noise.gain * f.condition.exposure_s * (cells - cells.mean())
                mean[i * count : (i + 1) * count] = here.ravel()
        jacobian = {}
        for i in range(len(points)):
            column = np.zeros(len(value))
            column[i * count : (i + 1) * count] = 1.0
            jacobian[f"dark_field:{i}"] = column
        return Prediction(mean, jacobian)

    longest = max(float(exposures.max()), 1e-9)
    return Block(
        measurement="dark_field", axis="field", unit="of half the diagonal", reach=0.5, value=value, covariance=np.asarray(covariance, float),
        labels=tuple(Label(float(radius[k]), "all", f.condition.name, part.captures, out) for f, out, part in points for k in range(count)),
        reads=frozenset({"charge.dark_current"}), predict=predict, scale=np.repeat(np.maximum(exposures / longest, 0.1), count),
        conditions="exposure and temperature",
    )  # fmt: skip


# --- odd pixels -------------------------------------------------------------------------------------------------------------


def _rooted(counts: FloatArray) -> FloatArray:
    """Roots of counts, of standard deviation 1 whatever the count (Anscombe 1948)."""
    return np.asarray(2.0 * np.sqrt(counts + 0.375))


def _count_covariance(expected: FloatArray, uncertain: FloatArray | float = 0.0) -> FloatArray:
    """Chance (1 where many are expected), and what the expected counts themselves are uncertain by."""
    number = np.arange(60.0)
    mean = np.minimum(expected, 20.0)[:, None]
    share = np.exp(xlogy(number, mean) - mean - gammaln(number + 1.0))
    chance = share @ np.square(_rooted(number)) - np.square(share @ _rooted(number))
    return np.diag(chance + COUNT_STD**2 + np.square(_rooted(expected + uncertain) - _rooted(expected)))


def odd_pixel_block(study: Study) -> Block:
    """How many pixels lie far from their surroundings in the median of repeats, by how far and by exposure: hot pixels are the
    same in every frame, and bright in proportion to the exposure."""
    frames = [f for f in study.once(dark_frames) if f.fixed]
    points = [(f, out, part) for f in frames for out, part in f.fixed.items()]
    value = np.concatenate([_rooted(part.counts) for *_, part in points])
    size = study.camera.rows * study.camera.cols
    bins = len(points[0][2].counts)
    own = [_pixel_noise(study, f, part) for f, _, part in points]

    def expected(effects: Effects, times: float = 1.0) -> FloatArray:
        found = []
        for (f, _, part), (moving, fixed) in zip(points, own, strict=True):
            classes = _classes(Uniform(study.camera, effects), study.noise.gain, f.condition.exposure_s)
            skew = times * part.skewness * (part.spread_dn / moving) ** 3
            found.append(
                size * _tail_shares(classes, moving, fixed, part.of_median, part.spread_dn, study.noise.gain, skew)
            )
        return np.concatenate(found)

    low = np.array([*TAIL_EDGES, -TAIL_EDGES[0], -TAIL_EDGES[1]])
    labels = tuple(
        Label(float(low[b]), "all", f.condition.name, part.captures, out)
        for f, out, part in points
        for b in range(bins)
    )
    base = expected(())
    # a skewness says little of the far tail
    uncertain = np.abs(expected((), 2.0) - expected((), 0.0)) + 0.2 * base
    return Block(
        measurement="odd_pixels", axis="deviation", unit="sigma", reach=1.0, value=value,
        covariance=_count_covariance(base, uncertain), labels=labels, reads=DEFECTS,
        predict=lambda effects: Prediction(_rooted(expected(effects)), {}), scale=np.full(len(value), 10.0),
        along=np.tile(np.sign(low) * np.log(np.abs(low)), len(points)), conditions="exposure and temperature",
    )  # fmt: skip


def _pixel_noise(study: Study, frames: Frames, part: Fixed) -> tuple[float, float]:
    """(temporal, fixed) standard deviation of single pixels in DN: their median's spread less what the frames' noise leaves of it."""
    moving = next((c.pixel_dn2 for c in frames.changing.values()), None)
    left = _order_moments(part.of_median)[1]
    if moving is None:  # of a lone frame all counts as noise
        return max(part.spread_dn, 0.05), 0.0
    return max(float(np.sqrt(moving)), 0.05), float(np.sqrt(max(part.spread_dn**2 - left * moving, 0.0)))


def _order_moments(n: int) -> tuple[float, float]:
    """Mean and variance of the lower median of n standard normal numbers."""
    return {1: (0.0, 1.0), 2: (-0.5642, 0.6817), 3: (0.0, 0.4487), 4: (-0.2970, 0.3605), 5: (0.0, 0.2868)}[n]


@dataclass(frozen=True)
class _Class:
    """Pixels of one kind: their share, additional dark signal and distance of two levels in DN."""

    share: float
    more_dn: float
    jump_dn: float


def _classes(model: Uniform, gain: float, exposure_s: float) -> list[_Class]:
    found = []
    for hot in model.hot:
        found += [_Class(float(s), gain * float(x) * exposure_s, 0.0) for s, x in zip(*hot.nodes(), strict=True)]
    for jumps in model.telegraph:
        found += [_Class(float(s), 0.0, gain * float(x)) for s, x in zip(*jumps.nodes(), strict=True)]
    return found


def _tail_shares(
    classes: Sequence[_Class], moving: float, fixed: float, frames: int, spread: float, gain: float, skew: float
) -> FloatArray:
    """Shares of all pixels in the bins of TAIL_EDGES: a pixel's lower median of `frames` numbers of noise `moving`, on a normal
    fixed deviation `fixed`, is compared with `spread` times the edges."""
    low = np.array([*TAIL_EDGES, -TAIL_EDGES[0], -TAIL_EDGES[1]]) * spread + _order_moments(frames)[0] * moving
    u = np.linspace(-7.5, 7.5, 61) if fixed > 0.02 * moving else np.zeros(1)
    weight = np.exp(-0.5 * u * u)
    weight /= weight.sum()
    rest = 1.0 - sum(c.share for c in classes)
    share = np.array([max(rest, 0.0), *(c.share for c in classes)])
    more = np.array([0.0, *(c.more_dn for c in classes)])
    jump = np.array([0.0, *(c.jump_dn for c in classes)])
    s = np.sqrt(moving**2 + gain * more)
    at = low[None, :, None] - fixed * u[None, None, :] - more[:, None, None]
    z = [(at + sign * 0.5 * jump[:, None, None]) / s[:, None, None] for sign in (1.0, -1.0)]
    single = [_upper(part, skew) for part in z]
    above = np.clip(0.5 * (single[0] + single[1]), 0.0, 1.0)
    # the (n - k)-th highest of n is above where n - k of them are at least
    needed = frames - (frames - 1) // 2
    if frames > 1:
        above = betainc(needed, frames - needed + 1, above)
    beyond = (above * weight).sum(axis=2)
    up = beyond[:, : len(TAIL_EDGES)]
    up = up - np.concatenate([up[:, 1:], np.zeros((len(share), 1))], axis=1)
    down = 1.0 - beyond[:, len(TAIL_EDGES) :]
    down = np.stack([down[:, 0] - down[:, 1], down[:, 1]], axis=1)
    return np.asarray(share @ np.concatenate([np.maximum(up, 0.0), np.maximum(down, 0.0)], axis=1))


def _upper(z: FloatArray, skew: float) -> FloatArray:
    """Probability of more than z of a variable of variance 1 and a small skewness (Edgeworth's first term)."""
    return np.asarray(ndtr(-z) + np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi) * skew / 6.0 * (z * z - 1.0))


def blinking_block(study: Study) -> Block:
    """How many pixels change from frame to frame far more than their surroundings, all dark frames together."""
    fine = _fine("blinking_pixels", study.once(dark_frames), LEAST_COUNTED_DN)
    parts = {out: [f for f in fine if out in f.changing] for out in _by_part(fine)}
    size = study.camera.rows * study.camera.cols
    value, labels, sums = [], [], []
    for out, part in parts.items():
        freedom = sum(f.changing[out].contrasts for f in part)
        edges = _blink_edges(freedom)
        total = np.sum([f.changing[out].squares for f in part], axis=0)
        value.append(_rooted(np.histogram(total, [*edges, np.inf])[0].astype(float)))
        ids = tuple(i for f in part for i in _captures(f, out))
        labels += [Label(float(x), "all", "all exposures", ids, out) for x in edges / freedom]
        sums.append((out, part, freedom, edges))
    draws = {id(f): _jump_sums(f.condition) for f in fine}

    def expected(effects: Effects) -> FloatArray:
        model, found = Uniform(study.camera, effects), []
        for out, part, freedom, edges in sums:
            shares = _chance_above(np.array([freedom], float), np.zeros(1), edges)[0]
            for hot in model.hot:
                weight, rate = hot.nodes()
                shares = shares + weight @ (_hot_above(study, part, out, rate, edges) - shares)
            for jumps in model.telegraph:
                weight, distance_e = jumps.nodes()
                above = _jump_above(study, part, out, draws, distance_e, edges, freedom)
                shares = shares + weight @ (above - shares)
            found.append(size * (shares - np.append(shares[1:], 0.0)))
        return np.maximum(np.concatenate(found), 0.0)

    base = expected(())
    position = np.array([label.x for label in labels])
    return Block(
        measurement="blinking_pixels", axis="variance", unit="times their surroundings'", reach=1.0,
        value=np.concatenate(value), covariance=_count_covariance(base, base), labels=tuple(labels),
        reads=DEFECTS, predict=lambda effects: Prediction(_rooted(expected(effects)), {}),
        scale=np.full(len(base), 10.0), along=np.log(position),
    )  # fmt: skip


def _blink_edges(freedom: int) -> FloatArray:
    return np.asarray(float(chdtri(freedom, BLINK_CHANCE)) * np.array(BLINK_EDGES))


def _chance_above(freedom: FloatArray, noncentral: FloatArray, edges: FloatArray) -> FloatArray:
    """Probability that a chi-squared variable is above the edges, (n, edges): exact where it is central, else its cube root is
    taken as normal (Abdel-Aty 1954)."""
    if not np.any(noncentral):
        return np.asarray(chdtrc(freedom[:, None], edges[None, :]))
    a = (freedom + noncentral)[:, None]
    b = (noncentral / (freedom + noncentral))[:, None]
    variance = 2.0 * (1.0 + b) / (9.0 * a)
    return np.asarray(ndtr(-(np.cbrt(edges[None, :] / a) - 1.0 + variance) / np.sqrt(variance)))


def _hot_above(study: Study, part: Sequence[Frames], out: bool, rate: FloatArray, edges: FloatArray) -> FloatArray:
    """(rates, edges): hot pixels have more shot noise, the more the longer the exposure; by the first two moments."""
    count = np.array([f.changing[out].contrasts for f in part], float)
    noise = np.array([f.changing[out].pixel_dn2 for f in part])
    charge = study.noise.gain**2 * rate[:, None] * np.array([f.condition.exposure_s for f in part])
    factor = 1.0 + charge / noise
    mean, variance = factor @ count, 2.0 * np.square(factor) @ count
    scale = variance / (2.0 * mean)
    freedom = mean / scale
    return np.asarray(chdtrc(freedom[:, None], edges[None, :] / scale[:, None]))


def _jump_above(
    study: Study,
    part: Sequence[Frames],
    out: bool,
    draws: Mapping[int, Mapping[bool, FloatArray]],
    amplitude_e: FloatArray,
    edges: FloatArray,
    freedom: int,
) -> FloatArray:
    """(amplitudes, edges): mean over which of the frames are high."""
    unit = np.sum([draws[id(f)][out] / f.changing[out].pixel_dn2 for f in part], axis=0)
    found = []
    for amplitude in amplitude_e:
        away = np.square(study.noise.gain * amplitude) * unit
        found.append(_chance_above(np.full(len(away), float(freedom)), np.maximum(away, 1e-9), edges).mean(axis=0))
    return np.array(found)


def _jump_sums(condition: Condition) -> dict[bool, FloatArray]:
    """Sums of squared contrasts (seen, held out) of numbers that are -1/2 or 1/2 at random, JUMPS draws: always the same ones."""
    n, seen = len(condition.captures), len(condition.seen)
    rng = np.random.default_rng([n, seen, round(1e6 * condition.exposure_s)])
    state = rng.integers(0, 2, (JUMPS, n)) - 0.5
    square: dict[bool, FloatArray] = {False: np.zeros(JUMPS), True: np.zeros(JUMPS)}
    mean = np.zeros(JUMPS)
    for k in range(n):
        if k:
            square[k >= seen] += (state[:, k] - mean) ** 2 * k / (k + 1.0)
        mean += (state[:, k] - mean) / (k + 1.0)
    return square


row_noise_block = partial(temporal_line_block, "rows")
column_noise_block = partial(temporal_line_block, "columns")
row_pattern_block = partial(fixed_line_block, "rows")
column_pattern_block = partial(fixed_line_block, "columns")
#: All that is read from dark frames, in the order of the report.
DARK_BLOCKS = (
    dark_block, black_level_block, dark_noise_block, dark_field_block, row_noise_block, column_noise_block,
    row_pattern_block, column_pattern_block, along_block, odd_pixel_block, blinking_block,
)  # fmt: skip
