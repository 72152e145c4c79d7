"""How much light a flat's manifest states: photons a pixel, or else the time of exposure to one lamp."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from lab.capture_kinds.flat import FlatCapture


@dataclass(frozen=True)
class StatedLight:
    """The light of one flat. Amounts of one unit and wavelength compare where the lamp is the same.

    `std`, `calibration_std`: relative standard uncertainties where it was measured, by its readings, and by the reference's calibration,
    which is common to all that it measured.
    """

    amount: float
    unit: Literal["photons", "s"]
    wavelength_nm: float | None
    std: float = 0.0
    calibration_std: float = 0.0

    @property
    def lamp(self) -> tuple[bool, float | None]:
        """What flats without a measured radiance share where their amounts compare."""
        return self.unit == "photons", self.wavelength_nm


def stated_light(flat: FlatCapture) -> StatedLight:
    """Photons per pixel where they are stated, else the exposure (s)."""
    if flat.photons_per_pixel is not None:
        return StatedLight(flat.photons_per_pixel, "photons", flat.wavelength_nm)
    return StatedLight(flat.exposure_s, "s", flat.wavelength_nm)
