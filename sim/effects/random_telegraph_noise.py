"""Random telegraph noise: a few pixels jump between two levels."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect, Stage
from sim.parameters import Quantity
from sim.sensor.defects import odd_pixels
from sim.spectrum import FloatArray


class RandomTelegraphNoise(Effect):
    """A share of the pixels, `pattern_seed` says which, is read with +A/2 or -A/2, each half of the time and anew in every frame
    (traps much faster than the frame rate): mean 0, variance A^2 / 4, two peaks in a pixel's histogram."""

    name: ClassVar[str] = "random_telegraph_noise"
    stage: ClassVar[Stage] = Stage.ELECTRONICS
    reference: ClassVar[str] = "X. Wang et al., Random telegraph signal in CMOS image sensor pixels, IEDM 2006"
    form_tolerance: ClassVar[float] = 0.3
    invariances: ClassVar[frozenset[str]] = frozenset(
        {"f_number", "exposure", "wavelength", "field", "level", "orientation", "time"}
    )
    shown_by: ClassVar[frozenset[str]] = frozenset({"dark", "flat"})
    rivals: ClassVar[frozenset[str]] = frozenset({"hot_pixels"})
    shapes: ClassVar[frozenset[str]] = frozenset({"share_percent"})
    sentence: ClassVar[str] = (
        "A few pixels blink: always the same ones jump between two levels, with far more temporal noise than their neighbours."
    )

    amplitude_e: Annotated[
        float,
        Quantity("e", "distance of the two levels", lower=0.0, upper=1e4, prior=(0.0, 20.0), absent=0.0, slope_power=2),
    ] = 0.0
    share_percent: Annotated[
        float, Quantity("%", "share of the pixels that blink, one at least", lower=0.0, upper=100.0, absent=0.2)
    ] = 0.2
    pattern_seed: int = 0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return ((cls(amplitude_e=6.0),),)

    def _pixels(self, shape: tuple[int, ...]) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        return odd_pixels(shape, self.share_percent / 100.0, self.pattern_seed)

    def added(self, shape: tuple[int, ...], rng: np.random.Generator, camera: CameraModel) -> FloatArray | None:
        if self.amplitude_e == 0.0:
            return None
        jump, pixels = np.zeros(shape), self._pixels(shape)
        jump.flat[pixels] = self.amplitude_e * (rng.integers(0, 2, pixels.size) - 0.5)
        return jump

    def added_e2(self, shape: tuple[int, ...], camera: CameraModel) -> FloatArray | float:
        if self.amplitude_e == 0.0:
            return 0.0
        variance = np.zeros(shape)
        variance.flat[self._pixels(shape)] = self.amplitude_e**2 / 4.0
        return variance
