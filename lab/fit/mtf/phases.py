"""Whether an edge crosses enough phases of the pixels for its angle, and with that its MTF, to be determined."""

from __future__ import annotations

import math

from lab.errors import NotDetermined
from lab.fit.mtf.samples import Region
from sim.camera import Cfa
from sim.sensor import mosaic

LEAST_TILT_DEG = 0.5  # below, no frame has enough rows or columns along the edge


def check_phases(step: str, cfa: Cfa, channel: str, region: Region, angle_deg: float) -> None:
    """Raise `NotDetermined` of `step` where the edge in a region crosses less than one sample period of its channel.

    Aliasing makes the position at which a row or column crosses the edge err periodically, by its phase to the samples. Over less than a
    period this error doesn't average out, and biases the angle.
    """
    tilt_deg = abs((angle_deg + 45.0) % 90.0 - 45.0)
    lines = region[2] - region[0] if abs((angle_deg + 90.0) % 180.0 - 90.0) < 45.0 else region[3] - region[1]
    period_px = mosaic.step(cfa) / len(mosaic.phases(cfa)[channel])
    crossed_px = lines * math.tan(math.radians(tilt_deg))
    if crossed_px < period_px:
        wanted = (
            f"{math.ceil(lines * period_px / crossed_px)} lines are enough"
            if tilt_deg > LEAST_TILT_DEG
            else "tilt it by 5 deg"
        )
        raise NotDetermined(
            step,
            f"an edge at {tilt_deg:.2g} deg over {lines} lines crosses {crossed_px:.2g} of the {period_px:g} px between samples of {channel}: {wanted}",
        )
