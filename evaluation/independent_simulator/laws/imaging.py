"""Laws that blur or displace the image: aberrations, low-pass filter, motion, the pixel's aperture."""

from __future__ import annotations

import numpy as np
from scipy.special import j0, j1

from evaluation.independent_simulator.law import OPTICAL, REFERENCE_NM, Array, Law


class OpticalLowPassFilterLaw(Law):
    """Two birefringent plates split each point into four. Variants: equal displacements; 0.8 of the displacement along
    columns; beams of 45 and 55 %."""

    name = effect = "optical_low_pass_filter"
    variants, unit, nominal, limits, power, shown_by = 3, "um", 1.5, (0.1, 3.0), 2.0, OPTICAL

    def transfer(self, fx: Array, fy: Array) -> Array:
        e = self.strength * (0.8 if self.variant == 1 else 1.0)
        if self.variant < 2:
            return np.cos(np.pi * fx * self.strength) * np.cos(np.pi * fy * e)
        share = 0.45
        split = [
            share * np.exp(1j * np.pi * f * self.strength) + (1 - share) * np.exp(-1j * np.pi * f * self.strength)
            for f in (fx, fy)
        ]
        return split[0] * split[1]

    def library_parameters(self) -> dict[str, float]:
        return {
            "displacement_x_um": self.strength,
            "displacement_y_um": self.strength * (0.8 if self.variant == 1 else 1.0),
        }


class DefocusLaw(Law):
    """Displaced focus. Variants: path difference of a sphere; its parabola; the parabola and 0.1 of spherical
    aberration, which a stopped lens has the less of."""

    name = effect = "defocus"
    variants, unit, nominal, limits, power, shown_by = 3, "um", 12.0, (0.5, 60.0), 2.0, OPTICAL

    def path_error_um(self, x: Array, y: Array, wavelength_nm: float) -> Array:
        rho2, n = x * x + y * y, self.camera.f_number
        if self.variant == 0:
            sine2 = 1.0 / (4.0 * n * n)  # path difference dz (1 - cos theta), which isn't quite a parabola
            return self.strength * (1.0 - np.sqrt(1.0 - sine2 * rho2))
        w = self.strength / (8.0 * n * n)
        return w * rho2 + (0.1 * w * (self.camera.open_pupil**2 * rho2 * rho2 - rho2) if self.variant == 2 else 0.0)

    def library_parameters(self) -> dict[str, float]:
        return {"defocus_um": self.strength} if self.variant < 2 else {}


class SphericalAberrationLaw(Law):
    """Wavefront W040 rho^4. Variants: alone; with 0.2 W040 rho^6."""

    name = effect = "spherical_aberration"
    variants, unit, nominal, limits, power, shown_by = 2, "um", 0.2, (0.01, 1.2), 2.0, OPTICAL

    def path_error_um(self, x: Array, y: Array, wavelength_nm: float) -> Array:
        height2 = self.camera.open_pupil**2 * (x * x + y * y)
        return self.strength * (height2**2 + (0.2 * height2**3 if self.variant == 1 else 0.0))

    def library_parameters(self) -> dict[str, float]:
        return {"w040_um": self.strength} if self.variant == 0 else {}


class AstigmatismLaw(Law):
    """Wavefront W (x^2 - c y^2). Variants: c = 1, focus midway between the two line foci; c = 0.5."""

    name = effect = "astigmatism"
    variants, unit, nominal, limits, power, shown_by = 2, "um", 0.2, (0.01, 1.2), 2.0, OPTICAL

    def path_error_um(self, x: Array, y: Array, wavelength_nm: float) -> Array:
        at_rim_um = self.strength * self.camera.open_pupil**2
        return at_rim_um * (x * x - (1.0 if self.variant == 0 else 0.5) * y * y)


class ComaLaw(Law):
    """Wavefront W rho^2 x along a random direction. Variants: alone; with the tilt -2/3 W x that balances it."""

    name = effect = "coma"
    variants, unit, nominal, limits, power, shown_by = 2, "um", 0.3, (0.02, 2.0), 2.0, OPTICAL

    def path_error_um(self, x: Array, y: Array, wavelength_nm: float) -> Array:
        t = 2.0 * np.pi * self.uniform[0]
        rim = self.camera.open_pupil
        along = x * np.cos(t) + y * np.sin(t)
        return self.strength * rim * (rim**2 * (x * x + y * y) - (2.0 / 3.0 if self.variant == 1 else 0.0)) * along


class TrefoilLaw(Law):
    """Wavefront W rho^3 cos 3 (t - t0). Variants: alone along columns; turned by a random angle, with a fifth of
    tetrafoil, rho^4 cos 4 (t - t0)."""

    name = effect = "trefoil"
    variants, unit, nominal, limits, power, shown_by = 2, "um", 0.2, (0.02, 1.5), 2.0, OPTICAL

    def path_error_um(self, x: Array, y: Array, wavelength_nm: float) -> Array:
        turn = np.exp(-2j * np.pi * self.uniform[0]) if self.variant == 1 else 1.0
        z = self.camera.open_pupil * (x + 1j * y) * turn
        return self.strength * np.real(z**3 + (0.2 * z**4 if self.variant == 1 else 0.0))

    def library_parameters(self) -> dict[str, float]:
        return {"w333_x_um": -self.strength} if self.variant == 0 else {}  # phases have the other sign here


