"""Captures that contradict what is stated of them: copies of a frame, frames exchanged between levels, a mosaic without
colours. Nothing is exchanged or restated here: what is found is a proposal."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from scipy import stats

from lab.capture_kinds.base import Capture
from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.formats.recording_set import CodeCounts, RecordingSet
from lab.observables.codes.step import step_of
from lab.observables.flats.level_lines import CLIPPED_LIMIT, robust_response
from lab.observables.flats.stated_light import light_of, most_frequent_gain_db
from lab.observables.noise.levels import rounded_c
from sim.camera import Side
from sim.spectrum import FloatArray

# --- copied frames -------------------------------------------------------------------------------------------------
# Copied frames: a capture whose frame equals an earlier one's bit for bit wasn't taken anew.


NOISELESS_DN = 0.5  # frames of a smaller standard deviation may be equal by chance
LISTED = 3  # copies that are told one by one; of more, as many are named


@dataclass(frozen=True)
class CopiedFrames:
    """Captures of one side whose frames are copies: (capture, the earlier one that it equals)."""

    side: Side
    pairs: tuple[tuple[Capture, Capture], ...] = ()

    @property
    def ids(self) -> frozenset[str]:
        """Ids of the copies."""
        return frozenset(copy.id for copy, _ in self.pairs)

    @property
    def told(self) -> tuple[str, ...]:
        """Which captures, and what is done, in one line each; in one line for all where there are more than
        `LISTED`."""
        if len(self.pairs) <= LISTED:
            return tuple(
                f"the frame of capture {copy.id} ({copy.kind}) is bit for bit that of {twin.id} ({twin.kind}), noise "
                "and all: it wasn't taken anew "
                "and is left out; take it again"
                for copy, twin in self.pairs
            )
        named = ", ".join(f"{copy.id} is {twin.id}" for copy, twin in self.pairs[:LISTED])
        line = (
            f"the frames of {len(self.pairs)} captures of the {self.side} camera are copies of others, bit for bit, "
            f"noise and all ({named} ..): they "
            "weren't taken anew and are left out, so that temporal noise is unknown where no other repeat is left; "
            "give frames that were captured "
            "one by one"
        )
        return (line,)


def copied_frames(recordings: RecordingSet, side: Side, captures: Sequence[Capture] | None = None) -> CopiedFrames:
    """Return the copies among `captures` (all of the side). Frames of a standard deviation below `NOISELESS_DN` may be
    equal, and aren't tested."""
    first: dict[bytes, Capture] = {}
    found = []
    for capture in recordings.captures(side=side) if captures is None else captures:
        codes = recordings.codes(capture)
        if codes.every.std_dn < NOISELESS_DN:
            continue
        twin = first.setdefault(codes.digest, capture)
        if twin is not capture and twin.frame != capture.frame and _is_noisy(codes.every):
            found.append((capture, twin))
    return CopiedFrames(side, tuple(found))


def _is_noisy(counts: CodeCounts) -> bool:
    """Return whether a frame has a standard deviation of `NOISELESS_DN` steps of its codes, and can't be equal to
    another by chance."""
    return counts.std_dn >= NOISELESS_DN * step_of(counts)


# --- exchanged frames ----------------------------------------------------------------------------------------------
# Frames of a photon-transfer series that stand under each other's captures: two levels, or a dark and a flat,
# exchanged in an index. The exchange is proposed and never done: the captures concerned are left out.


SEED = 1288  # of the subsets of captures that the robust law draws
MEAN_STD, MEAN_STD_DN = (
    1e-3,
    0.1,
)  # standard deviation of a frame's mean, of its signal and in DN: lamps are steady to some 1e-3
CLIPPED_SHARE = 0.01  # of a frame's pixels, from which on its mean is a bound only
SAME_SCATTER, LEAST_SAME = 4.0, 0.003  # standard deviations, and share of the signal, within which a frame has a level
SAME_SATURATION, SAME_DN = 1e-3, 1.0  # the same beside it, of saturation, and at least; of darks the latter alone
APART = 3.0  # times that by which two levels that count as exchanged differ
DARK_SIGMA = 6.0  # of the darks about their line
SATURATED = 0.98  # of the highest mean, from which on a flat may saturate
#: Darks of one temperature (to a degree) that are judged: a line has two numbers, and one dark may be off it.
LEAST_DARKS = 4
#: Flats whose temperatures lie in one chain of smaller gaps were taken at one set point: a camera that warms up changes
#: by less from flat to flat, set points of a cooler differ by more.
SET_POINT_C = 2.0


