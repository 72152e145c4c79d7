"""Converter step: one decision level is off, so that all codes from there on are shifted."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np

from sim.camera import CameraModel
from sim.effects.converter import ConverterLaw
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Codes

PLACES = 64  # parts of the range, at whose borders a step is looked for first
#: The counts of single codes change with the place within a code, and do so anew in the next one: only over several
#: codes the place is determined.
SMOOTH_OVER_DN = 4.0


class AdcStep(ConverterLaw):
    """Code + s from one code on; offset and gain as without: nothing at codes 0 and 2^bits.

    A comparator of a flash or subranging converter is off, or two ranges of a dual-gain read-out don't join. Unlike a
    bit's, its step may stand at any code.
    """

    name: ClassVar[str] = "adc_step"
    title: ClassVar[str] = "ADC step"
    shapes: ClassVar[frozenset[str]] = frozenset({"code_dn"})
    sentence: ClassVar[str] = (
        "The converter's characteristic has a step at one code: levels on either side don't join, and codes are "
        "missing or come twice there."
    )

    step_dn: Annotated[
        float, Quantity("DN", "height of the step", lower=-50.0, upper=50.0, prior=(0.0, 1.0), absent=0.0)
    ] = 0.0
    code_dn: Annotated[
        float,
        Quantity("DN", "code at which it stands", lower=0.0, upper=65536.0, absent=2048.0, smooth_over=SMOOTH_OVER_DN),
    ] = 2048.0

    def log_prior(self) -> float:
        """Bits change at known codes: a step elsewhere may stand at any of the places that histograms tell apart."""
        return -float(np.log(2.0 * PLACES))

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        full = 2.0**camera.bit_depth
        return tuple(
            (cls(step_dn=0.3, code_dn=full * k / PLACES), cls(step_dn=-0.3, code_dn=full * k / PLACES))
            for k in range(1, PLACES)
        )

    def on_codes(self, codes: Codes) -> Codes:
        if self.step_dn == 0.0:
            return codes
        full = 2.0**codes.camera.bit_depth

        def convert(dn: FloatArray) -> FloatArray:
            coded = np.asarray(dn * (1.0 - self.step_dn / full))
            return np.add(coded, self.step_dn, out=coded, where=dn >= self.code_dn)

        return codes.add_laws(codes=convert)
