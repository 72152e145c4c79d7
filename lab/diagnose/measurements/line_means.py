"""What line noise of effects does to the means of single frames.

A row's disturbance is shared by its pixels, so that a frame's mean by channel scatters by more than its pixels' noise. Of n lines with
the power spectrum S (e^2) across them, the mean over all lines has the variance S(0) / n, and half of the difference between even and
odd lines S(1/2) / n. In a mosaic, channels on the same lines share both.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lab.capture_kinds.base import Capture
from lab.diagnose.measurements.block import Effects
from lab.diagnose.measurements.study import Study
from sim.sensor import mosaic
from sim.spectrum import FloatArray
from sim.uniform import Uniform


def line_mean_jacobian(
    study: Study, points: Sequence[tuple[Capture, str | None]], effects: Effects
) -> dict[str, FloatArray]:
    """Jacobian (points,) of means by the disturbances that the lines of each capture have in the mean, per standard deviation, DN.

    `points`: capture and channel of every mean, no channel: of the whole frame. Nothing without effects that disturb lines.
    """
    columns: dict[str, FloatArray] = {}
    for one in Uniform(study.camera, effects).lines:
        count = study.camera.rows if one.lines == "rows" else study.camera.cols
        for name, frequency in (("mean", 0.0), ("odd", 0.5)):
            std_dn = study.noise.gain * float(np.sqrt(one.spectrum_e2(np.array([frequency]), fixed=False)[0] / count))
            if std_dn == 0.0:
                continue
            sign = np.array([1.0 if name == "mean" else _even_over_odd(study, one.lines, c) for _, c in points])
            for capture in dict.fromkeys(capture.id for capture, _ in points):
                mine = np.array([c.id == capture for c, _ in points])
                if np.any(sign[mine]):
                    columns[f"{one.lines}:{name}:{capture}"] = std_dn * sign * mine
    return columns


def _even_over_odd(study: Study, lines: str, channel: str | None) -> float:
    """Mean over a channel's lines of 1 on even and -1 on odd ones."""
    if channel is None or mosaic.step(study.camera.cfa) == 1:
        return 0.0
    phases = mosaic.phases(study.camera.cfa)[channel]
    return float(np.mean([1.0 - 2.0 * (phase[0 if lines == "rows" else 1] % 2) for phase in phases]))
