"""Frames that stand under each other's captures, and darks and flats stated for each other."""

from __future__ import annotations

import numpy as np

from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.diagnose.measurements.dark_level import DARK
from lab.diagnose.measurements.linearity import PHOTON_TRANSFER
from lab.diagnose.metadata.misstatement import Misstatement
from lab.diagnose.policy import DEFAULT_POLICY, DecisionPolicy
from lab.formats.recording_set import RecordingSet
from lab.measure.level_lines import DARKER_SHARE
from lab.measure.mishaps import exchanged_frames
from sim.camera import Side


def misplaced_frames(
    recordings: RecordingSet, side: Side, policy: DecisionPolicy = DEFAULT_POLICY
) -> Misstatement | None:
    """Pairs of darks and flats that hold each other's frames (`lab.measure.mishaps`); None where none is found."""
    found = exchanged_frames(recordings, side)
    if found is None:
        return None
    every = [one for pair in found.pairs for one in pair]
    return Misstatement(
        measurement=PHOTON_TRANSFER,
        where=found.where,
        shape="captures hold each other's frames",
        check=found.told(side),
        chi2_stated=float(sum(((one.mean_dn - one.expected_dn) / one.tolerance_dn) ** 2 for one in every)),
        chi2_corrected=0.0,
        n=len(every),
        captures=found.captures,
        corrected=found.corrected,
    )


def exchanged_kinds(
    recordings: RecordingSet, side: Side, policy: DecisionPolicy = DEFAULT_POLICY
) -> Misstatement | None:
    """All flats darker than the darks, which grow with their exposure, by more than `DARKER_SHARE` of the range: the
    two kinds are stated for each other. Both are left out, as the light of those that are stated as darks isn't known.
    None where nothing is found."""
    darks, flats = recordings.captures(DarkCapture, side), recordings.captures(FlatCapture, side)
    if min(len(darks), len(flats)) < policy.least_swapped_frames:
        return None
    exposure, level = (
        np.array(v) for v in zip(*((c.exposure_s, float(recordings.frame(c).mean())) for c in darks), strict=True)
    )
    lit = np.array([float(recordings.frame(c).mean()) for c in flats])
    longest = level[exposure == exposure.max()].mean()
    least = DARKER_SHARE * recordings.camera(side).saturation_dn
    if float(np.median(level)) < float(lit.max()) + least or longest < float(level.min()) + least:
        return None
    captures = tuple(c.id for c in (*darks, *flats))
    return Misstatement(
        measurement=DARK,
        where=f"{len(darks)} darks and {len(flats)} flats",
        shape="darks and flats contradict their kinds",
        check=f"The darks of the {side} camera have {level.min():.4g} to {level.max():.4g} DN and grow with the "
        f"exposure, its flats {lit.min():.4g} to "
        f"{lit.max():.4g} DN: darks and flats are stated for each other. Both are left out: exchange their kinds, and "
        "state the flats' light.",
        chi2_stated=((float(np.median(level)) - float(lit.max())) / least) ** 2,
        chi2_corrected=0.0,
        n=1,
        captures=captures,
        corrected=recordings.without(set(captures)),
    )