@dataclass(frozen=True)
class JudgedFrame:
    """A capture with the mean of its frame and the level that the others give its setting, in DN; `tolerance_dn`:
    within which these agree."""

    capture: Capture
    mean_dn: float
    expected_dn: float
    tolerance_dn: float
    is_off: bool

    def fits(self, other: JudgedFrame) -> bool:
        """Return whether this frame has the level of the other's setting."""
        return abs(self.mean_dn - other.expected_dn) <= other.tolerance_dn


@dataclass(frozen=True)
class ExchangedFrames:
    """Pairs of captures, each of which has the level of the other's setting and not its own."""

    pairs: tuple[tuple[JudgedFrame, JudgedFrame], ...]

    @property
    def captures(self) -> tuple[str, ...]:
        """Ids of the captures."""
        return tuple(one.capture.id for pair in self.pairs for one in pair)

    @property
    def where(self) -> str:
        """The settings, in words."""
        return "; ".join(dict.fromkeys(f"{_setting(a.capture)} and {_setting(b.capture)}" for a, b in self.pairs))

    def told(self, side: Side) -> str:
        """Return which captures, and what fits, as a sentence."""
        groups: dict[tuple[str, str], list[tuple[JudgedFrame, JudgedFrame]]] = {}
        for a, b in self.pairs:
            groups.setdefault((_setting(a.capture), _setting(b.capture)), []).append((a, b))
        pairs = "; ".join(f"{_told([a for a, _ in own])}, and {_told([b for _, b in own])}" for own in groups.values())
        return (
            f"Captures of the {side} camera seem to hold each other's frames: {pairs}; they are left out: if the "
            "frames were exchanged, exchange these frames, or what is stated of them."
        )


def exchanged_frames(recordings: RecordingSet, side: Side) -> ExchangedFrames | None:
    """Darks and flats of one side whose frames seem exchanged in pairs; None where none is found.

    Each flat has an expected level by the response that the others of its lamp and set point of the temperature follow
    (`robust_response`, over captures), each dark by the line over the exposure of the darks of its temperature
    (Siegel's repeated medians). What another temperature explains is no evidence. Two captures seem exchanged where
    both are off their levels and each has that of the other's setting. Levels nearer than `APART` tolerances can't be
    told apart. At most a quarter of a lamp's captures may be wrong."""
    flats = recordings.captures(FlatCapture, side)
    if not flats:
        return None
    gain_db = most_frequent_gain_db(flats)
    flats = [flat for flat in flats if (flat.gain_db or 0.0) == gain_db]
    darks = [dark for dark in recordings.captures(DarkCapture, side) if (dark.gain_db or 0.0) == gain_db]
    if len(darks) < 2:
        return None
    judged = _judged(recordings, side, darks, flats)
    off = [one for one in judged if one.is_off]
    pairs: list[tuple[JudgedFrame, JudgedFrame]] = []
    free = set(map(id, off))
    for a, b in combinations(off, 2):
        apart = abs(a.expected_dn - b.expected_dn) > APART * max(a.tolerance_dn, b.tolerance_dn)
        if apart and {id(a), id(b)} <= free and a.fits(b) and b.fits(a):
            pairs.append((a, b))
            free -= {id(a), id(b)}
    return ExchangedFrames(tuple(pairs)) if pairs else None


