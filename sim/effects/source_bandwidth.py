"""Source bandwidth: narrowband light is wider than the radiometer says."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Light

#: Gauss-Hermite's: the mean over them of shifted spectra is the convolution.
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(15)


class SourceBandwidth(Effect):
    """Narrowband radiance convolved with a Gaussian of the stated standard deviation."""

    name: ClassVar[str] = "source_bandwidth"
    family: ClassVar[Family] = Family.SOURCE_IN_WAVELENGTH
    reference: ClassVar[str] = "E. and R. Stearns, Color Res. Appl. 13, 257 (1988)"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "level", "field", "orientation", "time"})
    sentence: ClassVar[str] = (
        "The narrowband light is wider than stated: the sensitivities' peaks come out lower and their valleys higher."
    )

    width_nm: Annotated[
        float,
        Quantity(
            "nm",
            "standard deviation of the additional width",
            lower=0.0,
            upper=30.0,
            prior=(0.0, 4.0),
            absent=0.0,
            linear_power=2,
        ),
    ] = 0.0

    def on_light(self, light: Light) -> Light:
        if self.width_nm == 0.0:
            return light

        def spectrum(wavelength_nm: FloatArray, radiance: FloatArray, kind: str) -> FloatArray:
            if kind != "narrowband":
                return radiance
            shifted = [
                np.interp(wavelength_nm - self.width_nm * x, wavelength_nm, radiance, left=0.0, right=0.0)
                for x in _NODES
            ]
            return np.asarray(_WEIGHTS @ np.array(shifted) / _WEIGHTS.sum())

        return light.add_laws(spectrum=spectrum)
