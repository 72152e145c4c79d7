"""What a diagnosis looks at: numbers taken from the recordings, their covariance, and how a model predicts them.

A `Block` is one kind of measurement. Its prediction goes through the estimator that made the numbers. Nuisance parameters
(levels, gain, a smooth few per cent of the maker's curves) enter by the Jacobian and a normal prior; the measurement model
marginalises them. A block that the recordings don't allow is left out with a reason (`NotDetermined`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, TypeVar, cast

import numpy as np
from scipy import ndimage

from lab.capture_kinds.base import Capture
from lab.capture_kinds.flat import FlatCapture
from lab.errors import NotDetermined
from lab.fit.rounding import unrounded
from lab.formats.recording_set import DataSheet, RecordingSet
from sim.camera import CameraModel, Side
from sim.effects.base import Effect
from sim.effects.library import changed_by, may_change
from sim.sensor import mosaic
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import FieldPoints, Uniform

Effects = Sequence[Effect]
T = TypeVar("T")
C = TypeVar("C", bound=Capture)

# --- what doesn't average out: floors that the covariance carries beside noise ---------------------------------------------
LAMP_FLOOR = 1.0e-4  # of a level, common to the channels of a capture
STATED_BLACK_SHARE, STATED_BLACK_DN = 0.03, 2.0  # of a stated black level: what a data sheet may be off by
BLACK_FLOOR_DN = 0.01  # of a frame's mean: rounding of a quiet camera
NARROWBAND_FLOOR = 1e-4  # of a level, each channel by itself, one for its repeats
TAIL_STD = 0.1  # of the light that the baseline's point spread sends into dark squares and patches
CLIPPED_SHARE = 2e-4
USUAL_JITTER_DN = 0.02  # of a dark frame's mean, from repeat to repeat
WARMTH_STD = 0.1  # of the dark current, a degree: it doubles within 5 to 10 degrees
USUAL_PRNU = 0.008
ALIKE_C = 2.0  # dark captures whose temperatures are that close count as of one
NOISELESS_DN = 0.5  # a frame of less standard deviation may be like another by chance
LEVEL_REACH = 0.8  # of a level's logarithm: over a factor of 2 a smooth departure from a line may change


@dataclass(frozen=True)
class Prediction:
    """Mean (n,) and the Jacobian: its derivatives (n,) by every nuisance parameter, per prior standard deviation."""

    mean: FloatArray
    jacobian: dict[str, FloatArray]


@dataclass(frozen=True)
class Label:
    """Where a number stands: for slices, held-out captures and pictures."""

    x: float
    channel: str
    condition: str
    captures: tuple[str, ...]
    held_out: bool


@dataclass(frozen=True)
class Block:
    """One measurement: n numbers, their noise's covariance (n, n), labels, and the model's prediction with given effects."""

    measurement: str
    axis: str
    unit: str
    reach: float  # along `position`, over which a smooth discrepancy may change
    value: FloatArray
    covariance: FloatArray
    labels: tuple[Label, ...]
    reads: frozenset[str]  # quantities of the stages (`sim.stages`) that the prediction depends on
    predict: Callable[[Effects], Prediction]
    scale: FloatArray  # size of a discrepancy of 1, (n,)
    along: FloatArray | None = (
        None  # where smoothness isn't along x: logarithms of levels (n,), places on the sensor (n, 2)
    )
    #: What conditions are an axis of ("orientation", "pattern"): slices and curves are by condition, too. "": of none.
    conditions: str = ""
    #: Words before the conditions where the report lists them ("edges at"); "": the axis' name.
    conditions_words: str = ""
    #: What the points are called where x only numbers them and conditions name them ("patches"); "": x is a quantity.
    places: str = ""

    @property
    def position(self) -> FloatArray:
        """Along which errors of laws and unknown discrepancies are smooth, (n,) or (n, d)."""
        return np.array([label.x for label in self.labels]) if self.along is None else self.along

    def touched_by(self, effect: type[Effect]) -> bool:
        """Whether the effect acts on anything that this measurement sees."""
        return not self.reads.isdisjoint(may_change(effect))


#: Of measurements in whose prediction the frame before enters.
LAG = frozenset({"charge.lag"})
#: Of measurements of patterns: what a screen shows of what it is asked for, and reflections of the whole image.
SHOWN = frozenset({"light.screen"})
REFLECTIONS = frozenset({"image.copies"})
#: Of measurements of where light lands.
SHIFT = frozenset({"image.shift"})


@dataclass(frozen=True)
class Levels:
    """Means of one capture: DN by channel over the unclipped plane, None where it clips; over the plane as it is; its pixels."""

    mean: dict[str, float | None]
    pixels: dict[str, int]
    whole: dict[str, float]


class Study:
    """One side of a recording set, its frames summarised once; the blocks are made from it."""

    def __init__(
        self, recordings: RecordingSet, side: Side, camera: CameraModel, saturation_dn: float | None = None
    ) -> None:
        #: What isn't looked at, as it wasn't taken: (capture's id, why), each in one line.
        self.stale: tuple[tuple[str, str], ...] = stale(recordings, side)
        left_out = {name for name, _ in self.stale}
        self.recordings = recordings.without(left_out) if left_out else recordings
        self.side, self.camera = side, camera
        #: Pixels from here on say nothing of the light: the converter's highest code, or the full well where that comes first.
        self.saturation_dn = min(camera.white_level_dn, saturation_dn or camera.white_level_dn)
        self.stated: DataSheet = recordings.camera(side)
        self.channels = camera.channels
        self._levels: dict[str, Levels] = {}
        self._made: dict[Any, Any] = {}
        self._spectra: dict[str, Spectrum] = {}
        times = [c.time for c in recordings.captures(side=side) if c.time is not None]
        self._start = min(times) if times else None
        warm = [c.temperature_c for c in recordings.captures(side=side) if c.temperature_c is not None]
        #: The sensor's, at most captures; None where none is stated.
        self.temperature_c = float(np.median(warm)) if warm else None
        self.field = FieldPoints.of(camera)
        if saturation_dn is None:
            self.saturation_dn = _saturation(self)
        self.noise: NoiseGuess = noise_guess(self)
        self.camera = camera.model_copy(
            update={
                "conversion_gain_dn_per_e": self.noise.gain,
                "black_level_dn": self.noise.black,
                "dark_current_e_per_s": self.noise.dark_dn_per_s / self.noise.gain,
                "read_noise_e": self.noise.read_dn / self.noise.gain,
                "full_well_e": (self.saturation_dn - self.noise.black) / self.noise.gain,
                "dark_current_reference_c": camera.dark_current_reference_c
                if self.temperature_c is None
                else self.temperature_c,
            }
        )

    def elapsed_s(self, capture: Capture) -> float:
        return 0.0 if capture.time is None or self._start is None else (capture.time - self._start).total_seconds()

    def spectrum(self, path: str) -> Spectrum:
        if path not in self._spectra:
            self._spectra[path] = self.recordings.spectrum(path)
        return self._spectra[path]

    def plane_mask(self, channel: str, shape: tuple[int, int]) -> FloatArray:
        mask = np.zeros(shape, bool)
        step = mosaic.step(self.camera.cfa)
        for row, col in mosaic.phases(self.camera.cfa)[channel]:
            mask[row::step, col::step] = True
        return mask

    def pixels_of(self, frame: Any, channel: str) -> FloatArray:
        """All pixels of a channel, flat, as float."""
        step = mosaic.step(self.camera.cfa)
        parts = [frame[row::step, col::step] for row, col in mosaic.phases(self.camera.cfa)[channel]]
        return np.concatenate([np.asarray(p, float).ravel() for p in parts])

    def levels(self, capture: Capture) -> Levels:
        if capture.id not in self._levels:
            frame = self.recordings.frame(capture)
            mean: dict[str, float | None] = {}
            pixels, whole = {}, {}
            for channel in self.channels:
                values = self.pixels_of(frame, channel)
                clipped = float(np.mean(values >= self.saturation_dn))
                whole[channel] = float(values.mean())
                mean[channel] = whole[channel] if clipped < CLIPPED_SHARE else None
                pixels[channel] = values.size
            self._levels[capture.id] = Levels(mean, pixels, whole)
        return self._levels[capture.id]

    @property
    def diffraction_is_known(self) -> bool:
        """Whether f-number and pitch are stated."""
        return self.stated.f_number is not None and self.stated.pixel_pitch_um is not None

    @property
    def level_is_known(self) -> bool:
        """Whether the light in front of the lens tells how many DN to expect."""
        return self.noise.gain_is_known and self.diffraction_is_known

    @property
    def tail_std(self) -> float:
        """Of the light that the baseline's point spread itself sends far, which is anything where the lens or the pitch aren't stated."""
        return TAIL_STD if self.diffraction_is_known else 1.0

    @cached_property
    def lamps(self) -> dict[str, int]:
        """Which lamp the flats' radiance files are readings of: one lamp where they differ by less than 1 % in shape and 5 % in
        level, for a radiometer reads a lamp anew before every pass."""
        found: list[tuple[FloatArray, FloatArray]] = []
        lamps: dict[str, int] = {}
        for capture in self.recordings.captures(FlatCapture, self.side):
            if capture.radiance is None or capture.radiance in lamps:
                continue
            wavelength, value = self.spectrum(capture.radiance).arrays
            for k, (where, level) in enumerate(found):
                if len(where) != len(wavelength) or np.any(where != wavelength):
                    continue
                ratio = float(value.sum() / level.sum())
                if abs(ratio - 1.0) < 0.05 and np.abs(value / ratio - level).sum() < 0.01 * np.abs(level).sum():
                    lamps[capture.radiance] = k
                    break
            else:
                lamps[capture.radiance] = len(found)
                found.append((wavelength, value))
        return lamps

    def flat_levels(self) -> list[list[Any]]:
        """Flat captures by what makes their level: exposure, lamp, gain."""
        return self.groups(
            "flat", lambda c: (c.exposure_s, self.lamps.get(c.radiance, -1), c.gain_db, c.photons_per_pixel)
        )

    def groups(self, kind: Any, key: Callable[[Any], object]) -> list[list[Any]]:
        """Captures of a kind by their settings, in the manifest's order."""
        found: dict[object, list[Any]] = {}
        for capture in self.recordings.captures(kind, self.side):
            found.setdefault(key(capture), []).append(capture)
        return list(found.values())

    # --- parts that several blocks share ---

    def once(self, make: Callable[[Study], T]) -> T:
        """What `make` finds, or why it can't, made once: several blocks read different numbers off it."""
        if make not in self._made:
            try:
                self._made[make] = make(self)
            except NotDetermined as refused:
                self._made[make] = refused
        found = self._made[make]
        if isinstance(found, NotDetermined):
            raise found
        return cast(T, found)

    @cached_property
    def _before(self) -> dict[str, Capture]:
        """The capture before each, in the order of their times where all have one, else in the manifest's."""
        order: list[Capture] = list(self.recordings.captures(side=self.side))
        if all(c.time is not None for c in order):
            order.sort(key=self.elapsed_s)
        return {c.id: before for before, c in pairwise(order)}

    def settled(self, group: Sequence[C]) -> list[C]:
        """Of repeats those that follow another of them, and so hold nothing of another level that was left behind; all where these
        are fewer than two."""
        names = {c.id for c in group}
        found = [c for c in group if c.id in self._before and self._before[c.id].id in names]
        return found if len(found) > 1 else list(group)

    def carried_e(self, capture: Capture, channel: str, effects: Effects) -> float:
        """By how many electrons a channel's mean changes where charge is left behind, given what was read of it and of the capture
        before: read is y_t = (1 - q) x_t + q y_(t-1), of which q (y_(t-1) - y_t) is new. The first one follows empty pixels."""
        if not any(act_on(effects, LAG)):
            return 0.0
        model = Uniform(self.camera, effects)
        before = self._before.get(capture.id)
        read, left = (
            max(self.levels(c).whole[channel] - self.noise.black, 0.0) / self.noise.gain if c is not None else 0.0
            for c in (capture, before)
        )
        return float(np.mean(model.lag_e(np.array([left])) - model.lag_e(np.array([read]))))

    def offset(self, capture: Capture, effects: Effects) -> float:
        elapsed = self.elapsed_s(capture)
        return Uniform(self.camera, effects).offset_dn(elapsed, capture.temperature_c)

    def free_offsets(self, exposures: FloatArray) -> dict[str, FloatArray]:
        """Jacobian by black level and dark current, per prior standard deviation: that of their first guess."""
        return {
            "black": np.full(len(exposures), self.noise.black_std),
            "dark": exposures * self.noise.dark_std,
        }

    def free_warmth(self, captures: Sequence[Capture]) -> dict[str, FloatArray]:
        """Jacobian by the change of dark current per degree, for captures at another temperature than most. Dark frames don't take it:
        they measure the change."""
        if self.temperature_c is None:
            return {}
        warmer = [0.0 if c.temperature_c is None else c.temperature_c - self.temperature_c for c in captures]
        exposures = np.array([c.exposure_s for c in captures])
        return {"warmth": WARMTH_STD * self.noise.dark_dn_per_s * exposures * np.array(warmer)}


