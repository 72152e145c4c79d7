"""Dark current that changes with the sensor's temperature more than the camera model says."""

from __future__ import annotations

from typing import Annotated, ClassVar

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Charge


class DarkCurrentTemperature(Effect):
    """Dark current x 2^(k (T - T_reference)), the camera's reference temperature; on top of what its own doubling
    says.
    """

    name: ClassVar[str] = "dark_current_temperature"
    family: ClassVar[Family] = Family.DARK_SIGNAL
    reference: ClassVar[str] = "EMVA Standard 1288 release 4.0, dark current and doubling temperature"
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "wavelength", "field", "level", "orientation"})
    sentence: ClassVar[str] = (
        "The sensor's temperature changed: dark charge, mean and noise together, grows with the exposure and doubles "
        "every few degrees."
    )

    doublings_per_c: Annotated[
        float,
        Quantity("1/C", "doublings of the dark current a degree", lower=-0.5, upper=0.5, prior=(0.0, 0.05), absent=0.0),
    ] = 0.0

    def on_charge(self, charge: Charge) -> Charge:
        if self.doublings_per_c == 0.0:
            return charge
        reference_c = charge.camera.dark_current_reference_c

        def warm(e_per_s: FloatArray | float, temperature_c: float | None) -> FloatArray | float:
            if temperature_c is None:
                return e_per_s
            return e_per_s * 2.0 ** (self.doublings_per_c * (temperature_c - reference_c))

        return charge.add_laws(dark_current=warm)
