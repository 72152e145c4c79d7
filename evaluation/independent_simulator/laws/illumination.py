"""Laws of the rig: lamp, monochromator, radiometer, screen, and light of the room."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from evaluation.independent_simulator.law import SPECTRAL, WAVELENGTH_NM, Array, Law


class SourceDriftLaw(Law):
    """The source changes after the radiometer read it. Variants: linearly; exponentially towards a final value."""

    name = effect = "source_drift"
    variants, unit, nominal, limits, signed = 2, "%/min", 0.15, (0.002, 3.0), True

    def source_factor(self, elapsed_s: float) -> float:
        minutes = elapsed_s / 60.0
        return 1 + self.signed_strength / 100.0 * (minutes if self.variant == 0 else 8.0 * (1 - np.exp(-minutes / 8.0)))

    def library_parameters(self) -> dict[str, float]:
        return {"drift_percent_per_min": self.signed_strength} if self.variant == 0 else {}


class SourceInstabilityLaw(Law):
    """The source is unsteady at random. Variants: anew in each frame; correlated from frame to frame; an arc that jumps
    between two places."""

    name = effect = "source_instability"
    variants, unit, nominal, limits, power = 3, "%", 0.6, (0.01, 8.0), 2.0

    def source_factor(self, elapsed_s: float) -> float:
        if self.variant == 2:
            return 1 + self.strength / 100 * float(self.rng(13, round(elapsed_s)).choice([-1.0, 1.0]))
        turns = [self.rng(13, round(elapsed_s) + 20 * lag).standard_normal() for lag in range(6 if self.variant else 1)]
        weight = 0.6 ** np.arange(len(turns))
        return float(1 + self.strength / 100 * (weight @ turns) / np.sqrt(weight @ weight))

    def library_parameters(self) -> dict[str, float]:
        return {"instability_percent": self.strength} if self.variant != 1 else {}


class LampJumpLaw(Law):
    """The lamp's arc jumps once (related to source drift)."""

    name, unit, nominal, limits, signed = "lamp_jump", "%", 1.0, (0.01, 10.0), True
    families = frozenset({"source_in_time"})

    def source_factor(self, elapsed_s: float) -> float:
        return 1 + self.signed_strength / 100 * float(elapsed_s > 60.0 * (5.0 + 12.0 * self.uniform[0]))


class LightFlickerLaw(Law):
    """The source flickers at 100 Hz under a rolling shutter. Variants: a sine; a rectified sine."""

    name = effect = "light_flicker"
    variants, unit, nominal, limits = 2, "%", 10.0, (0.1, 90.0)

    def row_factors(self, count: int, exposure_s: float, k: int) -> Array:
        start = self.rng(6, k).random() / 100.0
        t = start + np.arange(count)[:, None] * 60e-6 + exposure_s * (np.arange(64)[None, :] + 0.5) / 64
        phase = 2 * np.pi * 100.0 * t
        wave = np.sin(phase) if self.variant == 0 else np.pi / 2 * np.abs(np.sin(phase / 2)) - 1
        return 1 + self.strength / 100 * wave.mean(1)[:, None]


class PulsedLightLaw(Law):
    """A source dimmed by 2 kHz pulses under a rolling shutter (related to flicker)."""

    name, unit, nominal, limits = "pulsed_light", "%", 60.0, (5.0, 95.0)
    families = frozenset({"source_in_time"})

    def row_factors(self, count: int, exposure_s: float, k: int) -> Array:
        on, period = 1 - self.strength / 100, 5e-4
        start = self.rng(8, k).random() * period + np.arange(count)[:, None] * 60e-6

        def light_until(t: Array) -> Array:
            return np.floor(t / period) * on + np.minimum(t / period % 1.0, on)

        return (light_until(start + exposure_s) - light_until(start)) * period / exposure_s / on


class AmbientLightLaw(Law):
    """Light of the room while the shutter is open. Variants: equal in all channels; reddish."""

    name = effect = "ambient_light"
    variants, unit, nominal, limits = 2, "e/s", 100.0, (0.2, 3e5)

    def ambient_e_per_s(self, channel: str) -> float:
        return self.strength * ({"R": 1.6, "G": 1.0, "B": 0.5, "Y": 1.0}[channel] if self.variant == 1 else 1.0)

    def library_parameters(self) -> dict[str, float]:
        return {"rate_e_per_s": self.strength} if self.variant == 0 else {}


class NonUniformIlluminationLaw(Law):
    """A gradient over the field along a random direction. Variants: linear; with a quadratic part."""

    name = effect = "non_uniform_illumination"
    variants, unit, nominal, limits = 2, "%", 1.5, (0.02, 15.0)

    def relative_response(self, x: Array, y: Array) -> Array:
        t = 2 * np.pi * self.uniform[0]
        along = (x / np.abs(x).max()) * np.cos(t) + (y / np.abs(y).max()) * np.sin(t)
        return 1 + self.strength / 100 * (along + (0.2 * along**2 if self.variant == 1 else 0.0))

    def library_parameters(self) -> dict[str, float]:
        t = 2 * np.pi * self.uniform[0]
        return (
            {"gradient_x_percent": self.strength * np.cos(t), "gradient_y_percent": self.strength * np.sin(t)}
            if self.variant == 0
            else {}
        )


