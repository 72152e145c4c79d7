"""Second-order light: a grating sends half the wavelength the same way, and no filter stops it."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Light


class SecondOrderLight(Effect):
    """Narrowband radiance L(w) + 2 r L(2 w): a line read at w0 brings r of its power along at w0 / 2, in half the
    width.
    """

    name: ClassVar[str] = "second_order_light"
    title: ClassVar[str] = "second-order light"
    family: ClassVar[Family] = Family.SOURCE_IN_WAVELENGTH
    reference: ClassVar[str] = "C. Palmer, Diffraction Grating Handbook, free spectral range and order sorting"
    form_tolerance: ClassVar[float] = 0.15
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "level", "field", "orientation", "time"})
    sentence: ClassVar[str] = (
        "The monochromator lets its second order through: from twice the shortest wavelength on, channels that are "
        "sensitive at half the wavelength respond."
    )

    share_percent: Annotated[
        float,
        Quantity(
            "%",
            "power at half the wavelength over that at the wavelength read",
            lower=0.0,
            upper=100.0,
            prior=(0.0, 1.0),
            absent=0.0,
        ),
    ] = 0.0

    def on_light(self, light: Light) -> Light:
        if self.share_percent == 0.0:
            return light

        def spectrum(wavelength_nm: FloatArray, radiance: FloatArray, kind: str) -> FloatArray:
            if kind != "narrowband":
                return radiance
            twice = np.interp(2.0 * wavelength_nm, wavelength_nm, radiance, left=0.0, right=0.0)
            return np.asarray(radiance + 0.02 * self.share_percent * twice)

        return light.add_laws(spectrum=spectrum)
