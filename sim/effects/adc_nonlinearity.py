"""Converter nonlinearity: the weights of its bits aren't powers of two, so that codes are wide, narrow or missing."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect, Stage
from sim.parameters import Quantity
from sim.spectrum import FloatArray

#: Bits, from the highest, whose weights are off, by turns up and down, each by the root of its weight.
BITS = 4


class AdcNonlinearity(Effect):
    """A successive-approximation converter: where bit k, counted from the highest, is set the code is off by (-1)^k e 2^(-k/2),
    e the highest bit's error; offset and gain as without: nothing at codes 0 and 2^bits. Jumps stand at multiples of 2^(bits-4)."""

    name: ClassVar[str] = "adc_nonlinearity"
    stage: ClassVar[Stage] = Stage.ELECTRONICS
    reference: ClassVar[str] = (
        "IEEE Std 1241-2010, differential and integral nonlinearity of analogue-to-digital converters"
    )
    form_tolerance: ClassVar[float] = 0.2
    invariances: ClassVar[frozenset[str]] = frozenset(
        {"f_number", "exposure", "wavelength", "field", "orientation", "time"}
    )
    shown_by: ClassVar[frozenset[str]] = frozenset({"flat", "narrowband", "chart"})
    sentence: ClassVar[str] = (
        "The converter's bits have wrong weights: levels jump at fixed codes, and histograms have gaps or spikes there."
    )

    error_dn: Annotated[
        float,
        Quantity("DN", "error of the highest bit's weight", lower=-50.0, upper=50.0, prior=(0.0, 1.0), absent=0.0),
    ] = 0.0

    def codes(self, dn: FloatArray, camera: CameraModel) -> FloatArray:
        if self.error_dn == 0.0:
            return dn
        full = 2.0**camera.bit_depth
        off, ends = np.zeros(np.shape(dn)), 0.0
        for k in range(BITS):
            size = self.error_dn * (-1.0) ** k * 2.0 ** (-0.5 * k)
            off += size * (np.floor(np.clip(dn, 0.0, full - 1.0) * 2.0 ** (k + 1) / full) % 2)
            ends += size
        return dn + off - ends * dn / full
