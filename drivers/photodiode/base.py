"""The reference photodiode: irradiance at the place of the sensor, as EMVA 1288 (release 4, section 6.1) has it
measured."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

from drivers.instrument import Instrument


@dataclass(frozen=True)
class IrradianceMeasurement:
    """Irradiance (W/m2) of light of one wavelength (nm), and what it was made of: current above dark (A) and its number
    of readings.

    `sd_irradiance_w_m2` holds the scatter of the readings and of the dark readings, and the calibration's own
    uncertainty; `calibration_sd` is the latter, relative: all measurements with this photodiode have it in common."""

    irradiance_w_m2: float
    sd_irradiance_w_m2: float
    wavelength_nm: float
    current_a: float
    readings: int
    calibration_sd: float = 0.0


class Photodiode(Instrument):
    """A calibrated photodiode with a meter of its current."""

    @abstractmethod
    def measure_dark(self) -> float:
        """Return the current (A) without light, mean of the readings; later measurements are above it."""

    def check_nm(self, wavelength_nm: float) -> None:
        """Raise `InstrumentError` for a wavelength (nm) that `measure` would refuse, as far as the driver knows;
        nothing is asked."""
        return

    @abstractmethod
    def measure(self, wavelength_nm: float) -> IrradianceMeasurement:
        """Return the irradiance of light of this wavelength. Raises `InstrumentError` outside the calibration,
        `Refused` for an overload.
        """
