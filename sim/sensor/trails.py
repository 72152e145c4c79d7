"""Charge that packets leave behind while they are clocked to the output, and that later packets collect."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from sim.spectrum import FloatArray

#: Pixels behind a packet over which `Trails.kernel` is given, and the grid of its Fourier transform.
TRAIL_PX, TRAIL_GRID = 24, 1024
#: Largest term of the series of `Trails.clock` that is left out.
LEAST_TERM = 1e-12
#: Numbers of transfers, evenly over a frame, and frequencies for which noise is averaged.
NOISE_PLACES, NOISE_GRID = 24, 64
#: Charge that is left behind on the way, over the packet's, beyond which noise is taken as of that: neighbours that
#: share more aren't described by the shares of five of them.
MOST_SHARED = 0.8


@dataclass(frozen=True)
class Trails:
    """Traps of a register, alike in all of its pixels, that take the share `loss` of a packet's charge in each
    transfer.

    axis : 0 where rows are clocked (parallel), 1 where columns are (serial)
    releases : (share of the traps, time constant of their release in transfers) of each species; the shares' sum is 1
    output : whether the first or the last line is next to the output, and so is transferred once
    at_once : whether the traps of all of a packet's transfers act as those of a single one

    A packet that is transferred n times loses n loss, and the packet j places behind it finds sum_s w_s (1 - b_s)
    b_s^(j - 1) of that, b_s = exp(-1 / release). With T this delay, the limit of many small losses is exp(n loss (T -
    1)): the textbook's transfer function of deferred charge (Janesick 2001, chapter 5) with the traps' release in the
    place of a delay by one pixel.

    `at_once`: the traps of n transfers fill to g N of N electrons that are left, g = n loss / b, and keep n loss / (1 +
    g) of the packet; what they release finds them full: 1 + n loss / (1 + g) (T - 1). It is the model of A. Short et
    al., MNRAS 430 (2013) 3078, of the same loss for few transfers, less for many.

    Within the active area each packet finds empty traps. Behind it, traps hold what packets have filled them to: that
    of one of equal packets, not the sum, so that a margin behind even light reads n loss N in all, the deferred charge
    by which the extended pixel edge response defines the inefficiency (Janesick, section 5.2.2). The law of the active
    area alone would read n loss N / (1 - b), and takes the share loss b / (1 - b) too much of even light.
    """

    axis: Literal[0, 1]
    loss: float
    releases: tuple[tuple[float, float], ...]
    output: Literal["first", "last"]
    at_once: bool = False

    def transfers(self, line: FloatArray, lines: int) -> FloatArray:
        """Return the number of transfers of lines 0 .. lines - 1, which may lie between two."""
        return np.asarray(line + 1.0 if self.output == "first" else lines - line)

    def _retain_at_once(self, transfers: FloatArray | float) -> list[tuple[FloatArray, float]]:
        """Return the share of a packet that each species keeps of it, and b, where all transfers act at once."""
        species = []
        for share, release in self.releases:
            held, lost = float(np.exp(-1.0 / release)), self.loss * share * np.asarray(transfers, float)
            species.append((np.asarray(lost / (1.0 + lost / held)), held))
        return species

    def clock(self, electrons: FloatArray, margins: tuple[int, int] = (0, 0)) -> FloatArray:
        """Return the mean electrons (rows, cols) that are read, given those in the pixels.

        exp(n loss (T - 1)) of each source line by its own n, as the series of (T - 1)^m of n^m loss^m / m! times the
        source. What is released behind the last line isn't in the frame.

        margins : lines before the first active one and behind the last one (`Margins.lines`). Transfers are counted
            from the first active line on, so that the active area is read as it would be without them
        """
        packets = np.moveaxis(electrons, self.axis, 0)
        ahead, behind = margins
        if self.output == "last":
            packets, ahead, behind = packets[::-1], behind, ahead
        transfers = np.maximum(np.arange(1.0, len(packets) + 1.0) - ahead, 0.0)[:, None]
        read = self._clock_in_order(packets, transfers)
        if behind:
            read = np.concatenate([read[:-behind], self._read_behind(packets, transfers, behind)])
        return self._as_given(read)

    def _clock_in_order(self, packets: FloatArray, transfers: FloatArray) -> FloatArray:
        """Return what is read of packets (lines, n) in the order of their transfers (lines, 1)."""
        if self.at_once:
            read = packets
            for kept, held in self._retain_at_once(transfers):
                read = read + _release(kept * packets, held) - kept * packets
            return read
        lost = self.loss * transfers
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
        return read

    def _read_behind(self, packets: FloatArray, transfers: FloatArray, behind: int) -> FloatArray:
        """Return what is read of the `behind` last lines of packets (lines, n), where each packet has filled the traps
        to its own level: n loss N, the most of all packets by what is left of it. Where all transfers act at once, a
        packet N after traps that hold k of the one before fills them to g (N + k) / (1 + g)."""
        lines = np.arange(1.0, behind + 1.0)[:, None]
        before, total = packets[:-behind], packets[-behind:]
        for share, release in self.releases:
            held = float(np.exp(-1.0 / release))
            lost = self.loss * share * transfers[:-behind]
            if self.at_once:
                left: FloatArray = np.zeros(before.shape[1])
                for taken, packet in zip(lost / held, before, strict=True):
                    left = held * np.maximum(left, taken * (packet + left) / (1.0 + taken))
            else:
                age = np.arange(len(before) - 1.0, -1.0, -1.0)[:, None]
                left = np.max(lost * before * held**age, axis=0, initial=0.0)
            total = total + left * (1.0 - held) * held ** (lines - 1.0)
        return total

    def _as_given(self, read: FloatArray) -> FloatArray:
        """Return lines in the order of their transfers as a frame (rows, cols)."""
        if self.output == "last":
            read = read[::-1]
        return np.asarray(np.maximum(np.moveaxis(read, 0, self.axis), 0.0))

    def _delay(self, packets: FloatArray) -> FloatArray:
        """Return where traps release the charge of packets (lines, n)."""
        total: FloatArray = np.zeros(packets.shape)
        for share, release in self.releases:
            total = total + share * _release(packets, float(np.exp(-1.0 / release)))
        return total

    def otf(self, fx_cy_per_px: FloatArray, fy_cy_per_px: FloatArray, transfers: float) -> NDArray[np.complex128]:
        """Return the transfer function of charge that is transferred that often."""
        frequency = fy_cy_per_px if self.axis == 0 else fx_cy_per_px
        turn = np.exp((-2j if self.output == "first" else 2j) * np.pi * np.asarray(frequency, float))
        return self._transfer(turn, transfers)

    def _transfer(self, turn: NDArray[np.complex128], transfers: FloatArray | float) -> NDArray[np.complex128]:
        """Return the transfer by the phase of one place back; `turn` and `transfers` broadcast."""
        if self.at_once:
            parts = [kept * ((1.0 - b) * turn / (1.0 - b * turn) - 1.0) for kept, b in self._retain_at_once(transfers)]
            return np.asarray(1.0 + sum(parts))
        delayed: NDArray[np.complex128] = np.zeros(np.shape(turn), complex)
        for share, release in self.releases:
            held = np.exp(-1.0 / release)
            delayed = delayed + share * (1.0 - held) * turn / (1.0 - held * turn)
        return np.asarray(np.exp(np.asarray(transfers, float) * self.loss * (delayed - 1.0)))

    def noise(self, lines: int, to_the_next: bool) -> tuple[float, float, float]:
        """Return the variance of the noise that is read, mean over a frame of `lines`, over that of the packets; and
        its correlation with the next packet and with the second one.

        Where a share of each packet lags behind, noise has its transfer. `to_the_next`: each packet fills the traps,
        and all that it finds is what the one before has left: its noise has the transfer of a delay by one place,
        exp(n loss (z - 1)), or (1 - a) / (1 - a z) with a = n loss / (1 + g) where all transfers act `at_once`.
        """
        transfers = (np.arange(NOISE_PLACES)[:, None] + 0.5) / NOISE_PLACES * lines + 0.5
        transfers = np.minimum(transfers, MOST_SHARED / self.loss)
        frequency = np.arange(NOISE_GRID)[None, :] / NOISE_GRID
        turn = np.exp(-2j * np.pi * frequency)
        if not to_the_next:
            amplitude = self._transfer(turn, transfers)
        elif self.at_once:
            kept = sum(kept for kept, _ in self._retain_at_once(transfers))
            amplitude = (1.0 - kept) / (1.0 - kept * turn)
        else:
            amplitude = np.exp(transfers * self.loss * (turn - 1.0))
        power = np.mean(np.square(np.abs(amplitude)), axis=0)
        variance, first, second = (float(np.mean(power * np.cos(2.0 * np.pi * k * frequency[0]))) for k in range(3))
        return variance, first / variance, second / variance

    def kernel(self, transfers: float) -> FloatArray:
        """Return where a packet's charge ends up, (2 `TRAIL_PX` + 1, 1) of rows or (1, 2 `TRAIL_PX` + 1) of columns:
        what is released beyond is left out.
        """
        frequency = np.asarray(np.fft.fftfreq(TRAIL_GRID), float)
        along = replace(self, axis=0, output="first").otf(np.zeros(TRAIL_GRID), frequency, transfers)
        behind = np.real(np.fft.ifft(along))[: TRAIL_PX + 1]
        kernel = np.concatenate([np.zeros(TRAIL_PX), behind])
        if self.output == "last":
            kernel = kernel[::-1]
        return np.asarray(kernel[:, None] if self.axis == 0 else kernel[None, :])


@lru_cache(maxsize=256)
def read_combs(laws: tuple[Trails, ...], lines: int, step: int) -> FloatArray:
    """Electrons (step, lines) that are read of every line, of one electron in every `step`-th line from the first, the
    second, ... one on alone: even light of a mosaic, by its phases. `laws`: of one axis, one after the other."""
    combs = (np.arange(lines) % step == np.arange(step)[:, None]).astype(float)
    for law in laws:
        combs = replace(law, axis=1).clock(combs)
    combs.setflags(write=False)
    return combs


def _release(packets: FloatArray, held: float) -> FloatArray:
    """Return where one species releases the charge of packets (lines, n), of which it holds `held` a transfer."""
    return np.asarray(lfilter([0.0, 1.0 - held], [1.0, -held], packets, axis=0))
