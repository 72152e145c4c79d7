"""What read-out does in dark frames: noise that rows share anew in every frame, and fixed offsets of rows and columns.
Light frames have both as well, additively in DN."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from lab.diagnose.measurements.dark_frames import DarkCondition, conditions
from lab.diagnose.measurements.dark_lines import LEAST_LINE_DN
from lab.measure.study import Study
from sim.sensor import mosaic
from sim.spectrum import FloatArray

MOST_FRAMES = 12  # of a condition
#: Prior relative standard deviation of the cube root of a band's power about its neighbours': a factor of 2.2 in power.
NEIGHBOUR_STD = 0.3
NEIGHBOURS = 2  # bands on either side
#: Relative standard deviation by which the power of rows in light departs from that in the dark: the chip is warmer or
#: cooler, and the read-out busier.
LIGHT_STD = 0.15
#: Share of the fixed offsets by which they may be others in light: a CMOS camera's even and odd rows differ by 0.09 DN
#: in the dark, and don't in light.
OFFSETS_STD = 0.5


@dataclass(frozen=True)
class DarkRowPower:
    """Power of the rows of single frames beyond that of pixels' noise, by band of frequency, DN^2, and its standard
    deviation."""

    power_dn2: FloatArray  # (bands,)
    std_dn2: FloatArray  # (bands,)


@dataclass(frozen=True)
class DarkReadOut:
    """Statistics of repeated dark frames. A row of a spectrum is the mean over as many neighbouring ones as the
    mosaic's period has."""

    contrasts: int  # independent differences of repeats
    power_dn2: FloatArray  # (rows / 2 + 1,): of the rows of single frames, by cycles a frame
    white_dn2: float  # of it, by the noise of pixels
    offsets_dn: NDArray[np.float32]  # (rows, cols): mean frame less its mean
    frames: int  # that it is the mean of

    def noise(self, bands: Sequence[range]) -> DarkRowPower:
        """The noise of rows in `bands`, each a range of cycles a frame.

        With a = `contrasts` x cycles of the band, its power P is gamma-distributed about the true one, tau, and P^(1/3)
        has the mean tau^(1/3) G(a + 1/3) / G(a) / a^(1/3), G the gamma function. Without other knowledge tau^(1/3) then
        has the variance (a P)^(2/3) (G(a - 2/3) / G(a) - (G(a - 1/3) / G(a))^2). It is weighed with the mean over the
        neighbouring bands by `NEIGHBOUR_STD`, as a power may be small by chance: two repeats have two degrees of
        freedom in the lowest band.
        """
        shape = self.contrasts * np.array([len(band) for band in bands], float)
        scale = np.cbrt(shape * [self.power_dn2[list(band)].mean() for band in bands])
        root = scale * np.exp(gammaln(shape) - gammaln(shape + 1.0 / 3.0))
        square, mean = (np.exp(gammaln(shape - n / 3.0) - gammaln(shape)) for n in (2.0, 1.0))
        own = scale**2 * (square - mean**2)
        near = [slice(max(k - NEIGHBOURS, 0), k + NEIGHBOURS + 1) for k in range(len(bands))]
        around = np.array([np.average(root[at], weights=shape[at]) for at in near])
        usual = around**2 * (NEIGHBOUR_STD**2 + np.array([1.0 / (9.0 * shape[at].sum()) for at in near]))
        weight = usual / (usual + own)
        likely = weight * root + (1.0 - weight) * around
        power = likely**3 - self.white_dn2
        std = 3.0 * likely**2 * np.sqrt(own * weight)
        return DarkRowPower(power, np.hypot(std, LIGHT_STD * np.maximum(power, 0.0)))

    def offsets(self, bands: Sequence[range], step: int) -> DarkRowPower:
        """The power of the rows of `offsets_dn` that isn't in those of light frames: their noise, and what may differ
        by `OFFSETS_STD`."""
        rows = row_profile(self.offsets_dn, step)
        fixed = np.abs(np.fft.rfft(rows)) ** 2 / len(rows)
        modes = np.array([len(band) for band in bands], float)
        noise, whole = (
            np.array([of[list(band)].mean() for band in bands]) for of in (self.power_dn2 / self.frames, fixed)
        )
        return DarkRowPower(noise, np.hypot(noise / np.sqrt(modes), OFFSETS_STD**2 * whole))


def row_profile(frame: NDArray[np.floating], step: int) -> FloatArray:
    """Means of the rows, over `step` neighbouring ones each, the period of the mosaic."""
    rows = frame.shape[0] // step
    return np.asarray(frame.mean(1, dtype=float)[: rows * step].reshape(rows, step).mean(1))


def dark_readout(study: Study) -> DarkReadOut | None:
    """What repeated dark frames show of the read-out; None where there are none, or their codes are too coarse to show
    it.

    Noise is measured by Helmert contrasts: frame k less the mean of those before it, times sqrt(k / (k + 1)). Fixed
    offsets are those of exposures up to the longest flat's, as a dark current that differs from pixel to pixel grows
    with the exposure."""
    every = conditions(study) if study.recordings.captures("dark", study.side) else []
    step, longest_s = mosaic.step(study.camera.cfa), max((g[0].exposure_s for g in study.flat_levels()), default=0.0)
    power, pixel_dn2, contrasts = np.zeros(0), 0.0, 0
    total, frames = np.zeros((study.camera.rows, study.camera.cols), np.float32), 0
    for condition in every:
        if len(condition.captures) < 2:
            continue
        lines, own, mean = _read(study, condition, step)
        if own <= LEAST_LINE_DN**2:
            continue
        power = lines.sum(0) + (power if contrasts else 0.0)
        pixel_dn2, contrasts = pixel_dn2 + len(lines) * own, contrasts + len(lines)
        if not frames or condition.exposure_s <= longest_s:
            count = len(lines) + 1
            total, frames = total + np.float32(count) * (mean - mean.mean(dtype=float)), frames + count
    if not contrasts:
        return None
    return DarkReadOut(
        contrasts=contrasts,
        power_dn2=power / contrasts,
        white_dn2=pixel_dn2 / contrasts / (step * study.camera.cols),
        offsets_dn=np.asarray(total / np.float32(frames), np.float32),
        frames=frames,
    )


def _read(study: Study, condition: DarkCondition, step: int) -> tuple[FloatArray, float, NDArray[np.float32]]:
    """Of the repeats of one condition: power of the rows of each contrast (contrasts, rows / 2 + 1), DN^2; variance of
    a pixel without that of whole rows, DN^2; and the mean frame, DN."""
    lines, pixel = [], []
    mean = np.zeros((study.camera.rows, study.camera.cols), np.float32)
    for k, capture in enumerate(condition.captures[:MOST_FRAMES]):
        away = np.asarray(study.recordings.frame(capture), np.float32) - mean
        mean += away / np.float32(k + 1)
        if k == 0:
            continue
        away *= np.float32(np.sqrt(k / (k + 1.0)))
        profile = row_profile(away, step)
        lines.append(np.abs(np.fft.rfft(profile)) ** 2 / len(profile))
        away -= away.mean(1, keepdims=True)
        pixel.append(float(np.mean(np.square(away), dtype=float)) / (1.0 - 1.0 / study.camera.cols))
    return np.array(lines), float(np.mean(pixel)), mean
