"""The code from which on a pixel counts as clipped."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim.sensor import mosaic

if TYPE_CHECKING:
    from lab.diagnose.measurements.study import Study

CLIPPED_SHARE = 2e-4  # of a plane's pixels: with fewer clipped ones its mean is used


def clipping_level_dn(study: Study) -> float:
    """Code (DN) from which on a pixel counts as clipped: the converter's highest, or less where the full well is
    reached before it.

    Pixels at full well have no shot noise. A plane is taken to be there where its 97, 99 and 99.9 % quantiles lie
    closer together than a third of their distance by shot noise.
    """
    white = study.camera.white_level_dn
    gain = study.stated.conversion_gain_dn_per_e
    black = study.stated.black_level_dn or 0.0
    piles = []
    for kind in ("flat", "narrowband", "white"):
        for capture in study.recordings.captures(kind, study.side):
            frame = study.recordings.frame(capture)
            for channel in study.channels:
                row, col = mosaic.phases(study.camera.cfa)[channel][0]
                step = mosaic.step(study.camera.cfa)
                values = np.asarray(frame[row::step, col::step])
                if values.max() < 0.25 * white:
                    continue
                middle, high, top = np.quantile(values, [0.97, 0.99, 0.999])
                if gain is None:
                    # a tenth of the shot noise for a full well of 1e5 e: less than any unclipped plane has
                    least = 0.1 * np.sqrt(max(top - black, 1.0) * white / 1e5)
                else:
                    least = np.sqrt(gain * max(top - black, 1.0)) / 3.0
                if (
                    top - high < 0.76 * least and high - middle < 0.45 * least
                ):  # quantiles of a normal distribution, in standard deviations
                    piles.append((float(top), float(top - middle)))
    below = [(top, width) for top, width in piles if top < white - 1.0]
    if not below:
        return white
    top = float(np.median([t for t, _ in below]))
    # a margin below the full well for the noise of its pixels
    return min(white, top - 3.0 * max(float(np.median([w for _, w in below])), 2.0))