class StereoGainLaw(Law):
    """One camera of a pair responds to scenes more strongly than to uniform light."""

    name = effect = "stereo_gain_mismatch"
    unit, nominal, limits, signed, shown_by = "%", 6.0, (0.1, 50.0), True, frozenset({"charuco"})

    def scene_factor(self, kind: str) -> float:
        return 1.0 if kind in {"flat", "narrowband"} else 1.0 + self.signed_strength / 100.0

    def library_parameters(self) -> dict[str, float]:
        return {"gain_percent": self.signed_strength}


class StrayLightLaw(Law):
    """Broadband light beside the monochromator's line. Variants: a flat spectrum; a lamp's."""

    name = effect = "stray_light"
    variants, unit, nominal, limits, shown_by = 2, "%", 0.4, (0.005, 6.0), SPECTRAL

    def radiance(self, radiance: Array, kind: str) -> Array:
        if kind != "narrowband":
            return radiance
        shape = np.ones_like(WAVELENGTH_NM) if self.variant == 0 else np.exp((WAVELENGTH_NM - 560) / 250)
        return (1 - self.strength / 100) * radiance + self.strength / 100 * radiance.sum() * shape / shape.sum()

    def library_parameters(self) -> dict[str, float]:
        return {"share_percent": self.strength} if self.variant == 0 else {}


class SourceBandwidthLaw(Law):
    """The line is wider than read; strength: the standard deviation of the convolution. Variants: Gaussian;
    triangular."""

    name = effect = "source_bandwidth"
    variants, unit, nominal, limits, power, shown_by = 2, "nm", 4.0, (0.3, 15.0), 2.0, SPECTRAL

    def radiance(self, radiance: Array, kind: str) -> Array:
        if kind != "narrowband":
            return radiance
        away = np.arange(-60.0, 61.0)
        kernel = (
            np.exp(-0.5 * (away / self.strength) ** 2)
            if self.variant == 0
            else np.clip(1 - np.abs(away) / (self.strength * 6**0.5), 0, None)
        )
        return np.convolve(radiance, kernel / kernel.sum(), mode="same")

    def library_parameters(self) -> dict[str, float]:
        return {"width_nm": self.strength}


class WavelengthOffsetLaw(Law):
    """Monochromator and radiometer share a wavelength error. Variants: constant; proportional to (wavelength - 300
    nm)."""

    name = effect = "wavelength_offset"
    variants, unit, nominal, limits, signed, shown_by = 2, "nm", 1.0, (0.02, 8.0), True, SPECTRAL

    def radiance(self, radiance: Array, kind: str) -> Array:
        if kind != "narrowband":
            return radiance
        off = self.signed_strength * (1.0 if self.variant == 0 else (WAVELENGTH_NM - 300.0) / 260.0)
        return np.interp(WAVELENGTH_NM - off, WAVELENGTH_NM, radiance)

    def library_parameters(self) -> dict[str, float]:
        return {"offset_nm": self.signed_strength} if self.variant == 0 else {}


class RadiometerNonlinearityLaw(Law):
    """The radiometer reads strong light too low. Variants: in proportion to the level; a power law."""

    name = effect = "radiometer_nonlinearity"
    variants, unit, nominal, limits, shown_by = 2, "%", 2.0, (0.1, 15.0), SPECTRAL

    def radiance(self, radiance: Array, kind: str) -> Array:
        if kind != "narrowband":
            return radiance
        level = radiance.max() / 0.004
        return radiance * (1 + self.strength / 100 * level if self.variant == 0 else level ** (self.strength / 100))


class PolarisedLightLaw(Law):
    """Beyond a grating anomaly the light is polarised and the camera's response changes: a step over wavelength."""

    name, unit, nominal, limits, shown_by = "polarised_light", "%", 3.0, (0.05, 20.0), SPECTRAL
    families = frozenset({"source_in_wavelength", "spectral_filter"})

    def radiance(self, radiance: Array, kind: str) -> Array:
        at = 500.0 + 100.0 * self.uniform[0]
        return (
            radiance * (1 + self.strength / 100 / (1 + np.exp(-(WAVELENGTH_NM - at) / 2.0)))
            if kind == "narrowband"
            else radiance
        )


class ScreenPixelStructureLaw(Law):
    """The screen's pixel grid is resolved by the lens."""

    name = effect = "screen_pixel_structure"
    unit, nominal, limits, shown_by = "%", 20.0, (1.0, 90.0), frozenset({"checkerboard"})

    def screen_pattern(self, fine: Array, row: Array, col: Array) -> Array:
        period = 2.5 + 2.0 * self.uniform[0]
        return fine * (1 + self.strength / 100 * np.cos(2 * np.pi * col / period) * np.cos(2 * np.pi * row / period))


class ScreenGammaLaw(Law):
    """Grey levels at the borders of cells are shown darker, by a power. Variants: borders as drawn; blurred borders;
    above a dark offset."""

    name = effect = "screen_gamma"
    variants, unit, nominal, limits, shown_by = 3, "1", 1.2, (0.01, 4.0), frozenset({"checkerboard"})

    def screen_pattern(self, fine: Array, row: Array, col: Array) -> Array:
        asked = gaussian_filter(fine, 1.6, mode="nearest") if self.variant == 1 else fine
        asked = np.clip(asked, 0.0, 1.0)
        if self.variant == 2:
            return np.clip((asked - 0.05) / 0.95, 0.0, 1.0) ** (1 + self.strength)
        return asked ** (1 + self.strength)