@dataclass(frozen=True)
class NoiseGuess:
    """First guesses, good to a few per cent: about these the free quantities are linear."""

    black: float
    dark_dn_per_s: float
    gain: float  # 1 where nothing tells it
    gain_is_known: bool
    read_dn: float
    prnu: float
    jitter_dn: float  # of a dark frame's mean
    jitter_lamp: float  # of a flat frame's mean, relative
    black_std: float  # of the guess
    dark_std: float  # DN/s, of the guess

    def spread_dn2(self, signal_dn: FloatArray) -> FloatArray:
        """Variance of pixels at a signal before rounding; read noise that rounding hides counts for nothing."""
        return np.asarray(self.gain * signal_dn + unrounded(self.read_dn**2) + (self.prnu * signal_dn) ** 2)


def _saturation(study: Study) -> float:
    """DN from which on a pixel counts as clipped: the converter's highest code, or less where full wells pile up below it.

    Wells that are full carry no shot noise: among the captures, planes whose highest quantiles lie closer together than a
    third of what shot noise makes them do pile up, at full well.
    """
    white = study.camera.white_level_dn
    gain = study.stated.conversion_gain_dn_per_e
    black = study.stated.black_level_dn or 0.0
    piles = []
    for kind in ("flat", "narrowband", "white"):
        for capture in study.recordings.captures(kind, study.side):
            frame = study.recordings.frame(capture)
            for channel in study.channels:
                row, col = mosaic.phases(study.camera.cfa)[channel][0]
                step = mosaic.step(study.camera.cfa)
                values = np.asarray(frame[row::step, col::step])
                if values.max() < 0.25 * white:
                    continue
                middle, high, top = np.quantile(values, [0.97, 0.99, 0.999])
                if gain is None:
                    # a tenth of the usual noise of a well of 1e5 e: what no unclipped plane falls below
                    least = 0.1 * np.sqrt(max(top - black, 1.0) * white / 1e5)
                else:
                    least = np.sqrt(gain * max(top - black, 1.0)) / 3.0
                if (
                    top - high < 0.76 * least and high - middle < 0.45 * least
                ):  # a normal distribution's quantiles, in sigmas
                    piles.append((float(top), float(top - middle)))
    below = [(top, width) for top, width in piles if top < white - 1.0]
    if not below:
        return white
    top = float(np.median([t for t, _ in below]))
    # a margin of the read noise under the pile
    return min(white, top - 3.0 * max(float(np.median([w for _, w in below])), 2.0))


