"""The levels of one camera: all frames of one exposure, light and temperature each, and what their stacks measure."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field

import numpy as np

from lab.capture_kinds.base import Capture
from lab.capture_kinds.dark import DarkCapture
from lab.formats.recording_set import DataSheet
from lab.formats.results import RepeatDrift
from lab.observables.codes.rounding import HIDDEN_DN2, QUANTISATION_DN2
from lab.observables.noise.stack import PlaneStatistics
from sim.spectrum import FloatArray

BLACK_CLIPPED_SHARE = 1e-3  # of pixels at 0 in a dark, above which darks are clipped
#: Share of saturation that the levels of a figure at saturation have to reach: a parabola through less says nothing of
#: what it does beyond twice their range.
LEAST_REACH = 0.5


@dataclass(frozen=True)
class MeasuredLevel:
    """One level of light (0: dark): its setting, and the statistics of its planes by name.

    `light` is proportional to the photons among the levels of the same `lamp`. `captures`: ids of the frames.
    `light_std`, `light_calibration_std`: relative standard uncertainties of `light`, of its own, and common to all
    levels of the lamp. `temperature_c`: to a degree where it groups darks; `sensor_c`: the frames' mean, not rounded.
    `drift`: of the repeats over time, where there is one.
    """

    exposure_s: float
    light: float
    lamp: Hashable
    plane: dict[str, PlaneStatistics]
    temperature_c: float | None = None
    captures: tuple[str, ...] = ()
    light_std: float = 0.0
    light_calibration_std: float = 0.0
    sensor_c: float | None = None
    drift: RepeatDrift | None = None

    @property
    def repeats(self) -> int:
        """Number of frames."""
        return next(iter(self.plane.values())).repeats

    @property
    def drift_std_dn(self) -> float:
        """Standard uncertainty of the mean by a drift of the repeats, DN."""
        return 0.0 if self.drift is None else self.drift.level_dn_std

    @property
    def pixels(self) -> int:
        """Number of pixels of a frame that count."""
        return sum(plane.pixels for plane in self.plane.values())

    @property
    def mean_variance_dn2(self) -> float:
        """Variance of a frame's mean by the noise of its pixels as recorded, DN^2: that of one pixel that is rounded
        otherwise at least. NaN with a single frame."""
        weights = [plane.pixels for plane in self.plane.values()]
        variance = np.average([plane.temporal_variance for plane in self.plane.values()], weights=weights)
        step_dn2 = next(iter(self.plane.values())).step_dn ** 2
        return float(np.maximum(variance, step_dn2 / self.pixels)) / self.pixels

    def frame_means(self, names: Sequence[str] = ()) -> FloatArray:
        """Return the mean of each frame (n,) over the planes `names`, or all, DN."""
        own = self._planes(names)
        return np.average([plane.frame_means for plane in own], axis=0, weights=[plane.pixels for plane in own])

    def pixel_variance_dn2(self, names: Sequence[str] = ()) -> float:
        """Return the temporal variance of a pixel of the planes `names`, or all, DN^2: that of rounding at least. NaN
        with a single frame."""
        own = self._planes(names)
        variance = np.average([plane.temporal_variance for plane in own], weights=[plane.pixels for plane in own])
        least = QUANTISATION_DN2 * own[0].step_dn ** 2
        return max(float(variance), least) if np.isfinite(variance) else float("nan")

    def _planes(self, names: Sequence[str]) -> list[PlaneStatistics]:
        return [self.plane[name] for name in names or self.plane]

    def scatter(self, frame_means: FloatArray) -> tuple[FloatArray, int]:
        """Return frame means (n,) less their mean and less the drift in proportion, and the degrees of freedom."""
        rest = frame_means - frame_means.mean()
        if self.drift is None or set(self.captures) != set(self.drift.captures):
            return rest, rest.size - 1
        at = dict(zip(self.drift.captures, self.drift.curve_dn, strict=True))
        curve = np.array([at[name] for name in self.captures])
        curve -= curve.mean()
        return rest - float(curve @ rest) / float(curve @ curve) * curve, rest.size - 2


@dataclass(frozen=True)
class Remarks:
    """What a fit has to say beside its figures, each sentence once."""

    sentences: list[str] = field(default_factory=list)

    def add(self, sentence: str) -> None:
        """Add a sentence where it isn't there yet."""
        if sentence not in self.sentences:
            self.sentences.append(sentence)


