"""A dataset: one side of a recording set, its frames summarised once, with what several observables share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, TypeVar, cast

import numpy as np

from lab.capture_kinds.base import Capture
from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.errors import NotDetermined
from lab.formats.recording_set import DataSheet, RecordingSet
from lab.formats.results import NoiseFit
from lab.observables.acquisition_errors import CopiedFrames, copied_frames
from lab.observables.codes.step import CodeStep, find_code_step, under_highest_code
from lab.observables.flats.stated_light import lamps_of, most_frequent_gain_db
from lab.observables.noise.figures import NoiseFigures, noise_figures
from lab.observables.noise.repeats import find_drifts
from lab.observables.noise.side_levels import DarkLevels, dark_levels, flat_statistics, usual_darks
from lab.observables.noise.stack import PlaneStatistics
from lab.observables.plane_means import channel_means
from lab.observables.reads import LAG, acting
from sim.camera import CameraModel, Side
from sim.effects.base import Effects
from sim.sensor import mosaic
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import FieldPoints, Uniform

T = TypeVar("T")
C = TypeVar("C", bound=Capture)
TAIL_STD = 0.1  # relative standard deviation of the light that the baseline's point spread function sends far
CLIPPED_SHARE = 2e-4  # of a plane's pixels: with fewer clipped ones its mean is used
WARMTH_STD = 0.1  # prior relative change of the dark current per degree C: it doubles within 5 to 10 degrees


@dataclass(frozen=True)
class Levels:
    """Means of one capture by channel."""

    mean: dict[str, float | None]  # DN; None where the channel clips
    pixels: dict[str, int]
    whole: dict[str, float]  # DN, clipped or not


class Dataset:
    """One side of a recording set, from which observables are measured. What they share is computed once.

    `camera`: the baseline; its gain, black level, dark current, read noise and full well are those of the noise fit, or
    first estimates where there is none (`noise_figures`). `saturation_dn`: code from which on pixels clip (None:
    estimated). `misstated`: ids of flats whose stated number of photons contradicts the others. `fitted`: the side's
    noise fit, None where its recordings don't determine one. `noise`: known figures in the place of all estimates; the
    baseline then is `camera` as it is.
    """

    def __init__(
        self,
        recordings: RecordingSet,
        side: Side,
        camera: CameraModel,
        saturation_dn: float | None = None,
        misstated: frozenset[str] = frozenset(),
        fitted: NoiseFit | None = None,
        noise: NoiseFigures | None = None,
    ) -> None:
        self.misstated, self.fitted = misstated, fitted
        #: Captures that are left out, as their frames weren't taken anew.
        self.copies: CopiedFrames = copied_frames(recordings, side)
        self.recordings = recordings.without(self.copies.ids) if self.copies.ids else recordings
        code = find_code_step(self.recordings, side) if noise is None else CodeStep(noise.step_dn)
        self._coded = under_highest_code(self.recordings, side, code)
        #: Step of the codes, DN.
        self.step_dn = code.step_dn
        camera = camera.model_copy(update={"white_level_dn": code.highest_dn(camera.white_level_dn)})
        self.side, self.camera = side, camera
        #: Clipping level: the converter's highest code, or the full well where that is lower.
        self.saturation_dn = min(camera.white_level_dn, saturation_dn or camera.white_level_dn)
        self.stated: DataSheet = recordings.camera(side)
        self.channels = camera.channels
        #: Highest frequency, cy/px, up to which edges are measured; None: as far as they show contrast.
        self.highest_cy_per_px: float | None = None
        self._levels: dict[str, Levels] = {}
        self._made: dict[Any, Any] = {}
        self._spectra: dict[str, Spectrum] = {}
        times = [c.time for c in recordings.captures(side=side) if c.time is not None]
        #: Time of the side's first capture; None where none is stated.
        self.first_time = min(times) if times else None
        warm = [c.temperature_c for c in recordings.captures(side=side) if c.temperature_c is not None]
        #: Median temperature of the sensor; None where none is stated.
        self.temperature_c = float(np.median(warm)) if warm else None
        self.field = FieldPoints.of(camera)
        if saturation_dn is None:
            self.saturation_dn = clipping_level_dn(self)
        #: Amplification, dB, of most of the flats: that of `noise.gain`.
        self.usual_gain_db = most_frequent_gain_db(self.recordings.captures(FlatCapture, side))
        self.noise: NoiseFigures = noise_figures(self) if noise is None else noise
        if noise is not None:
            return
        self.camera = camera.model_copy(
            update={
                "conversion_gain_dn_per_e": self.noise.gain,
                "black_level_dn": self.noise.black,
                "dark_current_e_per_s": self.noise.dark_dn_per_s / self.noise.gain,
                "read_noise_e": self.noise.read_dn / self.noise.gain,
                "full_well_e": (self.saturation_dn - self.noise.black) / self.noise.gain,
                "dark_current_reference_c": camera.dark_current_reference_c
                if self.noise.dark_c is None
                else self.noise.dark_c,
            }
        )

    def elapsed_s(self, capture: Capture) -> float:
        """Time since the side's first capture, s; 0 where no time is stated."""
        if capture.time is None or self.first_time is None:
            return 0.0
        return (capture.time - self.first_time).total_seconds()

    def spectrum(self, path: str) -> Spectrum:
        """Return a spectrum of the recording set, read once."""
        if path not in self._spectra:
            self._spectra[path] = self.recordings.spectrum(path)
        return self._spectra[path]

    def plane_mask(self, channel: str, shape: tuple[int, int]) -> FloatArray:
        """Mask (rows, cols) of a channel's pixels in a frame of that shape."""
        mask = np.zeros(shape, bool)
        step = mosaic.step(self.camera.cfa)
        for row, col in mosaic.phases(self.camera.cfa)[channel]:
            mask[row::step, col::step] = True
        return mask

    def levels(self, capture: Capture) -> Levels:
        """Return the means of a capture by channel, computed once. A channel clips where `CLIPPED_SHARE` of the pixels
        of one of its planes do."""
        if capture.id not in self._levels:
            found = channel_means(self.recordings.codes(capture), self.camera.cfa)
            whole = {c: one.mean_dn for c, one in found.items()}
            clips = {c: one.clipped_share(self.saturation_dn) >= CLIPPED_SHARE for c, one in found.items()}
            self._levels[capture.id] = Levels(
                {c: None if clips[c] else mean for c, mean in whole.items()},
                {c: one.pixels for c, one in found.items()},
                whole,
            )
        return self._levels[capture.id]

    @property
    def diffraction_is_known(self) -> bool:
        """Whether f-number and pixel pitch are stated."""
        return self.stated.f_number is not None and self.stated.pixel_pitch_um is not None

    @property
    def level_is_known(self) -> bool:
        """Whether the radiance before the lens predicts a level in DN: gain, f-number and pixel pitch are known."""
        return self.noise.gain_is_known and self.diffraction_is_known

    @property
    def tail_std(self) -> float:
        """Relative standard deviation of the light that the baseline's point spread function sends far; 1 where
        f-number or pixel pitch isn't stated."""
        return TAIL_STD if self.diffraction_is_known else 1.0

    @cached_property
    def darks(self) -> DarkLevels:
        """Levels of the darks at the usual gain, with what the order of their repeats shows."""
        flats = self.recordings.captures(FlatCapture, self.side)
        found = dark_levels(self._coded, usual_darks(self.recordings, self.side), flats, self.step_dn)
        return found.with_drifts(find_drifts(self.recordings, self.side, ("dark",)))

    def flat_statistics(self, group: Sequence[FlatCapture]) -> dict[str, PlaneStatistics]:
        """Return the statistics by plane of the repeats of one level of flats."""
        return flat_statistics(self._coded, group, self.darks, self.step_dn)

    @cached_property
    def lamps(self) -> dict[str, int]:
        """Number of the lamp of each radiance file of flats."""
        return lamps_of(self.recordings, self.recordings.captures(FlatCapture, self.side))

    def flat_levels(self) -> list[list[Any]]:
        """Flat captures by what sets their level: exposure, lamp, gain, number of photons."""
        return self.groups(
            "flat", lambda c: (c.exposure_s, self.lamps.get(c.radiance, -1), c.gain_db, c.photons_per_pixel)
        )

    def groups(self, kind: Any, key: Callable[[Any], object]) -> list[list[Any]]:
        """Captures of a kind with equal `key`, in the manifest's order."""
        found: dict[object, list[Any]] = {}
        for capture in self.recordings.captures(kind, self.side):
            found.setdefault(key(capture), []).append(capture)
        return list(found.values())

    # --- what several measurements share ---

    def once(self, make: Callable[[Dataset], T]) -> T:
        """`make(self)`, computed once. Where it raised NotDetermined, that is raised again."""
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
    def in_time_order(self) -> list[Capture]:
        """The side's captures as they were taken: by time where all have one, else in the manifest's order."""
        order: list[Capture] = list(self.recordings.captures(side=self.side))
        return sorted(order, key=self.elapsed_s) if all(c.time is not None for c in order) else order

    @cached_property
    def _before(self) -> dict[str, Capture]:
        """Id of a capture -> the capture whose frame was read before its own. After dummy frames that is a frame of the
        same capture."""
        order = self.in_time_order
        return {c.id: before for before, c in pairwise(order)} | {c.id: c for c in order if c.dummy_frames}

    def settled(self, group: Sequence[C]) -> list[C]:
        """Repeats that follow another of the group, and so hold no image lag of another level; all, where these are
        fewer than two."""
        names = {c.id for c in group}
        found = [c for c in group if c.id in self._before and self._before[c.id].id in names]
        return found if len(found) > 1 else list(group)

    def carried_e(self, effects: Effects) -> Callable[[Capture, str], float]:
        """Function of a capture and a channel: change of the mean by what frames before leave, electrons.

        Lag of share q reads y_t = (1 - q) x_t + q y_(t-1) for the charge x_t. The change is taken as q (y_(t-1) - y_t)
        from the measured levels, generally lag_e(y_(t-1)) - lag_e(y_t). Before the first capture pixels are empty.
        Traps fill and empty with the measured levels, too (`_released_e`)."""
        if not acting(effects, LAG):
            return lambda capture, channel: 0.0
        model = Uniform(self.camera, effects)
        released = self._released_e(model) if acting(effects, frozenset({"charge.traps"})) else {}

        def carried(capture: Capture, channel: str) -> float:
            before = self._before.get(capture.id)
            read, left = (0.0 if c is None else self._read_e(c, channel) for c in (capture, before))
            lag_e = float(np.mean(model.lag_e(np.array([left])) - model.lag_e(np.array([read]))))
            return lag_e + released.get((capture.id, channel), 0.0)

        return carried

    def carried_mean_e(self, effects: Effects) -> Callable[[Capture], float]:
        """Function of a capture: the same of the mean of all pixels."""
        carried = self.carried_e(effects)

        def mean(capture: Capture) -> float:
            pixels = self.levels(capture).pixels
            return sum(n * carried(capture, channel) for channel, n in pixels.items()) / sum(pixels.values())

        return mean

    def _read_e(self, capture: Capture, channel: str) -> float:
        return max(self.levels(capture).whole[channel] - self.noise.black, 0.0) / self.noise.gain

    def _released_e(self, model: Uniform) -> dict[tuple[str, str], float]:
        """Electrons that traps release by (id of a capture, channel), up to the last capture of even light or none, so
        that no frames are read for it besides. None where a capture has no time: how much is left by then isn't known.
        Dummy frames are taken as one directly after the other."""
        order = self.in_time_order
        even = [k for k, c in enumerate(order) if isinstance(c, DarkCapture | FlatCapture | NarrowbandCapture)]
        taken = order[: even[-1] + 1] if even else []
        if any(c.time is None for c in taken):
            return {}
        frames = [(c, back) for c in taken for back in range(c.dummy_frames or 0, -1, -1)]
        exposure_s = np.array([c.exposure_s for c, _ in frames])
        begin_s = np.array([self.elapsed_s(c) - back * c.exposure_s for c, back in frames])
        read_e = np.array([[self._read_e(c, channel) for channel in self.channels] for c, _ in frames])
        found = model.released_e(begin_s, exposure_s, read_e)
        kept = ((c, row) for (c, back), row in zip(frames, found, strict=True) if back == 0)
        return {(c.id, channel): float(e) for c, row in kept for channel, e in zip(self.channels, row, strict=True)}

    def offset(self, effects: Effects) -> Callable[[Capture], float]:
        """Function of a capture: change of its black level by effects, DN."""
        model = Uniform(self.camera, effects)
        return lambda capture: model.offset_dn(self.elapsed_s(capture), capture.temperature_c, capture.exposure_s)

    def free_offsets(self, exposures: FloatArray) -> dict[str, FloatArray]:
        """Jacobian by black level and dark current, for n exposures: name -> (n,), DN per standard deviation of the
        first estimate."""
        return {
            "black": np.full(len(exposures), self.noise.black_std),
            "dark": exposures * self.noise.dark_std,
        }

    def free_warmth(self, captures: Sequence[Capture]) -> dict[str, FloatArray]:
        """Jacobian by the change of dark current per degree C: name -> (n,), DN per prior standard deviation.

        It is for captures at another temperature than the dark frames. Measurements of dark frames don't use it: they
        measure the change."""
        if self.noise.dark_c is None:
            return {}
        warmer = [0.0 if c.temperature_c is None else c.temperature_c - self.noise.dark_c for c in captures]
        exposures = np.array([c.exposure_s for c in captures])
        return {"warmth": WARMTH_STD * self.noise.dark_dn_per_s * exposures * np.array(warmer)}