class AxialColourLaw(Law):
    """Defocus that depends on the wavelength. Variants: linear; quadratic; Conrady's dispersion formula."""

    name = effect = "axial_chromatic_aberration"
    variants, unit, nominal, limits, power, signed = 3, "um", 12.0, (0.5, 80.0), 2.0, True
    shown_by = OPTICAL

    def path_error_um(self, x: Array, y: Array, wavelength_nm: float) -> Array:
        t = (wavelength_nm - REFERENCE_NM) / 100.0
        if self.variant == 1:
            t = t * t
        elif self.variant == 2:
            t = 2.3 * (1.0 - (REFERENCE_NM / wavelength_nm) ** 3.5) / 1.5
        return self.signed_strength * t / (8.0 * self.camera.f_number**2) * (x * x + y * y)

    def library_parameters(self) -> dict[str, float]:
        return {0: {"slope_um": self.signed_strength}, 1: {"curvature_um": self.signed_strength}}.get(self.variant, {})


class LateralColourLaw(Law):
    """Magnification that depends on the wavelength. Variants: linear; Conrady's dispersion formula; a third of it with
    the cube of the radius."""

    name = effect = "lateral_chromatic_aberration"
    variants, unit, nominal, limits, signed, needs = 3, "um", 1.5, (0.02, 20.0), True, "bayer"
    shown_by = frozenset({"checkerboard"})

    def image_shift_px(self, x: Array, y: Array, wavelength_nm: float) -> tuple[Array, Array]:
        t = (wavelength_nm - REFERENCE_NM) / 100.0
        if self.variant == 1:
            t = 2.3 * (1.0 - (REFERENCE_NM / wavelength_nm) ** 3.5) / 1.5
        out = (
            self.signed_strength * t / self.camera.pitch_um * (1.0 if self.variant < 2 else (2.0 + x * x + y * y) / 3.0)
        )
        return out * x, out * y

    def library_parameters(self) -> dict[str, float]:
        return {"slope_um": self.signed_strength} if self.variant == 0 else {}


class LensDistortionLaw(Law):
    """Radial distortion since the calibration. Variants: third power of the radius; fifth."""

    name = effect = "distortion"
    variants, unit, nominal, limits, signed, shown_by = 2, "%", 0.5, (0.005, 10.0), True, frozenset({"charuco"})

    def image_shift_px(self, x: Array, y: Array, wavelength_nm: float) -> tuple[Array, Array]:
        r2 = x * x + y * y
        out = (
            self.signed_strength
            / 100.0
            * 0.5
            * float(np.hypot(self.camera.rows, self.camera.cols))
            * (r2 if self.variant == 0 else r2 * r2)
        )
        return out * x, out * y

    def library_parameters(self) -> dict[str, float]:
        return {"corner_percent": self.signed_strength} if self.variant == 0 else {}


class LensDecentreLaw(Law):
    """A decentred element. Variants: Brown's tangential distortion; a thin prism."""

    name = effect = "decentre"
    variants, unit, nominal, limits, shown_by = 2, "um", 2.0, (0.02, 40.0), frozenset({"charuco"})

    def image_shift_px(self, x: Array, y: Array, wavelength_nm: float) -> tuple[Array, Array]:
        t = 2.0 * np.pi * self.uniform[0]
        a, b = (self.strength / self.camera.pitch_um * v for v in (np.cos(t), np.sin(t)))
        if self.variant == 1:
            return a * (x * x + y * y), b * (x * x + y * y)
        return a * (3 * x * x + y * y) + 2 * b * x * y, b * (x * x + 3 * y * y) + 2 * a * x * y


class VibrationBlurLaw(Law):
    """Oscillation along a random direction, strength its amplitude. Variants: a sine; a third of it at the second
    harmonic in addition."""

    name = effect = "vibration_blur"
    variants, unit, nominal, limits, power, shown_by = 2, "um", 1.2, (0.1, 5.0), 2.0, OPTICAL

    def _along(self, fx: Array, fy: Array) -> Array:
        t = np.pi * (self.uniform[0] - 0.5)
        return fx * np.cos(t) + fy * np.sin(t)

    def transfer(self, fx: Array, fy: Array) -> Array:
        q = 2 * np.pi * self.strength * self._along(fx, fy)
        if self.variant == 0:
            return j0(q)
        phase = (np.arange(48) + 0.5) / 48 * 2 * np.pi
        total = np.zeros(np.broadcast_shapes(np.shape(fx), np.shape(fy)), complex)
        for p in phase:
            total = total + np.exp(1j * q * (np.sin(p) + np.sin(2 * p) / 3.0)) / len(phase)
        return total


