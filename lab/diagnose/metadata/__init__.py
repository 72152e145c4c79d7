"""Misstated metadata: statements about a camera or its captures that the recordings contradict.

They are looked for before any effect, as a wrong statement would be taken for physics. A finding is reported with the
value that the recordings fit, and the diagnosis continues with that value. Frames or lights that seem exchanged are
left out: the exchange is proposed and not made.
"""

from __future__ import annotations

from lab.diagnose.metadata.frames import (
    exchanged_kinds,
    misplaced_frames,
    misstated_bit_depth,
    misstated_black_level,
    misstated_dark_exposure,
    misstated_exposure_unit,
    unchecked,
)
from lab.diagnose.metadata.lights import exchanged_lights, misstated_mosaic, misstated_mosaic_phase
from lab.diagnose.metadata.misstatement import Misstatement
from lab.diagnose.metadata.targets import misstated_board, misstated_cell_size
from lab.diagnose.policy import DEFAULT_POLICY, DecisionPolicy
from lab.formats.recording_set import RecordingSet
from sim.camera import Side

__all__ = ["Misstatement", "misstatements", "unchecked"]

#: Each check gets the recordings as corrected by those before it.
_CHECKS = (
    misstated_exposure_unit,
    exchanged_kinds,
    misplaced_frames,
    misstated_bit_depth,
    misstated_dark_exposure,
    misstated_black_level,
    misstated_mosaic,
    misstated_mosaic_phase,
    exchanged_lights,
    misstated_cell_size,
    misstated_board,
)


def misstatements(
    recordings: RecordingSet, side: Side, policy: DecisionPolicy = DEFAULT_POLICY
) -> tuple[RecordingSet, tuple[Misstatement, ...]]:
    """Return the recordings with wrong statements of a side replaced by the values that fit, less the captures that
    contradict theirs without such a value; and the findings."""
    found: list[Misstatement] = []
    for check in _CHECKS:
        one = check(recordings, side, policy)
        if one is not None:
            found.append(one)
            recordings = one.corrected
    return recordings, tuple(found)
