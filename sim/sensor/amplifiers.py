"""Output amplifiers that read areas of a frame at the same time, and couple into each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.spectrum import FloatArray


@dataclass(frozen=True)
class CoupledAmplifiers:
    """Each of `down` x `across` equal areas is read by an amplifier of its own, all at once, and takes over shares of
    what the others read at that moment.

    `coupling` (areas, areas), row after row of areas: share that the first index takes over from the second, 0 on the
    diagonal. `turned`: adjacent areas, and below each other, are read in opposite directions, so that places
    are mirrored about their borders. `of_noise`: read noise is coupled as signals are. The frame's mean of even light
    stays, as it is part of the camera's gain. Lines that are left over at the end take part in nothing.
    """

    coupling: FloatArray
    down: int
    across: int
    turned: bool
    of_noise: bool = False

    def _stack_areas(self, frame: FloatArray) -> FloatArray:
        """Areas (areas, rows, cols) of a frame in reading order."""
        rows, cols = frame.shape[0] // self.down, frame.shape[1] // self.across
        areas = []
        for i in range(self.down):
            for j in range(self.across):
                area = frame[i * rows : (i + 1) * rows, j * cols : (j + 1) * cols]
                if self.turned:
                    area = area[:: -1 if i % 2 else 1, :: -1 if j % 2 else 1]
                areas.append(area)
        return np.array(areas)

    def _place_areas(self, areas: FloatArray, frame: FloatArray) -> FloatArray:
        """A copy of a frame with these areas."""
        out, (rows, cols) = np.array(frame), areas.shape[1:]
        for k, area in enumerate(areas):
            i, j = divmod(k, self.across)
            turned = area[:: -1 if i % 2 else 1, :: -1 if j % 2 else 1] if self.turned else area
            out[i * rows : (i + 1) * rows, j * cols : (j + 1) * cols] = turned
        return out

    @property
    def _whole(self) -> float:
        """Mean factor on even light before it is divided by it."""
        return 1.0 + float(self.coupling.sum()) / len(self.coupling)

    def couple(self, frame: FloatArray) -> FloatArray:
        """Return what is read of a frame's signals (rows, cols)."""
        areas = self._stack_areas(frame)
        return self._place_areas((areas + np.einsum("ij,jrc->irc", self.coupling, areas)) / self._whole, frame)

    def couple_variances(self, frame: FloatArray) -> FloatArray:
        """Return the variances of what is read, of independent pixels of these variances (rows, cols)."""
        areas = self._stack_areas(frame)
        squared = np.square(self.coupling)
        return self._place_areas((areas + np.einsum("ij,jrc->irc", squared, areas)) / self._whole**2, frame)