def stale(recordings: RecordingSet, side: Side) -> tuple[tuple[str, str], ...]:
    """(id, why) of every capture whose frame is bit for bit that of an earlier one, noise and all: it wasn't taken.

    Frames without noise are alike by nature: one code nearly throughout, or recordings of which most repeats are the same.
    """
    first: dict[bytes, Capture] = {}
    found: list[tuple[str, str]] = []
    repeats, alike = 0, 0
    before: Capture | None = None
    for capture in recordings.captures(side=side):
        frame = recordings.frame(capture)
        settings = (capture.kind, capture.exposure_s, capture.gain_db)
        is_repeat = before is not None and settings == (before.kind, before.exposure_s, before.gain_db)
        repeats += is_repeat
        before = capture
        if frame.std(dtype=np.float32) < NOISELESS_DN:
            continue
        mark = hashlib.blake2b(frame.tobytes(), digest_size=16).digest()
        twin = first.setdefault(mark, capture)
        if twin is not capture and twin.frame != capture.frame:
            alike += is_repeat
            found.append(
                (
                    capture.id,
                    f"the frame of capture {capture.id} ({capture.kind}) is bit for bit that of {twin.id} ({twin.kind}), noise and all: it wasn't taken anew and is left out; take it again",
                )
            )
    return () if 2 * alike > repeats > 0 else tuple(found)


