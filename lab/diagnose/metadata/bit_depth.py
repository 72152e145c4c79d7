"""A bit depth that is stated too large: pixels pile up at the highest code of fewer bits."""

from __future__ import annotations

import numpy as np

from lab.diagnose.measurements.linearity import PHOTON_TRANSFER
from lab.diagnose.metadata.misstatement import Misstatement, restated_camera
from lab.formats.recording_set import RecordingSet
from sim.camera import Side

LEAST_PILED = 100  # pixels on one code
LEAST_PILED_SHARE = 1e-3  # of a frame
LEAST_BITS = 6  # a code of fewer bits may be any level


def misstated_bit_depth(recordings: RecordingSet, side: Side) -> Misstatement | None:
    """Where no frame has a code above 2^k - 1, with k fewer than the stated bits, and pixels pile up there.

    A full well below the converter's range piles up, too, but its read noise spreads the pixels over codes, and it lies at a highest code
    of k bits by a chance of 1 in thousands. A bit depth that is stated too small is refused when the set is read.
    """
    camera = recordings.camera(side)
    piled: dict[str, int] = {}
    highest = 0
    for capture in recordings.captures(side=side):
        frame = recordings.frame(capture)
        top = int(frame.max())
        if top.bit_length() >= camera.bit_depth:
            return None
        if top < highest:
            continue
        if top > highest:
            highest, piled = top, {}
        count = int(np.count_nonzero(frame == top))
        if count >= max(LEAST_PILED, LEAST_PILED_SHARE * frame.size):
            piled[capture.id] = count
    bits = highest.bit_length()
    if (
        not piled
        or highest != 2**bits - 1
        or not LEAST_BITS <= bits < camera.bit_depth
        or highest >= camera.saturation_dn
    ):
        return None
    count = sum(piled.values())
    return Misstatement(
        measurement=PHOTON_TRANSFER,
        where=f"code {highest}",
        shape="the stated bit depth contradicts the code at which pixels are clipped",
        check=f"The frames of the {side} camera are clipped at {highest} DN ({count} pixels in {len(piled)} captures), the highest code of {bits} "
        f"bits, but bit_depth = {camera.bit_depth} and a white level of {camera.saturation_dn:g} DN are stated: correct bit_depth to {bits} and "
        f"white_level_dn to {highest}.",
        # normal noise has half of the pixels above the mean of those on a code, and here none is
        chi2_stated=float(count),
        chi2_corrected=0.0,
        n=len(piled),
        captures=tuple(piled),
        corrected=restated_camera(recordings, side, bit_depth=bits, white_level_dn=float(highest)),
    )