def _judged(
    recordings: RecordingSet, side: Side, darks: Sequence[DarkCapture], flats: Sequence[FlatCapture]
) -> list[JudgedFrame]:
    """Every dark of a temperature, and every flat of a lamp and set point, whose level the others determine."""
    camera = recordings.camera(side)
    looked_at = []
    for capture in (*darks, *flats):
        counts = recordings.codes(capture).every
        looked_at.append((counts.mean_dn, counts.share_from(camera.saturation_dn) > CLIPPED_SHARE))
    mean, clipped = (np.array(values) for values in zip(*looked_at, strict=True))
    dark_mean, flat_mean = mean[: len(darks)], mean[len(darks) :]
    lines = _dark_lines(darks, dark_mean)
    saturation = max(float(mean.max()) - min(line.black for line in lines.values()), 1.0)
    least = max(SAME_SATURATION * saturation, SAME_DN)
    found = []
    for temperature_c, line in lines.items():
        alike = [number for number, dark in enumerate(darks) if rounded_c(dark.temperature_c) == temperature_c]
        if len(alike) < LEAST_DARKS:
            continue
        own = np.array([line.at(darks[number].exposure_s) for number in alike])
        away = np.abs(dark_mean[alike] - own)
        tolerance = max(DARK_SIGMA * 1.4826 * float(np.median(away)), SAME_DN)
        found += [
            JudgedFrame(darks[number], float(dark_mean[number]), float(e), tolerance, bool(a > tolerance))
            for number, e, a in zip(alike, own, away, strict=True)
        ]
    light = light_of(flats, camera)
    below = np.array([_nearest(lines, flat.temperature_c).at(flat.exposure_s) for flat in flats])
    points = _set_points(flats)
    lamps = [(flat.radiance, light[flat.id].lamp, point) for flat, point in zip(flats, points, strict=True)]
    for lamp in dict.fromkeys(lamps):
        mine = np.array([one == lamp for one in lamps])
        amount = np.array([light[flat.id].amount for flat, is_mine in zip(flats, mine, strict=True) if is_mine])
        signal: FloatArray = flat_mean[mine] - below[mine]
        law = robust_response(
            amount,
            signal,
            np.maximum(MEAN_STD * signal, MEAN_STD_DN),
            saturation,
            clipped[len(darks) :][mine] | (signal > SATURATED * saturation),
            np.random.default_rng(SEED),
        )
        if law is None:
            continue
        share = max(SAME_SCATTER * law.scatter, LEAST_SAME)
        for number, at in enumerate(np.flatnonzero(mine).tolist()):
            expected = float(law.expected_signal[number])
            found.append(
                JudgedFrame(
                    flats[int(at)],
                    float(flat_mean[at]),
                    float(below[at]) + expected,
                    share * expected + least,
                    bool(law.outlier[number]),
                )
            )
    return found


@dataclass(frozen=True)
class _RobustLine:
    """Dark means of one temperature against exposure."""

    black: float  # DN
    dn_per_s: float

    def at(self, exposure_s: float) -> float:
        """Return the dark mean at an exposure, DN."""
        return self.black + self.dn_per_s * exposure_s


def _dark_lines(darks: Sequence[DarkCapture], mean_dn: FloatArray) -> dict[float | None, _RobustLine]:
    """Return the line of Siegel's repeated medians by temperature, deg C: up to half of the darks may be off it.

    Source: Siegel, Biometrika 69, 242 (1982)."""
    by_c: dict[float | None, list[int]] = {}
    for number, dark in enumerate(darks):
        by_c.setdefault(rounded_c(dark.temperature_c), []).append(number)
    lines = {}
    for temperature_c, own in by_c.items():
        exposure = np.array([darks[number].exposure_s for number in own])
        slope, black = 0.0, float(np.median(mean_dn[own]))
        if np.unique(exposure).size > 1:
            slope, black = (float(v) for v in stats.siegelslopes(mean_dn[own], exposure))
        lines[temperature_c] = _RobustLine(black, slope)
    return lines


def _nearest(lines: dict[float | None, _RobustLine], temperature_c: float | None) -> _RobustLine:
    """Return the line of the nearest temperature, the first where none is stated."""
    stated = [known for known in lines if known is not None]
    if temperature_c is None or not stated:
        return next(iter(lines.values()))
    return lines[min(stated, key=lambda known: abs(known - temperature_c))]


def _set_points(flats: Sequence[FlatCapture]) -> list[int]:
    """Number of the chain of temperatures, with gaps up to `SET_POINT_C`, that each flat is in; -1 where none is
    stated."""
    known = sorted(flat.temperature_c for flat in flats if flat.temperature_c is not None)
    first = [warmer for cooler, warmer in pairwise(known) if warmer - cooler > SET_POINT_C]
    return [-1 if flat.temperature_c is None else sum(flat.temperature_c >= start for start in first) for flat in flats]


def _told(alike: Sequence[JudgedFrame]) -> str:
    """Captures of one setting, with the levels of the first."""
    one = alike[0]
    named = ", ".join(each.capture.id for each in alike)
    return f"{named} ({_setting(one.capture)}): {one.mean_dn:.4g} DN where the setting has {one.expected_dn:.4g} DN"


