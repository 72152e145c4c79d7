"""What a third party's simulator does to the frames of a session."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from sim.sensor.margins import NO_MARGINS, Margins
from sim.spectrum import FloatArray

Kind = Literal["electronic", "optical"]


@dataclass(frozen=True)
class SimulatorCheck:
    """The size of an effect in a simulator's own output, by a few lines of numpy, and the size that was asked for.

    tolerance : of the difference, three standard deviations or the simulator's documented error
    """

    asked: float
    measured: float
    tolerance: float

    @property
    def is_right(self) -> bool:
        """Return whether the simulator does what it was asked for."""
        return bool(abs(self.measured - self.asked) <= self.tolerance)


@dataclass
class SimulatedSensor:
    """A healthy sensor: electrons are Poisson numbers and are read as they are. Simulators override a step.

    truth : values of the library's parameters by their names, where the simulator's mean the same
    plan : which captures show the effect
    """

    truth: Mapping[str, float] = field(default_factory=dict)
    plan: Literal["usual", "dark after bright", "faint flats", "hot pixels"] = "usual"

    @property
    def margins(self) -> Margins:
        """Margins of what `collect` and `read` return."""
        return NO_MARGINS

    def collect(self, mean_e: FloatArray, exposure_s: float, rng: np.random.Generator) -> FloatArray:
        """Return the electrons (rows, cols) that a frame of `mean_e` collects, with its margins."""
        return rng.poisson(mean_e).astype(float)

    def read(self, electrons: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return the signal (rows, cols) in electrons, before read noise, of what was collected."""
        return electrons

    def check(self) -> SimulatorCheck:
        """Measure the effect in the simulator's output; of a healthy sensor the variance over the mean, which is 1."""
        drawn = self.read(self.collect(np.full((200, 200), 1000.0), 0.01, rng := np.random.default_rng(1)), rng)
        return SimulatorCheck(1.0, float(np.var(drawn) / np.mean(drawn)), 3.0 * np.sqrt(2.0 / drawn.size))


@dataclass
class SimulatedOptics:
    """A point spread function by a simulator.

    truth : values of the library's parameters by their names
    """

    truth: Mapping[str, float] = field(default_factory=dict)

    def edge(self, size: int, angle_deg: float, pitch_um: float) -> FloatArray:
        """Return the image (size, size) of a half plane of light of level 1, integrated over pixels."""
        raise NotImplementedError

    def check(self) -> SimulatorCheck:
        """Compare the transfer at one frequency with its closed form."""
        raise NotImplementedError
