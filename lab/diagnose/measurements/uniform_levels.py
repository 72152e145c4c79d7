"""Prediction of the mean levels of captures of uniform light, shared by linearity and narrowband signals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from lab.capture_kinds.base import Capture
from lab.diagnose.measurements.dark_level import added_dark_dn
from lab.diagnose.measurements.line_means import LineMeans
from lab.measure.study import Study
from sim.effects.base import Effects
from sim.spectrum import FloatArray
from sim.uniform import Uniform


class UniformLevels:
    """Mean levels of n pairs of capture and channel. `captures` lists each capture once."""

    def __init__(self, study: Study, points: Sequence[tuple[Capture, str]]) -> None:
        """`points`: n of (capture, channel)."""
        self._study = study
        self.captures: tuple[Capture, ...] = tuple({capture.id: capture for capture, _ in points}.values())
        number = {capture.id: i for i, capture in enumerate(self.captures)}
        self._of = np.array([number[capture.id] for capture, _ in points])
        self._points = tuple(points)
        self._channel = np.array([channel for _, channel in points])
        self._exposure_s = np.array([capture.exposure_s for capture in self.captures])
        self._elapsed_s = np.array([study.elapsed_s(capture) for capture in self.captures])
        self.lines = LineMeans(study, points)

    def of_light_dn(self, effects: Effects, rates: Mapping[str, FloatArray]) -> FloatArray:
        """DN (n,) by light and the baseline's dark current, after read-out. `rates`: channel -> electrons a second on
        axis, (captures,)."""
        model = Uniform(self._study.camera, effects)
        field = model.field(self._study.field)
        electrons = model.electrons(rates, self._exposure_s, field=field, elapsed_s=self._elapsed_s)
        found = np.empty(len(self._of))
        for channel, dn in model.mean_dn(electrons).items():
            mine = self._channel == channel
            found[mine] = dn[self._of[mine]]
        return found

    def beside_light_dn(self, effects: Effects) -> FloatArray:
        """DN (n,) by all else: black level, offsets, image lag, and dark current that effects add."""
        study = self._study
        offset, dark, carried = study.offset(effects), added_dark_dn(study, effects), study.carried_e(effects)
        of_capture = np.array([study.noise.black + offset(capture) + dark(capture) for capture in self.captures])
        lag_e = np.array([carried(capture, channel) for capture, channel in self._points])
        return np.asarray(of_capture[self._of] + study.noise.gain * lag_e)
