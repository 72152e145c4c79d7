"""A stated black level that the dark frames contradict."""

from __future__ import annotations

import numpy as np

from lab.capture_kinds.dark import DarkCapture
from lab.diagnose.measurements.dark_level import BLACK_LEVEL
from lab.diagnose.metadata.misstatement import Misstatement, restated_camera
from lab.diagnose.policy import DEFAULT_POLICY, DecisionPolicy
from lab.formats.recording_set import RecordingSet
from sim.camera import Side


def misstated_black_level(
    recordings: RecordingSet, side: Side, policy: DecisionPolicy = DEFAULT_POLICY
) -> Misstatement | None:
    """Return a black level that differs from the dark frames' mean, extrapolated to zero exposure, by more than
    `black_level_tolerance`.

    A line is fitted to the means by exposure, of the frames at the gain and temperature of the shortest. With a single
    exposure, dark current can't be told from black level. None where nothing is found.
    """
    stated = recordings.camera(side).black_level_dn
    darks = recordings.captures(DarkCapture, side)
    if stated is None or not darks:
        return None
    first = min(darks, key=lambda c: c.exposure_s)
    alike = [c for c in darks if (c.gain_db, c.temperature_c) == (first.gain_db, first.temperature_c)]
    exposure = np.array([c.exposure_s for c in alike])
    mean = np.array([float(recordings.frame(c).mean()) for c in alike])
    if np.ptp(exposure) == 0.0:
        return None
    scale = float(exposure.max())
    table = np.column_stack([np.ones(len(alike)), exposure / scale])
    (black, _), *_ = np.linalg.lstsq(table, mean, rcond=None)
    freedom = max(len(alike) - 2, 1)
    scatter = float(np.sqrt(np.sum(np.square(mean - table @ np.linalg.lstsq(table, mean, rcond=None)[0])) / freedom))
    std = float(np.hypot(scatter, 0.01) * np.sqrt(np.linalg.inv(table.T @ table)[0, 0]))
    tolerance = max(
        policy.black_level_tolerance * 2.0 ** recordings.camera(side).bit_depth, policy.black_level_least_tolerance_dn
    )
    off = float(black) - stated
    if abs(off) < tolerance + policy.black_level_sigma * std or float(black) < 0.0:
        return None
    return Misstatement(
        measurement=BLACK_LEVEL,
        where="dark frames, extrapolated to zero exposure",
        shape="the stated black level contradicts the dark frames",
        check=f"The dark frames of the {side} camera have a black level of {black:.2f} ± {std:.2g} DN, but "
        f"black_level_dn = {stated:g} is stated: "
        f"correct it to {black:.1f}, or the darks are of another camera or setting.",
        chi2_stated=(off / np.hypot(std, tolerance / policy.black_level_sigma)) ** 2,
        chi2_corrected=0.0,
        n=1,
        captures=tuple(c.id for c in alike),
        corrected=restated_camera(recordings, side, black_level_dn=round(float(black), 3)),
    )
