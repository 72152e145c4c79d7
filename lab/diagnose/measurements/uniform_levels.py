"""Means by channel of captures of uniform light, all predicted at once: what linearity and narrowband signals share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from lab.capture_kinds.base import Capture
from lab.diagnose.measurements.block import Effects
from lab.diagnose.measurements.dark_level import added_dark_dn
from lab.diagnose.measurements.line_means import LineMeans
from lab.diagnose.measurements.study import Study
from sim.spectrum import FloatArray
from sim.uniform import Uniform


class UniformLevels:
    """Means of a list of (capture, channel), n of them, of captures that each stand once in `captures`."""

    def __init__(self, study: Study, points: Sequence[tuple[Capture, str]]) -> None:
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
        """DN (n,) of light and of the camera's own dark current, after read-out. `rates`: e/s on axis by channel, (captures,)."""
        model = Uniform(self._study.camera, effects)
        field = model.field(self._study.field)
        electrons = model.electrons(rates, self._exposure_s, field=field, elapsed_s=self._elapsed_s)
        found = np.empty(len(self._of))
        for channel, dn in model.mean_dn(electrons).items():
            mine = self._channel == channel
            found[mine] = dn[self._of[mine]]
        return found

    def beside_light_dn(self, effects: Effects) -> FloatArray:
        """DN (n,) that are neither of light nor of the camera's own dark current: black level, image lag, offsets, additional dark
        current."""
        study = self._study
        offset, dark, carried = study.offset(effects), added_dark_dn(study, effects), study.carried_e(effects)
        of_capture = np.array([study.noise.black + offset(capture) + dark(capture) for capture in self.captures])
        lag_e = np.array([carried(capture, channel) for capture, channel in self._points])
        return np.asarray(of_capture[self._of] + study.noise.gain * lag_e)
