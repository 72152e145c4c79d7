"""Bit weights: the lowest bits of the converter have wrong weights, so that the widths of codes repeat every few
codes."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.effects.converter import ConverterLaw, bit_error
from sim.spectrum import FloatArray
from sim.stages import Codes

#: Codes after which the widths repeat: those of the three lowest bits.
PERIOD = 8


class BitWeights(ConverterLaw):
    """The level from which on code k is given is off by the errors of those of its three lowest bits that are set, and
    by one more where both of the two lowest are: four free widths that repeat every four codes, and a fifth error that
    repeats every eight. Their mean over the codes is left out, as an offset is black level.

    A width below 0 is a missing code. Two errors of -1 and -2 make every code a multiple of four: ten bits written as
    twelve.
    """

    name: ClassVar[str] = "bit_weights"
    sentence: ClassVar[str] = (
        "The converter's lowest bits have wrong weights: some codes come more often than their neighbours, and the "
        "pattern repeats every two, four or eight codes over the whole range."
    )

    last_dn: Annotated[float, bit_error("error of the lowest bit's weight", -1.0, 2.0, 0.3)] = 0.0
    second_dn: Annotated[float, bit_error("error of the second-lowest bit's weight", -2.0, 2.0, 0.3)] = 0.0
    pair_dn: Annotated[
        float, bit_error("further error where the two lowest bits are set", -2.0, 2.0, 0.3, dispensable=True)
    ] = 0.0
    third_dn: Annotated[
        float, bit_error("error of the third-lowest bit's weight", -4.0, 4.0, 0.3, dispensable=True)
    ] = 0.0

    def thresholds(self) -> FloatArray:
        """Return the levels (PERIOD + 1,), in DN, from which on the codes 0 to PERIOD are given."""
        code = np.arange(PERIOD)
        last, second, third = (code >> bit & 1 for bit in range(3))
        off = self.last_dn * last + self.second_dn * second + self.pair_dn * last * second + self.third_dn * third
        # the highest bit that fits is set: a code that begins above a later one is missing
        level = np.clip(np.minimum.accumulate((code + off)[::-1])[::-1], 0.0, PERIOD)
        level = level - np.mean(level - code) - 0.5
        return np.append(level, level[0] + PERIOD)

    def on_codes(self, codes: Codes) -> Codes:
        if self.last_dn == self.second_dn == self.pair_dn == self.third_dn == 0.0:
            return codes
        levels = self.thresholds()
        ideal = np.arange(PERIOD + 1) - 0.5

        def convert(dn: FloatArray) -> FloatArray:
            turns, within = np.divmod(np.asarray(dn, float) - levels[0], PERIOD)
            return np.asarray(PERIOD * turns + np.interp(within + levels[0], levels, ideal))

        return codes.add_laws(codes=convert)
