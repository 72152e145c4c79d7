"""Read noise and black level from the darks, and whether rounding hides them."""

from __future__ import annotations

import numpy as np

from lab.fit.noise.evaluation import Evaluation
from lab.fit.rounding import HIDDEN_DN2, QUANTISATION_DN2
from lab.fit.weighted_lines import chi2_factor


def read_noise(e: Evaluation) -> tuple[float | None, float | None]:
    """Read noise, e, and its standard deviation: sqrt(floor - 1/12 DN^2) / K, the floor a weighted mean over the
    planes.

    None where darks have no repeats, or where rounding hides the noise.
    """
    t = e.transfer
    if not any(level.lamp == "dark" for level, _ in e.points):
        if any(level.repeats > 1 for level in e.levels.darks):
            e.remarks.add(
                f"repeated dark frames are all alike: rounding hides the read noise, which is below {0.4 / t.gain:.2f} e"
            )
        return None, None
    count = t.floor.size
    own = t.covariance[2:, 2:]
    weight = 1.0 / np.diag(own)
    weight /= weight.sum()
    floor = float(weight @ t.floor)
    if floor < HIDDEN_DN2:
        e.remarks.add(
            f"the temporal noise of dark frames is {np.sqrt(max(floor, 0)):.2f} DN, where rounding hides it: the read noise is below "
            f"{0.4 / t.gain:.2f} e; a higher gain would show it"
        )
        return None, None
    between = float(np.sum((t.floor - floor) ** 2 / np.diag(own)))
    gradient = np.zeros(2 + count)
    noise = float(np.sqrt(floor - QUANTISATION_DN2))
    gradient[0] = -noise / t.gain**2
    gradient[2:] = weight / (2.0 * noise * t.gain)
    widened = t.covariance.copy()
    widened[2:, 2:] *= chi2_factor(between, count - 1)
    return noise / t.gain, float(np.sqrt(gradient @ widened @ gradient))


def black_level(e: Evaluation) -> tuple[float | None, float | None]:
    """Black level, DN, and its standard deviation: the dark line at no exposure. The standard deviation includes the
    fixed pattern as a sample of the camera.
    """
    if not e.levels.darks:
        return None, None
    line, patterns = e.dark.lines[None], []
    for name in e.levels.names:
        plane = e.levels.darks[0].plane[name]
        if plane.every_pixel is not None and np.isfinite(plane.temporal_variance):  # one frame can't tell it from noise
            patterns.append(plane.every_pixel.mean_std(plane.shape))
    pattern = float(np.sqrt(np.sum(np.square(patterns)))) / max(len(patterns), 1)
    return line.black, float(np.hypot(np.sqrt(line.covariance[0, 0]), pattern))


def dark_signal_hidden(e: Evaluation) -> bool:
    """Whether rounding hides the dark signal; reported where it does.

    Where neither noise nor pattern spreads the values over codes, their means don't follow the signal.
    """
    spread = min(level.plane[name].spread for level in e.levels.darks for name in e.levels.names)
    if spread >= HIDDEN_DN2:
        return False
    e.remarks.add(
        f"noise and pattern of the darks spread over {np.sqrt(spread):.2f} DN only, so rounding decides their means: dark current "
        "and DSNU aren't determined, and the black level to its rounding; a higher gain would show them"
    )
    return True