def noise_guess(study: Study) -> NoiseGuess:
    recordings, stated = study.recordings, study.stated
    black = stated.black_level_dn if stated.black_level_dn is not None else 0.0
    dark, read, jitter = 0.0, 1.0, BLACK_FLOOR_DN
    # the dark current is anything: within reason, what a data sheet says or some tens of electrons
    expected = stated.dark_current_e_per_s if stated.dark_current_e_per_s is not None else 50.0
    dark_std = max(expected * (stated.conversion_gain_dn_per_e or 1.0), 0.5)
    black_std = 0.05 * study.camera.white_level_dn
    if stated.black_level_dn is not None:
        black_std = max(STATED_BLACK_DN, STATED_BLACK_SHARE * black)
    darks = study.groups("dark", lambda c: (c.exposure_s, c.temperature_c, c.gain_db))
    if darks:
        # at one temperature, at which most captures were taken: what the others change isn't the baseline's
        off = [0.0 if study.temperature_c is None or g[0].temperature_c is None else abs(g[0].temperature_c - study.temperature_c) for g in darks]  # fmt: skip
        frames_mean = [np.array([float(recordings.frame(c).mean()) for c in g]) for g in darks]
        near = [i for i, away in enumerate(off) if away <= min(off) + ALIKE_C]
        t = np.array([darks[i][0].exposure_s for i in near])
        level = np.array([frames_mean[i].mean() for i in near])
        black_std = 1.0
        if len(t) > 1 and np.ptp(t) > 0:
            dark, black = (float(v) for v in np.polyfit(t, level, 1))
            dark = max(dark, 0.0)
            dark_std = max(0.2 * dark, 0.5)
        else:
            black = float(level[0])
            black_std += dark_std * float(t[0])
        jitter = max(_jitter(study, darks, frames_mean), BLACK_FLOOR_DN)
        first = min((darks[i] for i in near), key=lambda g: g[0].exposure_s)
        if len(first) > 1:
            read = float(np.sqrt(pair_variance([recordings.frame(c) for c in first[:4]])))
    gain, lamp = stated.conversion_gain_dn_per_e, 3e-4
    signal, variance, prnu = _transfer_points(study, black)
    if len(signal) > 1:
        s, v = np.array(signal), np.array(variance)
        low = s < 0.5 * (study.saturation_dn - black)
        use = low if low.sum() > 2 else np.ones_like(low)
        gain = _transfer_slope(s[use], v[use], read)
        lamp = level_scatter(repeated_levels(study, black, gain, read))
    elif gain is None:
        gain = _scene_gain(study, black, read)
    known = gain is not None and gain > 0
    gain = gain if gain is not None and known else 1.0
    return NoiseGuess(black, dark, gain, known, read, prnu, jitter, max(lamp, LAMP_FLOOR), black_std, dark_std)


