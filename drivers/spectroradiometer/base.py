"""The spectroradiometer abstraction: spectral radiance of a spot."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

from drivers.instrument import Instrument
from sim.spectrum import Spectrum


@dataclass(frozen=True)
class RadianceMeasurement:
    """One measurement: spectral radiance (W sr^-1 m^-2 nm^-1), integration time, and the instrument's identity."""

    radiance_w_sr_m2_nm: Spectrum
    integration_time_s: float | None
    serial_number: str


class Spectroradiometer(Instrument):
    """A spectroradiometer aimed at the scene in front of the cameras."""

    @abstractmethod
    def measure(self) -> RadianceMeasurement:
        """Measure once, with the instrument's own choice of integration time.

        Raises `drivers.errors.Refused` with the instrument's code for over- or under-exposure and the like.
        """
