"""A bit depth that is stated too large: pixels pile up at the highest code of fewer bits."""

from __future__ import annotations

import numpy as np

from lab.diagnose.measurements.linearity import PHOTON_TRANSFER
from lab.diagnose.metadata.misstatement import Misstatement, restated_camera
from lab.diagnose.policy import DEFAULT_POLICY, DecisionPolicy
from lab.formats.recording_set import RecordingSet
from sim.camera import Side


def misstated_bit_depth(
    recordings: RecordingSet, side: Side, policy: DecisionPolicy = DEFAULT_POLICY
) -> Misstatement | None:
    """Return a bit depth that is stated too large: no frame has a code above 2^k - 1, k less than the stated bits, and
    pixels are clipped there.

    Pixels at a full well below the converter's range are spread over codes by read noise, and that well is 2^k - 1 with
    a probability of one in thousands. A bit depth that is stated too small is refused when the recording set is read.
    None where nothing is found."""
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
        if count >= max(policy.clipped_pixels, policy.clipped_frame_share * frame.size):
            piled[capture.id] = count
    bits = highest.bit_length()
    if (
        not piled
        or highest != 2**bits - 1
        or not policy.least_bit_depth <= bits < camera.bit_depth
        or highest >= camera.saturation_dn
    ):
        return None
    count = sum(piled.values())
    return Misstatement(
        measurement=PHOTON_TRANSFER,
        where=f"code {highest}",
        shape="the stated bit depth contradicts the code at which pixels are clipped",
        check=f"The frames of the {side} camera are clipped at {highest} DN ({count} pixels in {len(piled)} "
        f"captures), the highest code of {bits} "
        f"bits, but bit_depth = {camera.bit_depth} and a white level of {camera.saturation_dn:g} DN are stated: "
        f"correct bit_depth to {bits} and "
        f"white_level_dn to {highest}.",
        # noise would put about as many pixels above that code, and none is there
        chi2_stated=float(count),
        chi2_corrected=0.0,
        n=len(piled),
        captures=tuple(piled),
        corrected=restated_camera(recordings, side, bit_depth=bits, white_level_dn=float(highest)),
    )
