"""The stated black level, against that of the dark frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lab.formats.recording_set import RecordingSet
from lab.inference.hypotheses import Coordinate
from lab.inference.statements.statement import (
    AffineChange,
    Changes,
    Numbers,
    Restatement,
    Statement,
    Told,
    restated_camera,
)
from lab.observables.darks.level import BLACK_LEVEL
from sim.camera import Side
from sim.spectrum import FloatArray

#: Prior scale of a wrong black level's error, DN: half a percent of 12 bits. One of other bits, or none, is off by
#: tens to hundreds, which the prior's tail holds.
SCALE_DN = 20.0


def _restatements(numbers: Numbers) -> Sequence[Restatement]:
    rows = [k for k, _, _ in numbers.of(BLACK_LEVEL)]
    stated_dn = numbers.stated.black_level_dn
    if not rows or stated_dn is None:
        return ()

    def on(numbers: Numbers) -> Changes:
        rows = np.array([k for k, _, _ in numbers.of(BLACK_LEVEL)], int)
        return lambda u: AffineChange(rows, np.eye(len(rows)), np.full(len(rows), float(u[0])))

    def told(recordings: RecordingSet, side: Side, u: FloatArray, std: FloatArray) -> Told:
        black_dn = stated_dn + float(u[0])
        captures = tuple(c.id for c in recordings.captures("dark", side))
        return Told(
            where="dark frames, extrapolated to zero exposure",
            shape="the stated black level contradicts the dark frames",
            check=f"The dark frames of the {side} camera have a black level of {black_dn:.2f} ± {std[0]:.2g} DN, but "
            f"black_level_dn = {stated_dn:g} is stated: correct it to {black_dn:.1f}, or the darks are of another "
            "camera or setting.",
            captures=captures,
            corrected=restated_camera(recordings, side, black_level_dn=round(black_dn, 3)),
        )

    return (Restatement(on, told, ((0.1 * SCALE_DN,), (-0.1 * SCALE_DN,)), BLACK_LEVEL),)


WRONG_BLACK_LEVEL = Statement(
    "wrong_black_level",
    (Coordinate("error_dn", SCALE_DN, typical=SCALE_DN, step=0.1 * SCALE_DN),),
    _restatements,
)
