"""Coloured read noise: the read noise of neighbours in the row is correlated."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Signal

LEAST_POWER = 1e-3  # of the spectrum over its mean: below, correlations of these sizes can't be


class ColouredReadNoise(Effect):
    """Correlation r q^(m - 1) of the read noise of two pixels m columns apart in a row, so that its power at f cycles a
    pixel is 1 + 2 r Re(z / (1 - q z)) of its mean, z = exp(2 pi i f). An amplifier that doesn't settle within a pixel
    has q = r; double sampling that shares a sample with the pixel before has q = 0, and r below 0.
    """

    name: ClassVar[str] = "coloured_read_noise"
    family: ClassVar[Family] = Family.READ_NOISE
    reference: ClassVar[str] = (
        "J. R. Janesick, Scientific Charge-Coupled Devices, SPIE Press (2001), on correlated double sampling"
    )
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "field", "level", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"decay"})
    sentence: ClassVar[str] = (
        "The read noise of neighbours in the row is correlated, and shot noise isn't: the amplifier doesn't settle "
        "within a pixel (correlation above 0), or samples are shared between pixels (below 0)."
    )

    correlation: Annotated[
        float,
        Quantity("1", "of the read noise with the next pixel's", lower=-0.48, upper=0.9, prior=(0.0, 0.1), absent=0.0),
    ] = 0.0
    decay: Annotated[
        float,
        Quantity(
            "1",
            "share of the correlation that is left a pixel further",
            lower=-0.9,
            upper=0.95,
            prior=(0.0, 0.3),
            absent=0.0,
            dispensable=True,
        ),
    ] = 0.0

    def on_signal(self, signal: Signal) -> Signal:
        if self.correlation == 0.0:
            return signal
        # of mean 1 over frequencies, where nothing is cut off
        whole = float(np.mean(self._cut(np.asarray(np.fft.fftfreq(512), float))))
        return signal.add_laws(read_spectrum=lambda frequency_cy_per_px: self._cut(frequency_cy_per_px) / whole)

    def _cut(self, frequency_cy_per_px: FloatArray) -> FloatArray:
        z = np.exp(2j * np.pi * np.asarray(frequency_cy_per_px, float))
        power = 1.0 + 2.0 * self.correlation * np.real(z / (1.0 - self.decay * z))
        return np.maximum(power, LEAST_POWER)
