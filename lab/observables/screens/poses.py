"""Poses of a screen: the captures of one pattern with those that level it and place it, and the levelled pictures.

Pictures are levelled in codes, (pattern - black) / (white - black): no statement of the manifest enters where all are
of one exposure. `ScreenPictures.shares` is the reading that takes unequal exposures into account.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lab.capture_kinds.bernoulli import BernoulliCapture
from lab.capture_kinds.black import BlackCapture
from lab.capture_kinds.checkerboard import CheckerboardCapture
from lab.capture_kinds.screen import ScreenCapture
from lab.capture_kinds.white import WhiteCapture
from lab.errors import NotDetermined
from lab.formats.recording_set import CodeCounts, RecordingSet
from lab.observables.dataset import mean_frame
from sim.camera import Side
from sim.spectrum import FloatArray

MOST_SATURATED = 0.001  # of the pixels of a frame
LEAST_CONTRAST = 0.2  # of a plane's 98 % quantile: what has less isn't the screen


@dataclass(frozen=True)
class ScreenPose:
    """Captures with nothing moved in between; all of one kind have one exposure and gain."""

    pattern: tuple[BernoulliCapture, ...]  # repeats of one target
    checkerboard: tuple[CheckerboardCapture, ...]  # of one target
    white: tuple[WhiteCapture, ...]
    black: tuple[BlackCapture, ...]

    @property
    def captures(self) -> tuple[ScreenCapture, ...]:
        """Return all captures."""
        return *self.pattern, *self.checkerboard, *self.white, *self.black


def screen_poses(recordings: RecordingSet, side: Side, step: str) -> list[ScreenPose]:
    """Return a pose for every Bernoulli target, exposure and gain of every pose of the screen.

    White, black and checkerboard are those of the pattern's exposure where there are any, else of the first one. Raises
    NotDetermined of `step` where no pose has all four kinds.
    """
    patterns: dict[object, list[BernoulliCapture]] = {}
    for capture in recordings.captures(BernoulliCapture, side):
        patterns.setdefault((capture.screen.pose, capture.target, *_setting(capture)), []).append(capture)
    if not patterns:
        raise NotDetermined(step, "no bernoulli captures")
    found, reason = [], ""
    for group in patterns.values():
        whites, blacks, boards = (
            _like(group[0], recordings.captures(kind, side))
            for kind in (WhiteCapture, BlackCapture, CheckerboardCapture)
        )
        missing = [n for n, some in (("white", whites), ("black", blacks), ("checkerboard", boards)) if not some]
        if missing:
            reason = (
                f"pose {group[0].screen.pose} lacks a {' and a '.join(missing)} capture: take it before the screen "
                "moves"
            )
            continue
        found.append(ScreenPose(tuple(group), boards, whites, blacks))  # type: ignore[arg-type]
    if not found:
        raise NotDetermined(step, reason)
    return found


def _setting(capture: ScreenCapture) -> tuple[object, ...]:
    """Return what sets a capture's level beside the light."""
    return capture.exposure_s, capture.gain_db


def _like(pattern: BernoulliCapture, captures: Sequence[ScreenCapture]) -> tuple[ScreenCapture, ...]:
    """Return the captures at the pose of a pattern of one setting and target: the pattern's setting where there is one,
    else that of the first."""
    here = [c for c in captures if c.screen.pose == pattern.screen.pose]
    here = [c for c in here if _setting(c) == _setting(pattern)] or here
    return tuple(
        c
        for c in here
        if _setting(c) == _setting(here[0]) and getattr(c, "target", "") == getattr(here[0], "target", "")
    )


def refuse_saturated(recordings: RecordingSet, pose: ScreenPose, saturation_dn: float, step: str) -> None:
    """Raise NotDetermined of `step` where more than `MOST_SATURATED` of a frame's pixels are at `saturation_dn`."""
    for capture in pose.captures:
        counts: CodeCounts = recordings.codes(capture).every
        if (share := counts.share_from(saturation_dn)) > MOST_SATURATED:
            raise NotDetermined(step, f"{capture.id}: {100 * share:.1f} % of the frame is saturated; expose it shorter")


@dataclass(frozen=True)
class ScreenPictures:
    """Mean frames (rows, cols) of one pose, in codes; NaN in `contrast`, white less black, where the screen isn't."""

    pose: ScreenPose
    black: FloatArray
    contrast: FloatArray

    @staticmethod
    def of(recordings: RecordingSet, pose: ScreenPose) -> ScreenPictures:
        """Average the frames of the lit and of the dark screen."""
        black = mean_frame(recordings, pose.black)
        contrast = mean_frame(recordings, pose.white) - black
        for row, col in np.ndindex(2, 2):  # a cell of the mosaic: colours differ in contrast
            plane = contrast[row::2, col::2]
            plane[plane < LEAST_CONTRAST * np.quantile(plane, 0.98)] = np.nan
        return ScreenPictures(pose, black, contrast)

    def levelled(self, recordings: RecordingSet, captures: Sequence[ScreenCapture]) -> FloatArray:
        """Return the mean picture of captures: 0 as the dark, 1 as the lit screen, NaN where the screen isn't."""
        return np.asarray((mean_frame(recordings, captures) - self.black) / self.contrast)

    @property
    def gain(self) -> float:
        """Return the exposure of the pattern over that of the lit screen: what a lit cell is levelled to."""
        return self.pose.pattern[0].exposure_s / self.pose.white[0].exposure_s

    def shares(self, levelled: FloatArray, capture: ScreenCapture, black_dn: float) -> FloatArray:
        """Return a levelled picture as shares of the lit screen's light, whatever the stated exposures: those of
        `capture`, and the black level `black_dn`, matter where they differ."""
        white_s, black_s = self.pose.white[0].exposure_s, self.pose.black[0].exposure_s
        if capture.exposure_s == white_s == black_s:
            return levelled
        dark = (self.black - black_dn) / black_s
        light = (self.contrast + self.black - black_dn) / white_s - dark
        return np.asarray(((levelled * self.contrast + self.black - black_dn) / capture.exposure_s - dark) / light)
