"""Frames of a photon-transfer series that stand under each other's captures: two levels, or a dark and a flat, exchanged in an index."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy import stats

from lab.capture_kinds.base import Capture
from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.fit.noise.photon_numbers import light_of
from lab.fit.noise.robust_response import robust_response
from lab.formats.recording_set import RecordingSet
from sim.camera import Side
from sim.spectrum import FloatArray

SEED = 1288  # of the subsets of captures that the robust law draws
MEAN_STD, MEAN_STD_DN = (
    1e-3,
    0.1,
)  # standard deviation of a frame's mean, of its signal and in DN: lamps are steady to some 1e-3
CLIPPED_SHARE = 0.01  # of a frame's pixels, from which on its mean is a bound only
SAME_SCATTER, LEAST_SAME = 4.0, 0.003  # standard deviations, and share of the signal, within which a frame has a level
SAME_SATURATION, SAME_DN = 1e-3, 1.0  # the same beside it, of saturation, and at least
APART = 3.0  # times that by which two levels that count as exchanged differ
DARK_SIGMA = 6.0  # of the darks about their line
SATURATED = 0.98  # of the highest mean, from which on a flat may saturate


@dataclass(frozen=True)
class JudgedFrame:
    """A capture with the mean of its frame and the level that the others give its setting, in DN; `tolerance_dn`: within which these agree."""

    capture: Capture
    mean_dn: float
    expected_dn: float
    tolerance_dn: float
    is_off: bool

    def fits(self, other: JudgedFrame) -> bool:
        """Whether this frame has the level of the other's setting."""
        return abs(self.mean_dn - other.expected_dn) <= other.tolerance_dn


@dataclass(frozen=True)
class ExchangedFrames:
    """Pairs of captures, each of which holds the other's frame; `corrected`: the recordings with these put back."""

    pairs: tuple[tuple[JudgedFrame, JudgedFrame], ...]
    corrected: RecordingSet

    @property
    def captures(self) -> tuple[str, ...]:
        """Ids of the captures."""
        return tuple(one.capture.id for pair in self.pairs for one in pair)

    @property
    def where(self) -> str:
        """The settings, in words."""
        return "; ".join(dict.fromkeys(f"{_setting(a.capture)} and {_setting(b.capture)}" for a, b in self.pairs))

    def told(self, side: Side) -> str:
        """Which captures, and what fits, as a sentence."""
        groups: dict[tuple[str, str], list[tuple[JudgedFrame, JudgedFrame]]] = {}
        for a, b in self.pairs:
            groups.setdefault((_setting(a.capture), _setting(b.capture)), []).append((a, b))
        pairs = "; ".join(f"{_told([a for a, _ in own])}, and {_told([b for _, b in own])}" for own in groups.values())
        return (
            f"Captures of the {side} camera hold each other's frames: {pairs}; they are read as exchanged: exchange these frames, or what is "
            "stated of them."
        )


def exchanged_frames(recordings: RecordingSet, side: Side) -> ExchangedFrames | None:
    """Darks and flats of one side whose frames are exchanged in pairs; None where none is found.

    Each flat has an expected level by the response that the others of its lamp follow (`robust_response`, over captures), each dark by the
    others' line over the exposure (Theil and Sen). Two captures are exchanged where both are off their levels and each has that of the
    other's setting. Levels nearer than `APART` tolerances can't be told apart. At most a quarter of a lamp's captures may be wrong.
    """
    flats = recordings.captures(FlatCapture, side)
    gains = [flat.gain_db or 0.0 for flat in flats]
    if not gains:
        return None
    gain_db = max(sorted(set(gains)), key=gains.count)
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
    return ExchangedFrames(tuple(pairs), _put_back(recordings, pairs)) if pairs else None


def _judged(
    recordings: RecordingSet, side: Side, darks: Sequence[DarkCapture], flats: Sequence[FlatCapture]
) -> list[JudgedFrame]:
    """Every dark, and every flat of a lamp whose response the others tell."""
    camera = recordings.camera(side)
    looked_at = []
    for capture in (*darks, *flats):
        frame = recordings.frame(capture)
        looked_at.append((float(frame.mean()), float(np.mean(frame >= camera.saturation_dn)) > CLIPPED_SHARE))
    mean, clipped = (np.array(values) for values in zip(*looked_at, strict=True))
    dark_mean, flat_mean = mean[: len(darks)], mean[len(darks) :]
    exposure = np.array([dark.exposure_s for dark in darks])
    slope, black = 0.0, float(np.median(dark_mean))
    if np.unique(exposure).size > 1:
        slope, black = (float(v) for v in stats.theilslopes(dark_mean, exposure)[:2])
    own = black + slope * exposure
    saturation = max(float(mean.max()) - black, 1.0)
    least = max(SAME_SATURATION * saturation, SAME_DN)
    away = np.abs(dark_mean - own)
    tolerance = max(DARK_SIGMA * 1.4826 * float(np.median(away)), least)
    found = [
        JudgedFrame(dark, float(m), float(e), tolerance, bool(a > tolerance))
        for dark, m, e, a in zip(darks, dark_mean, own, away, strict=True)
    ]
    light = light_of(flats, camera)
    below = black + slope * np.array([flat.exposure_s for flat in flats])
    lamps = [(flat.radiance, light[flat.id].lamp) for flat in flats]
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


def _put_back(recordings: RecordingSet, pairs: Sequence[tuple[JudgedFrame, JudgedFrame]]) -> RecordingSet:
    """The recordings with the frames of each pair exchanged."""
    frame_of: dict[str, str] = {}
    for a, b in pairs:
        frame_of |= {a.capture.id: b.capture.frame, b.capture.id: a.capture.frame}
    captures = tuple(
        c.model_copy(update={"frame": frame_of[c.id]}) if c.id in frame_of else c for c in recordings.manifest.captures
    )
    return recordings.under(recordings.manifest.model_copy(update={"captures": captures}))


def _told(alike: Sequence[JudgedFrame]) -> str:
    """Captures of one setting, with the levels of the first."""
    one = alike[0]
    named = ", ".join(each.capture.id for each in alike)
    return f"{named} ({_setting(one.capture)}): {one.mean_dn:.4g} DN where the setting has {one.expected_dn:.4g} DN"


def _setting(capture: Capture) -> str:
    return f"{capture.kind}, {capture.exposure_s:.4g} s"