def _setting(capture: Capture) -> str:
    at = "" if capture.temperature_c is None else f", {capture.temperature_c:.4g} deg C"
    return f"{capture.kind}, {capture.exposure_s:.4g} s{at}"


# --- alike planes --------------------------------------------------------------------------------------------------
# A sensor without colour filters that is stated with a mosaic: its planes answer every light alike.


#: Share of the signal, and DN, within which planes are alike: colours differ by tens of percent.
ALIKE, ALIKE_DN = 0.005, 0.1
BRIGHT_SHARE = 0.1  # of the range: signal from which on a light counts
#: Of one light, analogue gains may make colours alike; then the variances over the signals differ by as much. Relative,
#: and standard deviations of a variance, within which they are alike.
SAME_GAIN, SAME_GAIN_SIGMA = 0.1, 4.0


@dataclass(frozen=True)
class AlikePlanes:
    """The captures of bright lights in which all planes are alike; `largest`: departure of a plane from their mean, as
    a share of the signal."""

    stated: str
    lights: int
    largest: float
    captures: tuple[str, ...]

    def told(self, side: Side) -> str:
        """Return what is stated and what fits, as a sentence."""
        return (
            f"The four planes of the {side} camera answer {self.lights} light{'s' if self.lights > 1 else ''} alike "
            f"within {100 * self.largest:.2g} %, as "
            f"those of a sensor without colour filters do, but cfa = {self.stated} is stated: correct cfa to MONO, or "
            "give frames that weren't made grey."
        )


def alike_planes(recordings: RecordingSet, side: Side) -> AlikePlanes | None:
    """Return the planes of a stated mosaic, where they are alike in every bright light: of flats and narrowband
    captures, the brightest frame of each light that doesn't clip. None where they differ, or where no light is bright
    enough."""
    camera = recordings.camera(side)
    if camera.cfa == "MONO" or min(camera.rows, camera.cols) < 2:  # a line has no four planes
        return None
    darks = recordings.captures(DarkCapture, side)
    black = recordings.codes(darks[0]).every.mean_dn if darks else (camera.black_level_dn or 0.0)
    brightest: dict[tuple[Hashable, ...], tuple[float, float, Capture]] = {}
    for capture in (*recordings.captures(FlatCapture, side), *recordings.captures(NarrowbandCapture, side)):
        codes = recordings.codes(capture)
        signal = codes.every.mean_dn - black
        light = (capture.kind, getattr(capture, "wavelength_nm", None), getattr(capture, "radiance", None))
        if signal < BRIGHT_SHARE * camera.saturation_dn or (light in brightest and signal <= brightest[light][0]):
            continue
        if codes.every.share_from(camera.saturation_dn) > CLIPPED_LIMIT:
            continue
        means = np.array([cell.mean_dn for cell in codes.cells])
        brightest[light] = signal, float(np.abs(means - means.mean()).max()), capture
    if not brightest or any(away > ALIKE * signal + ALIKE_DN for signal, away, _ in brightest.values()):
        return None
    lights = {light[:2] for light in brightest}  # a lamp may be read before every pass
    if len(lights) == 1 and not _same_gain(recordings, side, max(brightest.values(), key=lambda one: one[0])[2]):
        return None
    return AlikePlanes(
        camera.cfa,
        len(lights),
        max(away / signal for signal, away, _ in brightest.values()),
        tuple(capture.id for _, _, capture in brightest.values()),
    )


def _planes(frame: FloatArray) -> Sequence[FloatArray]:
    even = frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]
    return [even[row::2, col::2] for row in (0, 1) for col in (0, 1)]


def _same_gain(recordings: RecordingSet, side: Side, capture: Capture) -> bool:
    """Return whether the planes have one temporal variance in a capture and a repeat of it; False without a repeat."""
    setting = (capture.kind, capture.exposure_s, capture.gain_db)
    repeats = [
        c for c in recordings.captures(side=side) if c.id != capture.id and (c.kind, c.exposure_s, c.gain_db) == setting
    ]
    if not repeats:
        return False
    one, other = (_planes(np.asarray(recordings.frame(c), float)) for c in (capture, repeats[0]))
    variance = np.array([float((a - b).var()) for a, b in zip(one, other, strict=True)])
    within = max(SAME_GAIN, SAME_GAIN_SIGMA * float(np.sqrt(2.0 / one[0].size)))
    return bool(np.all(np.abs(variance / variance.mean() - 1.0) <= within))
