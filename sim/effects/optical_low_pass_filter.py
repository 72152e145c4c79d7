"""Birefringent anti-alias filter: each ray arrives as two or four copies, displaced along columns and rows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.optics.filters import birefringent_displacement_um, birefringent_otf
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import ComplexArray, Image

#: Difference of the two beams over their sum behind a plate that isn't cut at exactly 45 degrees, or in light that is
#: partly polarised.
BEAM_IMBALANCE = 0.08
#: Ratios of the displacements' squares between which two plates aren't nearly alike and one isn't alone, and what that
#: costs.
UNALIKE, UNUSUAL_NATS = (0.002, 0.02, 0.35, 0.55), -4.0


class OpticalLowPassFilter(Effect):
    """OTF factor cos(pi fx dx) cos(pi fy dy).

    A plate of thickness t cut at 45 degrees displaces by d = t (ne^2 - no^2) / (ne^2 + no^2); quartz: 5.88e-3 t at 589
    nm (`sim.optics.filters`). The cosine is exact; what a data sheet doesn't give has forms of its own: the dispersion
    of the plate (quartz: 4 % more at 400 nm, 1 % less at 700 nm), and two beams that aren't equally bright. Of a filter
    that is known to be of quartz, `plate` says so, and d follows its dispersion from the stated one at 589 nm.
    """

    name: ClassVar[str] = "optical_low_pass_filter"
    title: ClassVar[str] = "optical low-pass filter"
    family: ClassVar[Family] = Family.ISOTROPIC_CONTRAST
    reference: ClassVar[str] = "Walker-Pavlopoulos plate displacement; J. Greivenkamp, Appl. Opt. 29, 676 (1990)"
    form_tolerance: ClassVar[float] = 0.002
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "field", "level", "time"})
    forms: ClassVar[Mapping[str, object]] = {"plate": "quartz", "beam_imbalance": BEAM_IMBALANCE}
    sentence: ClassVar[str] = (
        "A birefringent anti-alias filter splits each ray into displaced copies: contrast falls as a cosine of spatial "
        "frequency, alike in all colours and at all f-numbers, along rows and columns apart."
    )

    displacement_x_um: Annotated[
        float,
        Quantity(
            "um",
            "distance of the two copies along columns at 589 nm",
            lower=0.0,
            upper=20.0,
            prior=(0.0, 2.0),
            absent=0.0,
            linear_power=2,
        ),
    ] = 0.0
    displacement_y_um: Annotated[
        float,
        Quantity(
            "um",
            "distance of the two copies along rows at 589 nm",
            lower=0.0,
            upper=20.0,
            prior=(0.0, 2.0),
            absent=0.0,
            linear_power=2,
        ),
    ] = 0.0

    plate: Annotated[
        Literal["quartz"] | None, Field(description="material, by whose dispersion the distances grow")
    ] = None

    beam_imbalance: Annotated[
        float, Field(ge=0.0, le=1.0, description="difference of a plate's two beams over their sum")
    ] = 0.0

    def log_prior(self) -> float:
        """Filters are made of one plate, or of two nearly alike: not of a thick one and one of a third of its
        strength.
        """
        low, high = sorted((self.displacement_x_um**2, self.displacement_y_um**2))
        return float(np.interp(low / high, UNALIKE, (0.0, UNUSUAL_NATS, UNUSUAL_NATS, 0.0))) if high > 0 else 0.0

    def on_image(self, image: Image) -> Image:
        if self.displacement_x_um == 0.0 and self.displacement_y_um == 0.0:
            return image

        def transfer(
            fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float
        ) -> FloatArray | ComplexArray:
            share = 1.0
            if self.plate == "quartz":
                share = float(birefringent_displacement_um(1.0, wavelength_nm) / birefringent_displacement_um(1.0))
            return birefringent_otf(
                fx_cy_per_um,
                fy_cy_per_um,
                share * self.displacement_x_um,
                share * self.displacement_y_um,
                self.beam_imbalance,
            )

        return image.add_laws(transfer=transfer)
