"""Charge that packets leave behind while they are clocked to the output, and that later packets collect."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from sim.spectrum import FloatArray

#: Pixels behind a packet over which `Trails.kernel` is given, and the grid of its Fourier transform.
TRAIL_PX, TRAIL_GRID = 24, 1024
#: Largest term of the series of `Trails.clock` that is left out.
LEAST_TERM = 1e-12


@dataclass(frozen=True)
class Trails:
    """Traps of a register, alike in all of its pixels, that take the share `loss` of a packet's charge in each
    transfer.

    axis : 0 where rows are clocked (parallel), 1 where columns are (serial)
    releases : (share of the traps, time constant of their release in transfers) of each species; the shares' sum is 1
    output : whether the first or the last line is next to the output, and so is transferred once

    A packet that is transferred n times loses n loss, and the packet j places behind it finds sum_s w_s (1 - b_s)
    b_s^(j - 1) of that, b_s = exp(-1 / release). With T this delay, the limit of many small losses is exp(n loss (T -
    1)): the textbook's transfer function of deferred charge (Janesick 2001, chapter 5) with the traps' release in the
    place of a delay by one pixel.
    """

    axis: Literal[0, 1]
    loss: float
    releases: tuple[tuple[float, float], ...]
    output: Literal["first", "last"]

    def transfers(self, line: FloatArray, lines: int) -> FloatArray:
        """Return the number of transfers of lines 0 .. lines - 1, which may lie between two."""
        return np.asarray(line + 1.0 if self.output == "first" else lines - line)

    @property
    def steady_share(self) -> float:
        """Share of even light that is read, far from the first lines: a packet finds what it loses, but for what
        lies in the trail of the transfers that are still to come, the loss times the mean delay."""
        return 1.0 - self.loss * sum(share / (1.0 - np.exp(-1.0 / release)) for share, release in self.releases)

    def clock(self, electrons: FloatArray) -> FloatArray:
        """Return the mean electrons (rows, cols) that are read, given those in the pixels.

        exp(n loss (T - 1)) of each source line by its own n, as the series of (T - 1)^m of n^m loss^m / m! times the
        source. What is released behind the last line isn't in the frame.
        """
        packets = np.moveaxis(electrons, self.axis, 0)
        if self.output == "last":
            packets = packets[::-1]
        lost = self.loss * np.arange(1.0, len(packets) + 1.0)[:, None]
        terms, size = 1, 2.0 * float(lost[-1, 0])
        while size > LEAST_TERM:
            terms += 1
            size *= 2.0 * float(lost[-1, 0]) / terms
        sources = [packets]
        for power in range(1, terms + 1):
            sources.append(sources[-1] * lost / power)
        read = sources.pop()
        while sources:
            read = sources.pop() + self._delay(read) - read
        if self.output == "last":
            read = read[::-1]
        return np.asarray(np.maximum(np.moveaxis(read, 0, self.axis), 0.0))

    def _delay(self, packets: FloatArray) -> FloatArray:
        """Return where traps release the charge of packets (lines, n)."""
        total: FloatArray = np.zeros(packets.shape)
        for share, release in self.releases:
            held = np.exp(-1.0 / release)
            total = total + share * np.asarray(lfilter([0.0, 1.0 - held], [1.0, -held], packets, axis=0))
        return total

    def otf(self, fx_cy_per_px: FloatArray, fy_cy_per_px: FloatArray, transfers: float) -> NDArray[np.complex128]:
        """Return the transfer function of charge that is transferred that often."""
        frequency = fy_cy_per_px if self.axis == 0 else fx_cy_per_px
        turn = np.exp((-2j if self.output == "first" else 2j) * np.pi * np.asarray(frequency, float))
        delayed: NDArray[np.complex128] = np.zeros(np.shape(turn), complex)
        for share, release in self.releases:
            held = np.exp(-1.0 / release)
            delayed = delayed + share * (1.0 - held) * turn / (1.0 - held * turn)
        return np.asarray(np.exp(transfers * self.loss * (delayed - 1.0)))

    def kernel(self, transfers: float) -> FloatArray:
        """Return where a packet's charge ends up, (2 `TRAIL_PX` + 1, 1) of rows or (1, 2 `TRAIL_PX` + 1) of columns:
        what is released beyond is left out.
        """
        frequency = np.asarray(np.fft.fftfreq(TRAIL_GRID), float)
        along = Trails(0, self.loss, self.releases, "first").otf(np.zeros(TRAIL_GRID), frequency, transfers)
        behind = np.real(np.fft.ifft(along))[: TRAIL_PX + 1]
        kernel = np.concatenate([np.zeros(TRAIL_PX), behind])
        if self.output == "last":
            kernel = kernel[::-1]
        return np.asarray(kernel[:, None] if self.axis == 0 else kernel[None, :])