class MotionLaw(Law):
    """Uniform motion along a random direction during the exposure (related to vibration)."""

    name, unit, nominal, limits, power, shown_by = "motion", "um", 2.0, (0.1, 8.0), 2.0, OPTICAL
    families = frozenset({"directional_contrast_loss"})
    accepts = frozenset({"vibration_blur"})

    def transfer(self, fx: Array, fy: Array) -> Array:
        t = np.pi * (self.uniform[0] - 0.5)
        return np.sinc(self.strength * (fx * np.cos(t) + fy * np.sin(t)))


class DoubleImageLaw(Law):
    """A second image, by reflection between the faces of a plate. Variants: 2.5 px aside; aside and up by 4 to 20 px,
    as by a thick or tilted plate."""

    name = effect = "double_image"
    variants, unit, nominal, limits, shown_by = 2, "%", 3.0, (0.1, 25.0), OPTICAL

    def transfer(self, fx: Array, fy: Array) -> Array:
        r = self.strength / 100
        dx, dy = (2.5, 0.0) if self.variant == 0 else (4.0 + 16.0 * self.uniform[0], -4.0 - 16.0 * self.uniform[1])
        return (1 - r) + r * np.exp(2j * np.pi * (fx * dx + fy * dy) * self.camera.pitch_um)

    def library_parameters(self) -> dict[str, float]:
        return {"share_percent": self.strength}


class HaloLaw(Law):
    """Light scattered in the cover glass: an exponential halo of some pixels (related to charge diffusion and to
    veiling glare)."""

    name, unit, nominal, limits, shown_by = "halo", "%", 3.0, (0.05, 30.0), OPTICAL
    families = frozenset({"copies_and_veils", "isotropic_contrast_loss"})

    def spectral_transfer(self, frequency_cy_um: Array, wavelength_um: float) -> Array:
        r = (2.0 + 4.0 * self.uniform[0]) * self.camera.pitch_um
        return 1 - self.strength / 100 + self.strength / 100 / (1 + (2 * np.pi * r * frequency_cy_um) ** 2) ** 1.5


class SeeingLaw(Law):
    """Light spreads into wide wings: of a full width at half maximum of `strength`. Variants: Moffat's profile of
    exponent 2.5; of 3.5."""

    name, effect = "seeing", "moffat_blur"
    variants, unit, nominal, limits, power, shown_by = 2, "um", 1.5, (0.2, 12.0), 1.7, OPTICAL

    def spectral_transfer(self, frequency_cy_um: Array, wavelength_um: float) -> Array:
        exponent = (2.5, 3.5)[self.variant]
        core = self.strength / (2.0 * np.sqrt(2.0 ** (1.0 / exponent) - 1.0))
        x = 2.0 * np.pi * core * np.maximum(np.asarray(frequency_cy_um, float), 1e-9)
        # the Bessel functions of order 3/2 and 5/2 are elementary
        return (1.0 + x + (x * x / 3.0 if self.variant == 1 else 0.0)) * np.exp(-x)

    def library_parameters(self) -> dict[str, float]:
        exponent = (2.5, 3.5)[self.variant]
        return {"radius_um": self.strength / (2.0 * np.sqrt(2.0 ** (1.0 / exponent) - 1.0)), "exponent": exponent}


class TurbulentAirLaw(Law):
    """Turbulent air blurs long exposures: of a full width at half maximum of `strength`, 0.976 wavelength over Fried's
    length r0, by Kolmogorov's structure function 6.88 (r / r0)^(5/3)."""

    name = effect = "turbulent_air"
    variants, unit, nominal, limits, power, shown_by = 1, "um", 1.5, (0.2, 12.0), 5.0 / 3.0, OPTICAL

    def spectral_transfer(self, frequency_cy_um: Array, wavelength_um: float) -> Array:
        apart = self.strength / 0.976 * np.asarray(frequency_cy_um, float)  # of the pupils, over r0
        return np.exp(-0.5 * 6.88 * apart ** (5.0 / 3.0))

    def library_parameters(self) -> dict[str, float]:
        return {"width_um": self.strength}


class PixelApertureLaw(Law):
    """An aperture of another size than stated. Variants: a square; a disc of the same area; a square with soft
    borders."""

    name = effect = "pixel_aperture"
    variants, unit, nominal, limits, signed, shown_by = 3, "um", 0.3, (0.02, 0.9), True, OPTICAL

    def aperture_transfer(self, fx: Array, fy: Array, side_um: float) -> Array:
        side = max(side_um + self.signed_strength, 0.3 * side_um)
        if self.variant == 1:
            q = 2 * np.pi * side / np.sqrt(np.pi) * np.hypot(fx, fy)
            return np.where(q < 1e-6, 1.0, 2 * j1(np.where(q < 1e-6, 1.0, q)) / np.where(q < 1e-6, 1.0, q))
        soft = np.exp(-2 * (np.pi * 0.06 * side) ** 2 * (fx * fx + fy * fy)) if self.variant == 2 else 1.0
        return np.sinc(side * fx) * np.sinc(side * fy) * soft

    def library_parameters(self) -> dict[str, float]:
        return {"side_change_um": self.signed_strength} if self.variant == 0 else {}
