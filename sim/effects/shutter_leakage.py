"""Shutter leakage: a global shutter's store still collects light while it waits for its row to be read."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Charge


class ShutterLeakage(Effect):
    """Light is collected for a further t_leak w, whatever the exposure: w is 0 in the row that is read first and 1 in
    the one that is read last. t_leak is the time of read-out times the store's sensitivity over the pixel's, the
    parasitic light sensitivity. A rolling shutter has no store, and nothing changes.
    """

    name: ClassVar[str] = "shutter_leakage"
    family: ClassVar[Family] = Family.RESPONSE
    reference: ClassVar[str] = (
        "E. R. Fossum and D. B. Hondongwa, A review of the pinned photodiode, IEEE J. Electron Devices Soc. 2 (2014) "
        "33; EMVA Standard 1288 release 4.0, shutter"
    )
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "wavelength", "level", "time"})
    sentence: ClassVar[str] = (
        "The shutter leaks: rows that wait longer for read-out are brighter, by as much light at every exposure, which "
        "is most of all at short ones."
    )

    last_row_us: Annotated[
        float,
        Quantity(
            "us",
            "time in which the row that is read last collects light besides",
            lower=0.0,
            upper=1e5,
            prior=(0.0, 30.0),
            absent=0.0,
        ),
    ] = 0.0
    read_last: Annotated[Literal["bottom", "top"], Field(description="end of the frame that is read last")] = "bottom"

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return (cls(last_row_us=9.0),), (cls(last_row_us=9.0, read_last="top"),)

    def on_charge(self, charge: Charge) -> Charge:
        if self.last_row_us == 0.0 or charge.camera.shutter == "rolling":
            return charge

        def leak(down: FloatArray, across: FloatArray) -> FloatArray:
            waits = down if self.read_last == "bottom" else 1.0 - down
            return np.asarray(1e-6 * self.last_row_us * waits * np.ones_like(across))

        return charge.add_laws(leak_s=leak)
