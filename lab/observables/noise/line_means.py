"""Scatter of the means of single frames by effects' noise of rows and columns, and in reading order.

The pixels of a line share its noise, so that the mean of a channel scatters by more than the noise of independent
pixels. Of n lines whose noise has the power spectrum S(f) (e^2) across lines, the mean over all lines has the variance
S(0) / n, and half of the difference between even and odd lines S(1/2) / n. In a mosaic, channels on the same lines
share both."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from lab.capture_kinds.base import Capture
from lab.observables.dataset import Dataset
from sim.effects.base import Effects
from sim.sensor import mosaic
from sim.spectrum import FloatArray
from sim.uniform import Uniform

#: Most strengths of line noise whose columns are cached.
MOST_KEPT = 16


class LineMeans:
    """Jacobian of n frame means by the line noise of each capture: its mean over lines, and its even-odd difference."""

    def __init__(self, dataset: Dataset, points: Sequence[tuple[Capture, str | None]]) -> None:
        """`points`: n of (capture, channel); channel None: the mean of the whole frame."""
        self._dataset = dataset
        self._channels = [channel for _, channel in points]
        at: dict[str, list[int]] = {}
        for number, (capture, _) in enumerate(points):
            at.setdefault(capture.id, []).append(number)
        self._at = {name: np.array(numbers) for name, numbers in at.items()}
        self._kept: dict[tuple[str, str, float], dict[str, FloatArray]] = {}

    def jacobian(self, effects: Effects) -> dict[str, FloatArray]:
        """Name of a nuisance parameter -> column (n,), DN per standard deviation. Empty without effects that add line
        noise."""
        columns: dict[str, FloatArray] = {}
        camera, gain = self._dataset.camera, self._dataset.noise.gain
        for one in Uniform(camera, effects).lines:
            count = camera.rows if one.lines == "rows" else camera.cols
            for name, frequency in (("mean", 0.0), ("odd", 0.5)):
                std_dn = gain * float(np.sqrt(one.spectrum_e2(np.array([frequency]), fixed=False)[0] / count))
                columns |= self._columns(one.lines, name, std_dn)
        shape = camera.rows, camera.cols
        for ordered in Uniform(camera, effects).reading_order:
            for name, frequency in (("mean", 0.0), ("odd", 0.5)):
                power_e2 = float(ordered.plane_e2(shape, np.array(frequency), np.array(0.0)))
                columns |= self._columns("columns", name, gain * float(np.sqrt(power_e2 / (shape[0] * shape[1]))))
        return columns

    def _columns(self, lines: str, name: str, std_dn: float) -> dict[str, FloatArray]:
        """Return the columns of one strength, which are kept."""
        key = lines, name, std_dn
        if std_dn > 0.0 and key not in self._kept:
            if len(self._kept) > MOST_KEPT:
                self._kept.clear()
            self._kept[key] = dict(self._of_captures(*key))
        return self._kept.get(key, {})

    def _of_captures(self, lines: str, name: str, std_dn: float) -> Iterator[tuple[str, FloatArray]]:
        """Yield the columns of one strength, one for each capture."""
        sign = {c: 1.0 if name == "mean" else _even_over_odd(self._dataset, lines, c) for c in {*self._channels}}
        change = std_dn * np.array([sign[c] for c in self._channels])
        for capture, mine in self._at.items():
            if np.any(change[mine]):
                column = np.zeros(len(change))
                column[mine] = change[mine]
                yield f"{lines}:{name}:{capture}", column


def _even_over_odd(dataset: Dataset, lines: str, channel: str | None) -> float:
    """Mean over the lines of a channel of 1 on even lines and -1 on odd ones."""
    if channel is None or mosaic.step(dataset.camera.cfa) == 1:
        return 0.0
    phases = mosaic.phases(dataset.camera.cfa)[channel]
    return float(np.mean([1.0 - 2.0 * (phase[0 if lines == "rows" else 1] % 2) for phase in phases]))
