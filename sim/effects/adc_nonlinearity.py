"""Converter nonlinearity: the weights of its bits aren't powers of two, so that codes are wide, narrow or missing."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.effects.converter import ConverterLaw, bit_error
from sim.spectrum import FloatArray
from sim.stages import Codes


class AdcNonlinearity(ConverterLaw):
    """A successive-approximation converter: where one of the three highest bits is set, the code is off by that bit's
    error; offset and gain as without: nothing at codes 0 and 2^bits. Jumps stand at multiples of 2^(bits-3).
    """

    name: ClassVar[str] = "adc_nonlinearity"
    title: ClassVar[str] = "ADC nonlinearity"
    sentence: ClassVar[str] = (
        "The converter's bits have wrong weights: levels jump at fixed codes, and histograms have gaps or spikes there."
    )

    error_dn: Annotated[float, bit_error("error of the highest bit's weight", -50.0, 50.0, 1.0)] = 0.0
    second_dn: Annotated[
        float, bit_error("error of the second-highest bit's weight", -50.0, 50.0, 1.0, dispensable=True)
    ] = 0.0
    third_dn: Annotated[
        float, bit_error("error of the third-highest bit's weight", -50.0, 50.0, 1.0, dispensable=True)
    ] = 0.0

    def on_codes(self, codes: Codes) -> Codes:
        errors = (self.error_dn, self.second_dn, self.third_dn)
        if not any(errors):
            return codes
        full = 2.0**codes.camera.bit_depth
        #: By the three highest bits: the number of the eighth of the range.
        off = (np.arange(8)[:, None] >> np.array([2, 1, 0]) & 1) @ np.array(errors)

        def convert(dn: FloatArray) -> FloatArray:
            eighth = (np.minimum(np.maximum(dn, 0.0), full - 1.0) * (8.0 / full)).astype(np.intp)
            return np.asarray(dn * (1.0 - sum(errors) / full) + off[eighth])

        return codes.add_laws(codes=convert)