def _transfer_points(study: Study, black: float) -> tuple[list[float], list[float], float]:
    """Signal and temporal variance (DN, DN^2) of repeated flats by level and channel; PRNU from what is between them and saturation."""
    step, prnu = mosaic.step(study.camera.cfa), USUAL_PRNU
    signal, variance = [], []
    for group in study.flat_levels():
        if len(group) < 2:
            continue
        frames = [study.recordings.frame(c) for c in group]
        evened = [_even_rows(f, step) for f in frames]  # a light that flickers is no shot noise
        freedom = 1.0 - step / frames[0].shape[1]
        for channel in study.channels:
            planes = [study.pixels_of(f, channel) for f in frames]
            if any(np.mean(p >= study.saturation_dn) >= CLIPPED_SHARE for p in planes):
                continue
            signal.append(float(np.mean([p.mean() for p in planes])) - black)
            variance.append(pair_variance([study.pixels_of(f, channel) for f in evened]) / freedom)
            if 0.3 < signal[-1] / (study.saturation_dn - black) < 0.8:
                row, col = mosaic.phases(study.camera.cfa)[channel][0]
                plane = np.mean(frames, axis=0)[row::step, col::step]
                rough = (plane - ndimage.uniform_filter(plane, 9))[6:-6, 6:-6]
                fixed = max(rough.var() - variance[-1] / len(frames), 0.0)
                prnu = float(np.sqrt(fixed) / signal[-1]) * 1.006  # of 81 pixels' mean, 1/81 of the variance is missing
    return signal, variance, prnu


