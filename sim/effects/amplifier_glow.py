"""Amplifier glow: light of the sensor's own output stage, brightest beside it."""

from __future__ import annotations

from functools import cache
from typing import Annotated, ClassVar, Literal, Self, get_args

import numpy as np
from pydantic import Field

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Charge

Corner = Literal["top_left", "top_right", "bottom_left", "bottom_right"]


class AmplifierGlow(Effect):
    """g exp(-r / r0) electrons a second on top, r from the outermost pixel of one corner; it glows while charge is
    collected.
    """

    name: ClassVar[str] = "amplifier_glow"
    family: ClassVar[Family] = Family.DARK_SIGNAL
    reference: ClassVar[str] = "J. R. Janesick, Scientific Charge-Coupled Devices, SPIE Press 2001, luminescence"
    form_tolerance: ClassVar[float] = 0.2
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "wavelength", "level", "orientation", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"reach_mm"})
    sentence: ClassVar[str] = (
        "The output stage glows: dark frames brighten with the exposure towards one corner, whatever is in front of "
        "the lens."
    )

    glow_e_per_s: Annotated[
        float,
        Quantity("e/s", "electrons a second in that corner", lower=0.0, upper=1e6, prior=(0.0, 100.0), absent=0.0),
    ] = 0.0
    reach_mm: Annotated[
        float,
        Quantity("mm", "distance over which it falls to 1/e", lower=0.01, upper=5.0, prior=(1.0, 1.0), absent=1.0),
    ] = 1.0
    corner: Annotated[Corner, Field(description="where the output stage is")] = "top_left"

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        half_mm = camera.half_diagonal_um * 1e-3
        return tuple(
            (cls(glow_e_per_s=6.0, reach_mm=float(np.clip(share * half_mm, 0.011, 4.5)), corner=corner),)
            for corner in get_args(Corner)
            for share in (0.1, 0.3, 0.7)
        )

    def on_charge(self, charge: Charge) -> Charge:
        if self.glow_e_per_s == 0.0:
            return charge
        camera = charge.camera

        @cache
        def glow() -> FloatArray:
            side, end = self.corner.split("_")
            down, across = np.arange(camera.rows, dtype=float), np.arange(camera.cols, dtype=float)
            down = down if side == "top" else down[::-1]
            across = across if end == "left" else across[::-1]
            distance_mm = np.hypot(down[:, None], across[None, :]) * camera.pixel_pitch_um * 1e-3
            return np.asarray(self.glow_e_per_s * np.exp(-distance_mm / self.reach_mm))

        return charge.add_laws(dark_current=lambda e_per_s, temperature_c: e_per_s + glow())
