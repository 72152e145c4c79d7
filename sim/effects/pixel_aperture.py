"""Pixel aperture: the share of the pixel that collects light isn't what the data sheet says."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field
from scipy.special import j1

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Charge

NULL = 1e-6  # of a transfer
#: Least side, in stated sides.
LEAST_SIDE = 0.05


#: Change of the side (um) from which on an aperture may be a disc, or have soft borders: a smaller one is the stated
#: square, nearly.
FORMED_UM = 0.3
#: Standard deviation of a soft border, in sides.
SOFT_SHARE = 0.06


class PixelAperture(Effect):
    """Side of the square aperture changed by a few um: OTF factor sinc(w' fx) sinc(w' fy) / (sinc(w fx) sinc(w fy)).

    An aperture is never wider than the pitch. Other forms of it: a disc of the same area, 2 J1(q) / q; and soft
    borders, as of a microlens.
    """

    name: ClassVar[str] = "pixel_aperture"
    family: ClassVar[Family] = Family.ISOTROPIC_CONTRAST
    reference: ClassVar[str] = (
        "G. Boreman, Modulation Transfer Function in Optical and Electro-Optical Systems, chapter 3"
    )
    form_tolerance: ClassVar[float] = 0.01
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "field", "level", "time"})
    forms: ClassVar[Mapping[str, object]] = {"disc_share": 1.0, "soft_share": SOFT_SHARE}
    sentence: ClassVar[str] = (
        "The pixel's aperture differs from the stated one: contrast at high frequencies differs alike in all colours "
        "and at all f-numbers."
    )

    side_change_um: Annotated[
        float,
        Quantity(
            "um",
            "side of the aperture less the stated one",
            lower=-5.0,
            upper=5.0,
            prior=(0.0, 0.5),
            absent=0.0,
            linear_power=1,
        ),
    ] = 0.0

    disc_share: Annotated[
        float, Field(ge=0.0, le=1.0, description="share of a disc of the same area, else a square")
    ] = 0.0
    soft_share: Annotated[float, Field(ge=0.0, description="standard deviation of soft borders over the side")] = 0.0

    @classmethod
    def limits(cls, camera: CameraModel) -> dict[str, tuple[float, float]]:
        side = camera.pixel_pitch_um * camera.fill_factor**0.5
        return {"side_change_um": (-min((1.0 - LEAST_SIDE) * side, 5.0), camera.pixel_pitch_um - side)}

    def on_charge(self, charge: Charge) -> Charge:
        if self.side_change_um == 0.0:
            return charge
        side = charge.camera.pixel_pitch_um * charge.camera.fill_factor**0.5
        new = max(side + self.side_change_um, LEAST_SIDE * side)
        formed = min(1.0, abs(self.side_change_um) / FORMED_UM)
        disc_share, soft_share = formed * self.disc_share, formed**0.5 * self.soft_share

        def transfer(fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float) -> FloatArray:
            fx, fy = np.broadcast_arrays(np.asarray(fx_cy_per_um, float), np.asarray(fy_cy_per_um, float))
            aperture = np.sinc(new * fx) * np.sinc(new * fy)
            if disc_share > 0.0:
                q = 2.0 * np.sqrt(np.pi) * new * np.hypot(fx, fy)
                disc = np.where(q > NULL, 2.0 * j1(q) / np.where(q > NULL, q, 1.0), 1.0)
                aperture = (1.0 - disc_share) * aperture + disc_share * disc
            aperture = aperture * np.exp(-2.0 * (np.pi * soft_share * new) ** 2 * (fx**2 + fy**2))
            stated = np.sinc(side * fx) * np.sinc(side * fy)
            # at the stated aperture's nulls the ratio has no value, beside them it is large: the pixel's own transfer
            # makes up for it
            is_null = (np.abs(np.sinc(side * fx)) <= NULL) | (np.abs(np.sinc(side * fy)) <= NULL)
            return np.asarray(np.where(is_null, 1.0, aperture / np.where(is_null, 1.0, stated)))

        return charge.add_laws(transfer=transfer)