def _scene_gain(study: Study, black: float, read_dn: float) -> float | None:
    """DN/e by repeats of whatever was seen: temporal variance over signal, of pixels alike in signal; None without repeats."""
    signal, variance = [], []
    for group in study.groups(None, lambda c: c.model_dump_json(exclude={"id", "frame", "time", "temperature_c"})):
        if len(group) < 2 or group[0].kind == "dark":
            continue
        one, two = (np.asarray(study.recordings.frame(c), float) - black for c in group[:2])
        two = two * one.sum() / max(two.sum(), 1e-9)
        mean, apart = 0.5 * (one + two).ravel(), 0.5 * np.square(one - two).ravel()
        edges = np.quantile(mean, np.linspace(0.0, 1.0, 9))
        for low, high in pairwise(edges):
            alike = (mean >= low) & (mean <= high)
            if alike.sum() > 200 and high < 0.8 * (study.saturation_dn - black):
                signal.append(float(mean[alike].mean()))
                variance.append(float(apart[alike].mean()))
    s = np.array(signal)
    return _transfer_slope(s, np.array(variance), read_dn) if np.any(s > 0) else None


def _transfer_slope(signal: FloatArray, variance: FloatArray, read_dn: float) -> float:
    """DN/e: of the line from the read noise through temporal variances over signal, each by its own size."""
    weight = 1.0 / np.maximum(variance, 1e-9)
    return float(np.sum(weight * signal * (variance - read_dn**2)) / np.sum(weight * signal**2))


def _even_rows(frame: Any, step: int) -> FloatArray:
    """A frame whose rows have the same mean in each plane of the mosaic."""
    even = np.array(frame, float)
    for row in range(step):
        for col in range(step):
            plane = even[row::step, col::step]
            plane -= plane.mean(axis=1, keepdims=True) - plane.mean()
    return even


