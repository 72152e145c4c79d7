"""What a physical effect declares and where it acts. One effect, one file; `sim.effects.library` lists them.

A first-order camera model leaves physics out. Each effect is one such piece, written as a change to a stage of the
forward model. Every hook's default changes nothing, so a model without effects is the baseline bit for bit.
"""

from __future__ import annotations

from enum import StrEnum
from typing import ClassVar, Self

import numpy as np

from sim.camera import CameraModel
from sim.parameters import Frozen, Quantity, declared
from sim.spectrum import FloatArray


class Stage(StrEnum):
    """Where an effect acts, in the order of the light."""

    RIG = "rig"  # the light source, the target, the radiometer: what reaches the lens
    OPTICS = "optics"  # lens, filters: what reaches the pixel
    CHARGE = "charge"  # in the silicon: where an electron ends up
    ELECTRONICS = "electronics"  # from charge to DN


class Effect(Frozen):
    """Base of all effects. Parameters are fields annotated with `sim.parameters.Quantity` (unit, bounds, prior, `absent`,
    `slope_power`), each with its `absent` value as default, so that `TheEffect()` is the baseline."""

    name: ClassVar[str]
    stage: ClassVar[Stage]
    reference: ClassVar[str]
    #: Fraction of its own effect by which the textbook law may be wrong (one standard deviation).
    form_tolerance: ClassVar[float] = 0.05
    #: What the effect doesn't depend on, of: f_number exposure wavelength field level orientation time.
    invariances: ClassVar[frozenset[str]] = frozenset()
    #: Kinds of capture that can show it (`dark`, `flat`, `narrowband`, `slanted_edge`, ...).
    shown_by: ClassVar[frozenset[str]] = frozenset()
    #: Names of effects that can look the same in some set of captures.
    rivals: ClassVar[frozenset[str]] = frozenset()
    #: One sentence for the report: what physics was left out and how that shows.
    sentence: ClassVar[str]

    @classmethod
    def quantities(cls) -> dict[str, Quantity]:
        """The declared parameters, by field name."""
        return declared(cls)

    @classmethod
    def from_slopes(cls, slopes: dict[str, float]) -> Self:
        """The effect at given slope coordinates u = parameter ** slope_power (measured from `absent`)."""
        values = {}
        for field, quantity in cls.quantities().items():
            u = slopes.get(field, 0.0)
            absent = quantity.absent or 0.0
            values[field] = absent + (
                u if quantity.slope_power == 1 else np.sign(u) * abs(u) ** (1 / quantity.slope_power)
            )
        return cls(**values)

    # --- hooks, in the order of the light; each returns its input changed -------------------------------------------

    def radiance(self, wavelength_nm: FloatArray, radiance: FloatArray, kind: str) -> FloatArray:
        """RIG: the radiance in front of the lens, given what the radiometer said; `kind` is the capture's."""
        return radiance

    def transmittance(self, wavelength_nm: FloatArray, sin_theta: FloatArray | float) -> FloatArray:
        """OPTICS: factor on the light, by wavelength and sine of the chief ray's angle at the sensor."""
        return np.ones(np.broadcast_shapes(np.shape(wavelength_nm), np.shape(sin_theta)))

    def transfer(
        self, fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float, camera: CameraModel
    ) -> FloatArray | None:
        """OPTICS or CHARGE: factor on the optical transfer function (1 at zero frequency), or None for none.

        fx runs along columns (x, to the right), fy along rows (y, down). May be complex. An effect that replaces a part of
        the baseline's OTF (defocus: diffraction with an aberrated pupil) returns the ratio to the baseline.
        """
        return None

    def charge(self, electrons: FloatArray, exposure_s: float, camera: CameraModel) -> FloatArray:
        """CHARGE: mean electrons of a whole frame (rows, cols), after light and dark current were added."""
        return electrons

    def response(self, electrons: FloatArray, camera: CameraModel) -> FloatArray:
        """ELECTRONICS: what the read-out makes of a mean signal in electrons, point by point (linear: the same)."""
        return electrons