@dataclass(frozen=True)
class RecordedLevels:
    """Levels of one camera at one gain.

    `names`: planes of the mosaic. `flats`: in ascending light. `all_darks`: in ascending exposure; `darks`: those of
    `temperature_c`, none where they are clipped at 0 (`black_clipped`). `defects`: pixels that were left out of all
    levels.
    """

    camera: DataSheet
    gain_db: float
    defects: int
    names: tuple[str, ...]
    flats: tuple[MeasuredLevel, ...]
    all_darks: tuple[MeasuredLevel, ...]
    darks: tuple[MeasuredLevel, ...]
    temperature_c: float | None
    black_clipped: bool

    @property
    def white_dn(self) -> float:
        """Highest code."""
        return self.camera.saturation_dn

    @property
    def step_dn(self) -> float:
        """Step of the codes, DN."""
        return self.flats[0].plane[self.names[0]].step_dn

    @property
    def quantisation_dn2(self) -> float:
        """Variance of rounding to the step of the codes, DN^2."""
        return QUANTISATION_DN2 * self.step_dn**2

    @property
    def hidden_dn2(self) -> float:
        """Variance, DN^2, below which rounding to the step of the codes hides the noise."""
        return HIDDEN_DN2 * self.step_dn**2

    def pixel_variance_dn2(self, level: MeasuredLevel, name: str) -> float:
        """Return the temporal variance of single pixels of a plane, DN^2: of a flat, without what the pixels of a row
        share beyond dark frames, as they do in a light that flickers while the rows are exposed."""
        own = level.plane[name]
        if level.lamp == "dark":
            return own.temporal_variance
        dark = [one.plane[name].row_variance for one in self.darks if one.repeats > 1]
        return own.temporal_variance - own.row_variance + (float(np.mean(dark)) if dark else 0.0)

    @classmethod
    def of(
        cls,
        darks: Sequence[MeasuredLevel],
        flats: Sequence[MeasuredLevel],
        camera: DataSheet,
        gain_db: float,
        defects: int,
        names: tuple[str, ...],
        remarks: Remarks,
    ) -> RecordedLevels:
        """Choose the darks of the temperature at which most flats (or else most darks) were taken."""
        bright = tuple(sorted(flats, key=lambda level: (level.light, level.exposure_s)))
        every = tuple(sorted(darks, key=lambda level: level.exposure_s))
        temperature = usual_c([level.temperature_c for level in every], [level.temperature_c for level in bright])
        own = tuple(level for level in every if level.temperature_c == temperature)
        clipped = any(level.plane[name].zero_share > BLACK_CLIPPED_SHARE for level in own for name in names)
        if clipped:
            remarks.add(
                "dark frames are clipped at 0 DN: black level, read noise, dark current and DSNU aren't determined; "
                "raise the black level"
            )
        return cls(camera, gain_db, defects, names, bright, every, () if clipped else own, temperature, clipped)


def usual_c(dark_c: Sequence[float | None], bright_c: Sequence[float | None]) -> float | None:
    """Return the temperature, to a degree, of the darks (`dark_c`) at which most bright captures were taken, or else
    most darks."""
    present = [rounded_c(one) for one in dark_c]
    wanted = [rounded_c(one) for one in bright_c]
    return max(dict.fromkeys(present), key=lambda t: (wanted.count(t), present.count(t)), default=None)


#: Darks within this of the usual temperature belong to it: their dark current differs by 10 % (it doubles in some 7 C),
#: and a sensor that stands between two whole degrees keeps all of its darks.
NEAR_C = 1.0


def darks_near(darks: Sequence[DarkCapture], bright: Sequence[Capture]) -> list[DarkCapture]:
    """Return the darks of the temperature at which most of the captures `bright` were taken, or else most darks; all
    where none is stated."""
    usual = usual_c([dark.temperature_c for dark in darks], [capture.temperature_c for capture in bright])
    if usual is None:
        return [dark for dark in darks if dark.temperature_c is None]
    return [dark for dark in darks if dark.temperature_c is not None and abs(dark.temperature_c - usual) <= NEAR_C]


def rounded_c(temperature_c: float | None) -> float | None:
    """Return a temperature to a degree; levels of one degree belong together."""
    return None if temperature_c is None else float(round(temperature_c))