def _jitter(study: Study, groups: Sequence[Sequence[Capture]], means: Sequence[FloatArray]) -> float:
    """Standard deviation of the repeats' means, less what changes evenly with time in all groups alike: that is a drift.

    Of few repeats it is pulled towards what is usual: `USUAL_JITTER_DN` counts as two repeats.
    """
    away, elapsed, freedom = [], [], 0
    for group, mean in zip(groups, means, strict=True):
        if len(group) > 1:
            time = np.array([study.elapsed_s(c) for c in group])
            away.append(mean - mean.mean())
            elapsed.append(time - time.mean())
            freedom += len(group) - 1
    if freedom == 0:
        return 0.05
    rest, time = np.concatenate(away), np.concatenate(elapsed)
    if freedom > 2 and np.any(time):
        rest = rest - time * float(time @ rest) / float(time @ time)
        freedom -= 1
    return float(np.sqrt((rest @ rest + 2.0 * USUAL_JITTER_DN**2) / (freedom + 2.0)))


@dataclass(frozen=True)
class RepeatedLevels:
    """Frames of one flat setting: their levels less the mean, relative; seconds less the mean; relative variance by pixels' noise."""

    captures: tuple[Capture, ...]
    away: FloatArray
    elapsed_s: FloatArray
    noise: float


def repeated_levels(study: Study, black: float, gain: float, read_dn: float) -> list[RepeatedLevels]:
    """Of every flat setting with repeats, all unclipped channels together, frames that may hold what another level left behind
    not among them; DN and DN/e."""
    found = []
    for group in map(study.settled, study.flat_levels()):
        planes = [c for c in study.channels if all(study.levels(k).mean[c] is not None for k in group)]
        if len(group) < 2 or not planes:
            continue
        size = np.array([study.levels(group[0]).pixels[c] for c in planes], float)
        levels = np.array([[study.levels(k).mean[c] or 0.0 for c in planes] for k in group]) - black
        total = levels @ size
        if total.mean() <= 0:
            continue
        noise = float(((gain * np.maximum(levels.mean(0), 0.0) + read_dn**2) * size).sum()) / total.mean() ** 2
        elapsed = np.array([study.elapsed_s(k) for k in group])
        found.append(RepeatedLevels(tuple(group), total / total.mean() - 1.0, elapsed - elapsed.mean(), noise))
    return found


def level_scatter(repeats: Sequence[RepeatedLevels]) -> float:
    """Relative scatter of repeated flat frames' levels beyond pixels' noise, a common trend with time taken out: a lamp that drifts
    doesn't scatter. Settings count by the inverse of their noise's variance."""
    weight = np.array([1.0 / (r.noise + LAMP_FLOOR**2) for r in repeats])
    moved = sum(w * float(r.elapsed_s @ r.elapsed_s) for w, r in zip(weight, repeats, strict=True))
    trend = 0.0
    if moved > 0:
        trend = sum(w * float(r.elapsed_s @ r.away) for w, r in zip(weight, repeats, strict=True)) / moved
    left = [float(np.sum(np.square(r.away - trend * r.elapsed_s))) - (len(r.away) - 1) * r.noise for r in repeats]
    free = float(sum(w * (len(r.away) - 1) for w, r in zip(weight, repeats, strict=True)))
    return float(np.sqrt(max(float(weight @ left) / free, 0.0))) if free > 0 else 0.0


def pair_variance(frames: Sequence[Any]) -> float:
    """Temporal variance from repeats: mean over pixels of the sample variance, frames' means taken out."""
    stack = np.stack([np.asarray(f, np.float32) - np.float32(np.mean(f, dtype=float)) for f in frames])
    n = len(frames)
    return (
        float(np.mean(stack.var(axis=0, ddof=1, dtype=np.float64))) * (1.0 + 1.0 / max(stack[0].size, 1))
        if n > 1
        else 0.0
    )


def held_out_of(group: Sequence[Capture], index: int, groups: int) -> set[str]:
    """Captures that choice and fit don't see: the last third of the repeats; without repeats every third condition."""
    if len(group) > 1:
        return {c.id for c in group[len(group) - max(len(group) // 3, 1) :]}
    return {group[0].id} if groups >= 3 and index % 3 == 1 else set()


def act_on(effects: Effects, reads: frozenset[str]) -> list[bool]:
    """Of each effect, whether it changes any of these quantities of the stages."""
    return [not reads.isdisjoint(changed_by(effect)) for effect in effects]