def mean_frame(recordings: RecordingSet, captures: Sequence[Capture]) -> FloatArray:
    """Mean (rows, cols) of the captures' frames, DN."""
    total = recordings.frame(captures[0]).astype(float)
    for capture in captures[1:]:
        total += recordings.frame(capture)
    return total / len(captures)


def clipping_level_dn(dataset: Dataset) -> float:
    """Code (DN) from which on a pixel counts as clipped: the converter's highest, or less where the full well is
    reached before it.

    Pixels at full well have no shot noise. A plane is taken to be there where its 97, 99 and 99.9 % quantiles lie
    closer together than a third of their distance by shot noise.
    """
    white = dataset.camera.white_level_dn
    gain = dataset.stated.conversion_gain_dn_per_e
    black = dataset.stated.black_level_dn or 0.0
    piles = []
    for kind in ("flat", "narrowband", "white"):
        for capture in dataset.recordings.captures(kind, dataset.side):
            codes = dataset.recordings.codes(capture)
            for counts, *_ in codes.channels(dataset.camera.cfa).values():
                if counts.highest_dn < 0.25 * white:
                    continue
                middle, high, top = counts.quantiles([0.97, 0.99, 0.999])
                if gain is None:
                    # a tenth of the shot noise for a full well of 1e5 e: less than any unclipped plane has
                    least = 0.1 * np.sqrt(max(top - black, 1.0) * white / 1e5)
                else:
                    least = np.sqrt(gain * max(top - black, 1.0)) / 3.0
                if (
                    top - high < 0.76 * least and high - middle < 0.45 * least
                ):  # quantiles of a normal distribution, in standard deviations
                    piles.append((float(top), float(top - middle)))
    below = [(top, width) for top, width in piles if top < white - 1.0]
    if not below:
        return white
    top = float(np.median([t for t, _ in below]))
    # a margin below the full well for the noise of its pixels
    return min(white, top - 3.0 * max(float(np.median([w for _, w in below])), 2.0))


def held_out_of(group: Sequence[Capture], index: int, groups: int) -> set[str]:
    """Ids of the held-out captures of a group of repeats: the last third, at least one. Of groups without repeats,
    every third is held out, where there are three or more (`groups`: their number, `index`: this one's)."""
    if len(group) > 1:
        return {c.id for c in group[len(group) - max(len(group) // 3, 1) :]}
    return {group[0].id} if groups >= 3 and index % 3 == 1 else set()


def held_out_flats(dataset: Dataset) -> frozenset[str]:
    """Ids of held-out flats: the last third of a level's repeats where it has six or more, as temporal noise needs
    pairs. Of other levels, every third from the darkest on, never the brightest."""
    groups = dataset.flat_levels()
    size = {id(g): float(np.mean(list(dataset.levels(g[0]).whole.values()))) for g in groups}
    out: set[str] = set()
    for rank, group in enumerate(sorted(groups, key=lambda g: size[id(g)])):
        if len(group) >= 6:
            out |= {c.id for c in group[len(group) - len(group) // 3 :]}
        elif rank % 3 == 1 and rank < len(groups) - 1:
            out |= {c.id for c in group}
    return frozenset(out)
