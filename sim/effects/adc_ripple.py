"""Converter ripple: an integral nonlinearity that repeats over the codes, as folding and interpolating converters
have.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np

from sim.camera import CameraModel
from sim.effects.converter import ConverterLaw
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Codes

#: Periods that are tried first: parts of the converter's range, in which folding and subranging converters divide it.
PARTS = (4, 8, 16, 32)
SHORTEST_DN = 16.0  # period: shorter ones are single codes


class AdcRipple(ConverterLaw):
    """Code + a sin(2 pi code / p) + b cos(2 pi code / p): levels lie off by up to sqrt(a^2 + b^2), and codes are wider
    and narrower in turn, by 2 pi sqrt(a^2 + b^2) / p of their width.
    """

    name: ClassVar[str] = "adc_ripple"
    title: ClassVar[str] = "ADC ripple"
    shapes: ClassVar[frozenset[str]] = frozenset({"period_dn"})
    sentence: ClassVar[str] = (
        "The converter's characteristic has a ripple: levels lie above and below their line in turn, at fixed codes, "
        "and the noise's slope goes with it."
    )

    sine_dn: Annotated[
        float,
        Quantity("DN", "amplitude of the sine from code 0 on", lower=-50.0, upper=50.0, prior=(0.0, 1.0), absent=0.0),
    ] = 0.0
    cosine_dn: Annotated[
        float,
        Quantity("DN", "amplitude of the cosine from code 0 on", lower=-50.0, upper=50.0, prior=(0.0, 1.0), absent=0.0),
    ] = 0.0
    period_dn: Annotated[
        float, Quantity("DN", "period of the ripple, in codes", lower=SHORTEST_DN, upper=65536.0, absent=512.0)
    ] = 512.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        full = 2.0**camera.bit_depth
        return tuple(
            tuple(
                cls(sine_dn=sine, cosine_dn=cosine, period_dn=full / part)
                for sine, cosine in ((0.3, 0.0), (-0.3, 0.0), (0.0, 0.3), (0.0, -0.3))
            )
            for part in PARTS
            if full / part >= SHORTEST_DN
        )

    def on_codes(self, codes: Codes) -> Codes:
        if self.sine_dn == 0.0 and self.cosine_dn == 0.0:
            return codes

        amplitude_dn, phase = np.hypot(self.sine_dn, self.cosine_dn), np.arctan2(self.cosine_dn, self.sine_dn)

        def convert(dn: FloatArray) -> FloatArray:
            ripple = np.multiply(dn, 2.0 * np.pi / self.period_dn)
            ripple += phase
            np.sin(ripple, out=ripple)
            ripple *= amplitude_dn
            return np.asarray(dn + ripple)

        return codes.add_laws(codes=convert)
