"""The irradiance that a reference photodiode measured beside a capture."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field
from scipy import constants

from lab.capture_kinds.base import Capture, Reading, Step


class IrradianceCapture(Capture):
    """Light of one wavelength whose irradiance a reference photodiode measured at its own place, where the station has
    one.

    `sd_irradiance_w_m2`: standard uncertainty of the irradiance, by the readings' scatter and by the calibration
    together; `irradiance_calibration_sd_percent`: the calibration's part, which all captures with this photodiode have
    in common."""

    wavelength_nm: float | None = Field(default=None, gt=0)
    irradiance_w_m2: Annotated[float | None, Reading("irradiance_w_m2")] = None
    sd_irradiance_w_m2: Annotated[float | None, Reading("sd_irradiance_w_m2")] = Field(default=None, ge=0)
    irradiance_calibration_sd_percent: Annotated[float | None, Reading("irradiance_calibration_sd_percent")] = Field(
        default=None, ge=0
    )

    @property
    def photon_irradiance_per_m2_s(self) -> float | None:
        """Photons a second and square metre where the photodiode is, E wavelength / (h c) (EMVA 1288 release 4.0, eq.
        3); None without one."""
        if self.irradiance_w_m2 is None or self.wavelength_nm is None:
            return None
        return self.irradiance_w_m2 * self.wavelength_nm * 1e-9 / (constants.h * constants.c)

    @property
    def irradiance_readings_sd(self) -> float:
        """Relative standard uncertainty of the irradiance by its readings alone; 0 where nothing is known of it."""
        if not self.irradiance_w_m2 or self.sd_irradiance_w_m2 is None:
            return 0.0
        whole = self.sd_irradiance_w_m2 / self.irradiance_w_m2
        return math.sqrt(max(0.0, whole**2 - self.irradiance_calibration_sd**2))

    @property
    def irradiance_calibration_sd(self) -> float:
        """Relative standard uncertainty of the photodiode's calibration; 0 where it isn't stated apart."""
        return (self.irradiance_calibration_sd_percent or 0.0) / 100.0


def irradiance_nm(step: Step) -> float | None:
    """Return the wavelength (nm) at which a photodiode measures the irradiance beside a step's captures; None: it has
    one responsivity, and measures in light of one wavelength alone.
    """
    captures = [capture for capture in step.captures if isinstance(capture, IrradianceCapture)]
    if not captures:
        return None
    lit = (captures[0].wavelength_nm if step.setting.lamp else step.setting.wavelength_nm) or 0.0
    return lit if lit > 0.0 else None
