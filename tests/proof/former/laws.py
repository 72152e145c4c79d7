"""What a concealed camera does beyond the textbook's first order: every law written anew from the literature, in variants.

A law acts on the second image former's own stages (`camera.py`) and shares nothing with `sim`. `effect` is the name that the
results' list has for it, or None for kinds that no list names. Strengths are positive; `sign` is drawn where both make sense.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from scipy.ndimage import convolve, gaussian_filter, shift
from scipy.special import erfc, j0, j1

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .camera import Camera

Array = Any
#: nm, of every spectrum that the former draws and integrates.
WL: NDArray[np.float64] = np.arange(380.0, 781.0)
FULL_CODE = 4095
REFERENCE_NM = 550.0  # where laws that depend on the wavelength have their stated strength


class Law:
    """One concealed piece of physics. Hooks change nothing by default; `cam` is the camera it is built into."""

    name: ClassVar[str]
    effect: ClassVar[str | None] = None
    #: Names that wouldn't be wrong for it, beside its own.
    accepts: ClassVar[frozenset[str]] = frozenset()
    variants: ClassVar[int] = 1
    unit: ClassVar[str] = "1"
    nominal: ClassVar[float]
    limits: ClassVar[tuple[float, float]]
    #: The residual grows as strength ** power.
    power: ClassVar[float] = 1.0
    signed: ClassVar[bool] = False
    needs: ClassVar[str] = ""  # "mono", "bayer", "temperature"
    #: Kinds of capture without which it doesn't show.
    shown_by: ClassVar[frozenset[str]] = frozenset({"flat"})

    def __init__(self, strength: float, variant: int = 0, seed: int = 0) -> None:
        self.s, self.v, self.seed = float(strength), variant % self.variants, seed
        rng = np.random.default_rng([seed, 77])
        self.sign = float(rng.choice([-1.0, 1.0])) if self.signed else 1.0
        self.a = self.s * self.sign
        self.u = rng.random(8)  # places, phases, periods
        self.cam: Camera

    def bind(self, cam: Camera) -> None:
        self.cam = cam

    def rng(self, *key: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, 78, *key])

    def stated(self) -> dict[str, float]:
        """Parameters by the library's names, where this variant is sized by the same quantity."""
        return {}

    # rig
    def radiance(self, radiance: Array, kind: str) -> Array:
        return radiance

    def source(self, elapsed_s: float) -> float:
        return 1.0

    def rows(self, count: int, exposure_s: float, k: int) -> Array:
        return 1.0

    def exposure(self, exposure_s: float) -> float:
        return exposure_s

    def ambient(self, channel: str) -> float:
        return 0.0

    def screen(self, fine: Array, row: Array, col: Array) -> Array:
        return fine

    def scene(self, kind: str) -> float:
        return 1.0

    # optics
    def transmission(self, channel: str) -> Array:
        return 1.0

    def wavefront(self, x: Array, y: Array, lam_nm: float) -> Array | None:
        return None

    def lands(self, x: Array, y: Array, lam_nm: float) -> tuple[Array, Array] | None:
        """Shift of light (right, down; px) at (x, y) half diagonals from the middle."""
        return None

    def mono(self, f_cy_um: Array, lam_um: float) -> Array:
        return 1.0

    def grey(self, fx: Array, fy: Array) -> Array:
        return 1.0

    def aperture(self, fx: Array, fy: Array, side_um: float) -> Array | None:
        return None

    def shade(self, x: Array, y: Array) -> Array:
        return 1.0

    def image(self, image: Array) -> Array:
        return image

    # charge
    def lit(self, electrons: Array, rate: Array) -> Array:
        return electrons

    def dark(self, rate: Array, temperature_c: float) -> Array:
        return rate

    def lag(self, previous: Array | None) -> Array:
        return 0.0

    def collected(self, electrons: Array, mean: Array) -> Array:
        return electrons

    # electronics
    def respond(self, electrons: Array) -> Array:
        return electrons

    def noise(self, shape: tuple[int, int], k: int) -> Array:
        return 0.0

    def offset(self, elapsed_s: float, temperature_c: float) -> float:
        return 0.0

    def codes(self, dn: Array) -> Array:
        return dn

    def processed(self, dn: Array) -> Array:
        return dn


OPTICAL = frozenset({"slanted_edge"})
SPECTRAL = frozenset({"narrowband"})
DARK = frozenset({"dark"})


# --- of the results' list: optics -----------------------------------------------------------------------------------------


class OpticalLowPassFilter(Law):
    """Birefringent split into four: even; less along rows; beams of unequal strength."""

    name = effect = "optical_low_pass_filter"
    variants, unit, nominal, limits, power, shown_by = 3, "um", 1.5, (0.1, 3.0), 2.0, OPTICAL

    def grey(self, fx: Array, fy: Array) -> Array:
        e = self.s * (0.8 if self.v == 1 else 1.0)
        if self.v < 2:
            return np.cos(np.pi * fx * self.s) * np.cos(np.pi * fy * e)
        share = 0.45
        split = [
            share * np.exp(1j * np.pi * f * self.s) + (1 - share) * np.exp(-1j * np.pi * f * self.s) for f in (fx, fy)
        ]
        return split[0] * split[1]

    def stated(self) -> dict[str, float]:
        return {"displacement_x_um": self.s, "displacement_y_um": self.s * (0.8 if self.v == 1 else 1.0)}


class Defocus(Law):
    """Pupil's phase: the exact sphere; the parabola; the parabola with a tenth of spherical aberration beside it."""

    name = effect = "defocus"
    variants, unit, nominal, limits, power, shown_by = 3, "um", 12.0, (0.5, 60.0), 2.0, OPTICAL

    def wavefront(self, x: Array, y: Array, lam_nm: float) -> Array:
        rho2, n = x * x + y * y, self.cam.n
        if self.v == 0:
            sine2 = 1.0 / (4.0 * n * n)  # path difference dz (1 - cos theta), which isn't quite a parabola
            return self.s * (1.0 - np.sqrt(1.0 - sine2 * rho2))
        w = self.s / (8.0 * n * n)
        return w * rho2 + (0.1 * w * (rho2 * rho2 - rho2) if self.v == 2 else 0.0)

    def stated(self) -> dict[str, float]:
        return {"defocus_um": self.s} if self.v < 2 else {}


class SphericalAberration(Law):
    """W040 rho^4; with a fifth of the next order."""

    name = effect = "spherical_aberration"
    variants, unit, nominal, limits, power, shown_by = 2, "um", 0.2, (0.01, 1.2), 2.0, OPTICAL

    def wavefront(self, x: Array, y: Array, lam_nm: float) -> Array:
        rho2 = x * x + y * y
        return self.s * (rho2**2 + (0.2 * rho2**3 if self.v == 1 else 0.0))

    def stated(self) -> dict[str, float]:
        return {"w040_um": self.s} if self.v == 0 else {}


class Astigmatism(Law):
    """Best focus between the two lines; nearer to one of them."""

    name = effect = "astigmatism"
    variants, unit, nominal, limits, power, shown_by = 2, "um", 0.2, (0.01, 1.2), 2.0, OPTICAL

    def wavefront(self, x: Array, y: Array, lam_nm: float) -> Array:
        return self.s * (x * x - (1.0 if self.v == 0 else 0.5) * y * y)


class Coma(Law):
    name = effect = "coma"
    variants, unit, nominal, limits, power, shown_by = 2, "um", 0.3, (0.02, 2.0), 2.0, OPTICAL

    def wavefront(self, x: Array, y: Array, lam_nm: float) -> Array:
        t = 2.0 * np.pi * self.u[0]
        along = x * np.cos(t) + y * np.sin(t)
        return self.s * (x * x + y * y - (2.0 / 3.0 if self.v == 1 else 0.0)) * along


class AxialColour(Law):
    """Focus that moves with the wavelength: in proportion; as the square; by Conrady's dispersion."""

    name = effect = "axial_chromatic_aberration"
    variants, unit, nominal, limits, power, signed = 3, "um", 12.0, (0.5, 80.0), 2.0, True
    shown_by = OPTICAL

    def wavefront(self, x: Array, y: Array, lam_nm: float) -> Array:
        t = (lam_nm - REFERENCE_NM) / 100.0
        if self.v == 1:
            t = t * t
        elif self.v == 2:
            t = 2.3 * (1.0 - (REFERENCE_NM / lam_nm) ** 3.5) / 1.5
        return self.a * t / (8.0 * self.cam.n**2) * (x * x + y * y)

    def stated(self) -> dict[str, float]:
        return {0: {"slope_um": self.a}, 1: {"curvature_um": self.a}}.get(self.v, {})


class VeilingGlare(Law):
    """Light spread over the whole frame; evenly; half within a halo of a quarter of the frame; all fading from the centre."""

    name = effect = "veiling_glare"
    variants, unit, nominal, limits, shown_by = 3, "%", 1.5, (0.02, 8.0), frozenset({"chart", "checkerboard"})

    def image(self, image: Array) -> Array:
        g, mean = self.s / 100.0, image.mean()
        if self.v == 1:
            mean = 0.5 * (mean + gaussian_filter(image, 0.25 * image.shape[1], mode="nearest"))
        elif self.v == 2:
            x, y = self.cam.place
            mean = mean * (1.1 - 0.2 * np.hypot(x, y) ** 2) / (1.1 - 0.2 * np.mean(np.hypot(x, y) ** 2))
        return (1 - g) * image + g * mean

    def stated(self) -> dict[str, float]:
        return {"share_percent": self.s} if self.v == 0 else {}


class Ghost(Law):
    """A copy of the image turned about the axis, sharp or blurred."""

    name = effect = "ghost"
    variants, unit, nominal, limits, shown_by = 2, "%", 1.0, (0.02, 5.0), frozenset({"chart", "checkerboard"})

    def image(self, image: Array) -> Array:
        copy = image[::-1, ::-1]
        copy = gaussian_filter(copy, 4.0, mode="nearest") if self.v == 1 else copy
        return image + self.s / 100.0 * copy


class Vignetting(Law):
    """Fall-off towards the corners: square of the radius; two discs that part; fourth power."""

    name = effect = "vignetting"
    variants, unit, nominal, limits = 3, "%", 4.0, (0.02, 30.0)

    def shade(self, x: Array, y: Array) -> Array:
        r2 = x * x + y * y
        if self.v == 1:
            d = np.clip(0.5 * np.sqrt(r2) * self.s / 64.0, 0, 1)
            return 2.0 / np.pi * (np.arccos(d) - d * np.sqrt(1.0 - d * d))
        return 1.0 - self.s / 100.0 * (r2 if self.v == 0 else r2 * r2)

    def stated(self) -> dict[str, float]:
        return {"corner_loss_percent": self.s} if self.v == 0 else {}


class VignettingDecentre(Law):
    """A fall-off of 8 % in the corners about a point beside the middle: further than an optical axis may lie off it."""

    name = effect = "vignetting_decentre"
    accepts = frozenset({"vignetting"})
    variants, unit, nominal, limits = 2, "1", 0.3, (0.15, 0.8)

    def shade(self, x: Array, y: Array) -> Array:
        t = 2 * np.pi * self.u[0]
        r2 = (x - self.s * np.cos(t)) ** 2 + (y - self.s * np.sin(t)) ** 2
        return 1.0 - 0.08 * (r2 if self.v == 0 else r2 * np.sqrt(r2))


class InfraredCutFilter(Law):
    """An edge that is logistic, an error function, or a power of the wavelength. The strength is how far below 720 nm it cuts."""

    name = effect = "infrared_cut_filter"
    variants, unit, nominal, limits, shown_by = 3, "nm", 55.0, (4.0, 110.0), SPECTRAL

    @property
    def cut(self) -> float:
        return 720.0 - self.s

    def transmission(self, channel: str) -> Array:
        if self.v == 0:
            return 1.0 / (1.0 + np.exp((WL - self.cut) / 6.0))
        if self.v == 1:
            return 0.5 * erfc((WL - self.cut) / (np.sqrt(2.0) * 10.0))
        return 0.97 / (1.0 + (WL / self.cut) ** 120)

    def stated(self) -> dict[str, float]:
        return {"cut_wavelength_nm": self.cut}


class VibrationBlur(Law):
    """Oscillation along one direction; with a third of its amplitude at the second harmonic."""

    name = effect = "vibration_blur"
    variants, unit, nominal, limits, power, shown_by = 2, "um", 1.2, (0.1, 5.0), 2.0, OPTICAL

    def _along(self, fx: Array, fy: Array) -> Array:
        t = np.pi * (self.u[0] - 0.5)
        return fx * np.cos(t) + fy * np.sin(t)

    def grey(self, fx: Array, fy: Array) -> Array:
        q = 2 * np.pi * self.s * self._along(fx, fy)
        if self.v == 0:
            return j0(q)
        phase = (np.arange(48) + 0.5) / 48 * 2 * np.pi
        total = np.zeros(np.broadcast_shapes(np.shape(fx), np.shape(fy)), complex)
        for p in phase:
            total = total + np.exp(1j * q * (np.sin(p) + np.sin(2 * p) / 3.0)) / len(phase)
        return total


class PixelAperture(Law):
    """A square of another side; a disc of that area; a square with soft rims."""

    name = effect = "pixel_aperture"
    variants, unit, nominal, limits, signed, shown_by = 3, "um", 0.3, (0.02, 0.9), True, OPTICAL

    def aperture(self, fx: Array, fy: Array, side_um: float) -> Array:
        side = max(side_um + self.a, 0.3 * side_um)
        if self.v == 1:
            q = 2 * np.pi * side / np.sqrt(np.pi) * np.hypot(fx, fy)
            return np.where(q < 1e-6, 1.0, 2 * j1(np.where(q < 1e-6, 1.0, q)) / np.where(q < 1e-6, 1.0, q))
        soft = np.exp(-2 * (np.pi * 0.06 * side) ** 2 * (fx * fx + fy * fy)) if self.v == 2 else 1.0
        return np.sinc(side * fx) * np.sinc(side * fy) * soft

    def stated(self) -> dict[str, float]:
        return {"side_change_um": self.a} if self.v == 0 else {}


# --- charge -----------------------------------------------------------------------------------------------------------------


class ChargeDiffusion(Law):
    """Sideways drift: grey; as the square of the wavelength; absorbed along a depth in silicon (Stevens 1992)."""

    name = effect = "charge_diffusion"
    variants, unit, nominal, limits, power, shown_by = 3, "um", 0.7, (0.1, 2.5), 2.0, OPTICAL

    def mono(self, f_cy_um: Array, lam_um: float) -> Array:
        d = self.s
        if self.v < 2:
            d = d * (1.0 if self.v == 0 else (lam_um / 0.55) ** 2)
            return np.exp(-2 * (np.pi * d * f_cy_um) ** 2)
        depth, alpha = 4.0, 1 / (0.13 * (lam_um / 0.4) ** 5.5)
        z = (np.arange(30) + 0.5) / 30 * depth
        p = np.exp(-alpha * z)
        spread = (1.6 * d) ** 2 * z / depth
        return np.tensordot(p, np.exp(-2 * np.pi**2 * np.multiply.outer(spread, np.square(f_cy_um))), 1) / p.sum()

    def stated(self) -> dict[str, float]:
        return {"length_um": self.s} if self.v < 2 else {}


class Crosstalk(Law):
    """Charge to the neighbours: four; eight; more along rows."""

    name = effect = "crosstalk"
    variants, unit, nominal, limits, shown_by = 3, "%", 0.8, (0.02, 5.0), frozenset({"slanted_edge", "narrowband"})

    def lit(self, electrons: Array, rate: Array) -> Array:
        c, d = self.s / 100.0, 0.25 * self.s / 100.0 if self.v == 1 else 0.0
        h = c * (1.5 if self.v == 2 else 1.0)
        kernel = np.array([[d, c, d], [h, 1 - 2 * c - 2 * h - 4 * d, h], [d, c, d]])
        return convolve(electrons, kernel, mode="mirror")

    def stated(self) -> dict[str, float]:
        return {"share_percent": self.s} if self.v == 0 else {}


class GreenImbalance(Law):
    name = effect = "green_imbalance"
    unit, nominal, limits, needs = "%", 1.0, (0.02, 6.0), "bayer"

    def lit(self, electrons: Array, rate: Array) -> Array:
        cfa, out = str(self.cam.cfa), electrons.copy()
        greens = [k for k, c in enumerate(cfa) if c == "G"]
        for k, sign in zip(greens, (1, -1), strict=True):
            out[k // 2 :: 2, k % 2 :: 2] *= 1 + sign * self.s / 200.0
        return out


class DarkCurrentTemperature(Law):
    """Doubling with the temperature; Arrhenius's law. Strength: doublings in 10 degrees."""

    name = effect = "dark_current_temperature"
    variants, unit, nominal, limits, needs, shown_by = 2, "1/(10 C)", 1.3, (0.02, 3.0), "temperature", DARK

    def dark(self, rate: Array, temperature_c: float) -> Array:
        if self.v == 0:
            return rate * 2.0 ** (self.s * (temperature_c - 25.0) / 10.0)
        slope = self.s * np.log(2.0) / 10.0 * 298.15**2
        return rate * np.exp(slope * (1 / 298.15 - 1 / (273.15 + temperature_c)))

    def stated(self) -> dict[str, float]:
        return {"doublings_per_c": self.s / 10.0} if self.v == 0 else {}


class AmplifierGlow(Law):
    """Light of the output amplifier in a corner: exponential; a Lorentzian."""

    name = effect = "amplifier_glow"
    variants, unit, nominal, limits, shown_by = 2, "e/s", 20.0, (0.2, 400.0), DARK

    def dark(self, rate: Array, temperature_c: float) -> Array:
        x, y = self.cam.place
        r = np.hypot(x - np.sign(self.u[0] - 0.5) * 0.8, y - np.sign(self.u[1] - 0.5) * 0.6)
        return rate + self.s * (np.exp(-r / 0.3) if self.v == 0 else 1 / (1 + (r / 0.2) ** 2))


class HotPixels(Law):
    """A few pixels of high dark current: alike; lognormal."""

    name = effect = "hot_pixels"
    variants, unit, nominal, limits, shown_by = 2, "e/s", 150.0, (5.0, 3000.0), DARK

    def dark(self, rate: Array, temperature_c: float) -> Array:
        rng = self.rng(1)
        hot = rng.random((self.cam.rows, self.cam.cols)) < 5e-4
        hot[self.cam.rows // 3, self.cam.cols // 3] = True  # one at least
        size = 1.0 if self.v == 0 else rng.lognormal(-0.3, 0.8, hot.shape)
        return rate + np.where(hot, self.s * size, 0.0)


class ImageLag(Law):
    """A share of the last frame's charge; less of it the less there is."""

    name = effect = "image_lag"
    variants, unit, nominal, limits, shown_by = 2, "%", 0.5, (0.01, 5.0), frozenset({"dark", "flat"})

    def lag(self, previous: Array | None) -> Array:
        if previous is None:
            return 0.0
        share = self.s / 100.0
        return share * previous if self.v == 0 else share * previous * (previous / self.cam.full).clip(0, 1) ** 0.3

    def stated(self) -> dict[str, float]:
        return {"lag_percent": self.s} if self.v == 0 else {}


class BrighterFatter(Law):
    """Full pixels push charge away: the variance falls; the neighbours take what they push away (Antilogus 2014)."""

    name = effect = "brighter_fatter"
    variants, unit, nominal, limits = 2, "%", 4.0, (0.1, 20.0)

    def collected(self, electrons: Array, mean: Array) -> Array:
        x = np.clip(mean / self.cam.full, 0, 1)
        away = electrons - mean
        if self.v == 0:
            return mean + away * np.sqrt(1 - self.s / 100.0 * x)
        around = convolve(away, np.array([[0, 0.25, 0], [0.25, 0, 0.25], [0, 0.25, 0]]), mode="mirror")
        return mean + away + 0.5 * self.s / 100.0 * x * (around - away)

    def stated(self) -> dict[str, float]:
        return {"loss_percent": self.s} if self.v == 0 else {}


# --- electronics ------------------------------------------------------------------------------------------------------------


class Nonlinearity(Law):
    """Three bends: quadratic; hyperbolic tangent; a power."""

    name = effect = "nonlinearity"
    variants, unit, nominal, limits = 3, "%", 1.5, (0.01, 8.0)

    def respond(self, electrons: Array) -> Array:
        a, x = self.s / 100.0, electrons / self.cam.full
        if self.v == 0:
            return electrons * (1 - a * x)
        if self.v == 1:
            k = np.sqrt(3 * a)
            return np.where(x > 0, self.cam.full * np.tanh(k * x) / k, electrons)
        return electrons * np.clip(x, 1e-6, None) ** (-0.4 * a)

    def stated(self) -> dict[str, float]:
        return {"quadratic_percent": -self.s} if self.v == 0 else {}


class AdcNonlinearity(Law):
    """A wrong weight of the highest bit; of the two highest."""

    name = effect = "adc_nonlinearity"
    variants, unit, nominal, limits, signed = 2, "DN", 3.0, (0.05, 20.0), True

    def codes(self, dn: Array) -> Array:
        out = dn + self.a * (dn >= 2048)
        return out + (0.5 * self.a * ((dn % 2048) >= 1024) if self.v == 1 else 0.0)


class BlackLevelDrift(Law):
    """In proportion to the time; as a warm-up."""

    name = effect = "black_level_drift"
    variants, unit, nominal, limits, signed, shown_by = 2, "DN/min", 0.05, (0.002, 2.0), True, DARK

    def offset(self, elapsed_s: float, temperature_c: float) -> float:
        minutes = elapsed_s / 60.0
        return self.a * (minutes if self.v == 0 else 10.0 * (1 - np.exp(-minutes / 10.0)))

    def stated(self) -> dict[str, float]:
        return {"drift_dn_per_min": self.a} if self.v == 0 else {}


class BlackLevelTemperature(Law):
    """The black level follows the sensor's temperature."""

    name, effect = "black_level_temperature", "black_level_drift"
    unit, nominal, limits, signed, needs, shown_by = "DN/C", 0.2, (0.002, 5.0), True, "temperature", DARK

    def offset(self, elapsed_s: float, temperature_c: float) -> float:
        return self.a * (temperature_c - 25.0)

    def stated(self) -> dict[str, float]:
        return {"drift_dn_per_c": self.a}


class RowNoise(Law):
    """An offset a row, anew in each frame: white; alike in neighbouring rows."""

    name = effect = "row_noise"
    variants, unit, nominal, limits, power, shown_by = 2, "e", 2.0, (0.1, 30.0), 2.0, DARK

    def noise(self, shape: tuple[int, int], k: int) -> Array:
        white = self.rng(2, k).standard_normal(shape[0])
        if self.v == 1:
            for i in range(1, len(white)):
                white[i] = 0.6 * white[i - 1] + 0.8 * white[i]
        return self.s * white[:, None]

    def stated(self) -> dict[str, float]:
        return {"noise_e": self.s}


class ColumnNoise(Law):
    """A fixed offset a column: white; odd and even alike."""

    name = effect = "column_noise"
    variants, unit, nominal, limits, shown_by = 2, "e", 1.0, (0.02, 30.0), DARK

    def noise(self, shape: tuple[int, int], k: int) -> Array:
        white = self.rng(3).standard_normal(shape[1])
        return self.s * (white if self.v == 0 else 0.7 * white + 0.7 * (-1.0) ** np.arange(shape[1]))[None, :]


class RandomTelegraphNoise(Law):
    """Pixels that blink between two levels: alike; of exponential heights."""

    name = effect = "random_telegraph_noise"
    variants, unit, nominal, limits, power, shown_by = 2, "e", 15.0, (1.0, 200.0), 2.0, DARK

    def noise(self, shape: tuple[int, int], k: int) -> Array:
        still = self.rng(4)
        odd = still.random(shape) < 0.004
        size = self.s * (np.ones(shape) if self.v == 0 else still.exponential(0.7, shape))
        return np.where(odd, size * (self.rng(5, k).integers(0, 2, shape) - 0.5), 0.0)


class _Processing(Law):
    """A 3 x 3 filter of the converter's output, in the same colour."""

    variants, unit, nominal, limits, needs, shown_by = 2, "1", 0.1, (0.002, 0.6), "mono", OPTICAL
    direction: ClassVar[float]

    def processed(self, dn: Array) -> Array:
        cross = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]]) / 4.0
        box = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 16.0
        blurred = convolve(dn, cross if self.v == 0 else box, mode="mirror")
        return dn + self.direction * self.s * (dn - blurred)


class OnChipSharpening(_Processing):
    name = effect = "on_chip_sharpening"
    direction = 1.0


class OnChipSmoothing(_Processing):
    name = effect = "on_chip_smoothing"
    direction = -1.0


# --- rig --------------------------------------------------------------------------------------------------------------------


class SourceDrift(Law):
    """The lamp after its reading: in proportion to the time; as a warm-up."""

    name = effect = "source_drift"
    variants, unit, nominal, limits, signed = 2, "%/min", 0.15, (0.002, 3.0), True

    def source(self, elapsed_s: float) -> float:
        minutes = elapsed_s / 60.0
        return 1 + self.a / 100.0 * (minutes if self.v == 0 else 8.0 * (1 - np.exp(-minutes / 8.0)))

    def stated(self) -> dict[str, float]:
        return {"drift_percent_per_min": self.a} if self.v == 0 else {}


class StrayLight(Law):
    """Broadband light beside the monochromator's line: even; like its lamp."""

    name = effect = "stray_light"
    variants, unit, nominal, limits, shown_by = 2, "%", 0.4, (0.005, 6.0), SPECTRAL

    def radiance(self, radiance: Array, kind: str) -> Array:
        if kind != "narrowband":
            return radiance
        shape = np.ones_like(WL) if self.v == 0 else np.exp((WL - 560) / 250)
        return (1 - self.s / 100) * radiance + self.s / 100 * radiance.sum() * shape / shape.sum()

    def stated(self) -> dict[str, float]:
        return {"share_percent": self.s} if self.v == 0 else {}


class SourceBandwidth(Law):
    """The line is wider than read: by a Gaussian; by a triangle. Strength: standard deviation of what was added."""

    name = effect = "source_bandwidth"
    variants, unit, nominal, limits, power, shown_by = 2, "nm", 4.0, (0.3, 15.0), 2.0, SPECTRAL

    def radiance(self, radiance: Array, kind: str) -> Array:
        if kind != "narrowband":
            return radiance
        away = np.arange(-60.0, 61.0)
        kernel = (
            np.exp(-0.5 * (away / self.s) ** 2)
            if self.v == 0
            else np.clip(1 - np.abs(away) / (self.s * 6**0.5), 0, None)
        )
        return np.convolve(radiance, kernel / kernel.sum(), mode="same")

    def stated(self) -> dict[str, float]:
        return {"width_nm": self.s}


class WavelengthOffset(Law):
    """The monochromator and its reading are off together: by a constant; by a stretch about 560 nm."""

    name = effect = "wavelength_offset"
    variants, unit, nominal, limits, signed, shown_by = 2, "nm", 1.0, (0.02, 8.0), True, SPECTRAL

    def radiance(self, radiance: Array, kind: str) -> Array:
        if kind != "narrowband":
            return radiance
        off = self.a * (1.0 if self.v == 0 else (WL - 300.0) / 260.0)
        return np.interp(WL - off, WL, radiance)

    def stated(self) -> dict[str, float]:
        return {"offset_nm": self.a} if self.v == 0 else {}


class RadiometerNonlinearity(Law):
    """The radiometer reads strong light low: what arrives is more than it says, in proportion; by a power."""

    name = effect = "radiometer_nonlinearity"
    variants, unit, nominal, limits, shown_by = 2, "%", 2.0, (0.1, 15.0), SPECTRAL

    def radiance(self, radiance: Array, kind: str) -> Array:
        if kind != "narrowband":
            return radiance
        level = radiance.max() / 0.004
        return radiance * (1 + self.s / 100 * level if self.v == 0 else level ** (self.s / 100))


class LightFlicker(Law):
    """The lamp at 100 Hz under a rolling shutter: a sine; a rectified one."""

    name = effect = "light_flicker"
    variants, unit, nominal, limits = 2, "%", 10.0, (0.1, 90.0)

    def rows(self, count: int, exposure_s: float, k: int) -> Array:
        start = self.rng(6, k).random() / 100.0
        t = start + np.arange(count)[:, None] * 60e-6 + exposure_s * (np.arange(64)[None, :] + 0.5) / 64
        phase = 2 * np.pi * 100.0 * t
        wave = np.sin(phase) if self.v == 0 else np.pi / 2 * np.abs(np.sin(phase / 2)) - 1
        return 1 + self.s / 100 * wave.mean(1)[:, None]


class ExposureOffset(Law):
    """Light is collected longer than asked."""

    name = effect = "exposure_offset"
    variants, unit, nominal, limits = 1, "us", 30.0, (0.2, 2000.0)

    def exposure(self, exposure_s: float) -> float:
        return exposure_s + self.s * 1e-6

    def stated(self) -> dict[str, float]:
        return {"offset_us": self.s}


class NonUniformIllumination(Law):
    """A slope across the field; with a bow."""

    name = effect = "non_uniform_illumination"
    variants, unit, nominal, limits = 2, "%", 1.5, (0.02, 15.0)

    def shade(self, x: Array, y: Array) -> Array:
        t = 2 * np.pi * self.u[0]
        along = (x / np.abs(x).max()) * np.cos(t) + (y / np.abs(y).max()) * np.sin(t)
        return 1 + self.s / 100 * (along + (0.2 * along**2 if self.v == 1 else 0.0))

    def stated(self) -> dict[str, float]:
        t = 2 * np.pi * self.u[0]
        return (
            {"gradient_x_percent": self.s * np.cos(t), "gradient_y_percent": self.s * np.sin(t)} if self.v == 0 else {}
        )


class ScreenPixelStructure(Law):
    """The screen's own grid of pixels, seen through the lens."""

    name = effect = "screen_pixel_structure"
    unit, nominal, limits, shown_by = "%", 20.0, (1.0, 90.0), frozenset({"checkerboard"})

    def screen(self, fine: Array, row: Array, col: Array) -> Array:
        period = 2.5 + 2.0 * self.u[0]
        return fine * (1 + self.s / 100 * np.cos(2 * np.pi * col / period) * np.cos(2 * np.pi * row / period))


class ScreenGamma(Law):
    """Greys at cells' rims are shown darker: a power on rims as narrow as drawn; on rims of a pixel; above an offset."""

    name = effect = "screen_gamma"
    variants, unit, nominal, limits, shown_by = 3, "1", 1.2, (0.01, 4.0), frozenset({"checkerboard"})

    def screen(self, fine: Array, row: Array, col: Array) -> Array:
        asked = gaussian_filter(fine, 1.6, mode="nearest") if self.v == 1 else fine
        asked = np.clip(asked, 0.0, 1.0)
        if self.v == 2:
            return np.clip((asked - 0.05) / 0.95, 0.0, 1.0) ** (1 + self.s)
        return asked ** (1 + self.s)


class LateralColour(Law):
    """Colours at other scales: in proportion to the wavelength; by Conrady's dispersion; with a third of it as the cube of the radius."""

    name = effect = "lateral_chromatic_aberration"
    variants, unit, nominal, limits, signed, needs = 3, "um", 1.5, (0.02, 20.0), True, "bayer"
    shown_by = frozenset({"checkerboard"})

    def lands(self, x: Array, y: Array, lam_nm: float) -> tuple[Array, Array]:
        t = (lam_nm - REFERENCE_NM) / 100.0
        if self.v == 1:
            t = 2.3 * (1.0 - (REFERENCE_NM / lam_nm) ** 3.5) / 1.5
        out = self.a * t / self.cam.pitch * (1.0 if self.v < 2 else (2.0 + x * x + y * y) / 3.0)
        return out * x, out * y

    def stated(self) -> dict[str, float]:
        return {"slope_um": self.a} if self.v == 0 else {}


class LensDistortion(Law):
    """The image's scale changes with the radius since the calibration: as its cube; as its fifth power."""

    name = effect = "distortion"
    variants, unit, nominal, limits, signed, shown_by = 2, "%", 0.5, (0.005, 10.0), True, frozenset({"charuco"})

    def lands(self, x: Array, y: Array, lam_nm: float) -> tuple[Array, Array]:
        r2 = x * x + y * y
        out = self.a / 100.0 * 0.5 * float(np.hypot(self.cam.rows, self.cam.cols)) * (r2 if self.v == 0 else r2 * r2)
        return out * x, out * y

    def stated(self) -> dict[str, float]:
        return {"corner_percent": self.a} if self.v == 0 else {}


class LensDecentre(Law):
    """An element slips sideways: Brown's tangential distortion; a thin prism's."""

    name = effect = "decentre"
    variants, unit, nominal, limits, shown_by = 2, "um", 2.0, (0.02, 40.0), frozenset({"charuco"})

    def lands(self, x: Array, y: Array, lam_nm: float) -> tuple[Array, Array]:
        t = 2.0 * np.pi * self.u[0]
        a, b = (self.s / self.cam.pitch * v for v in (np.cos(t), np.sin(t)))
        if self.v == 1:
            return a * (x * x + y * y), b * (x * x + y * y)
        return a * (3 * x * x + y * y) + 2 * b * x * y, b * (x * x + 3 * y * y) + 2 * a * x * y


class StereoGain(Law):
    """One camera of a pair answers scenes more strongly than uniform light."""

    name = effect = "stereo_gain_mismatch"
    unit, nominal, limits, signed, shown_by = "%", 6.0, (0.1, 50.0), True, frozenset({"charuco"})

    def scene(self, kind: str) -> float:
        return 1.0 if kind in {"flat", "narrowband"} else 1.0 + self.a / 100.0

    def stated(self) -> dict[str, float]:
        return {"gain_percent": self.a}


class AmbientLight(Law):
    """The room's light while the shutter is open: grey; reddish."""

    name = effect = "ambient_light"
    variants, unit, nominal, limits = 2, "e/s", 100.0, (0.2, 3e5)

    def ambient(self, channel: str) -> float:
        return self.s * ({"R": 1.6, "G": 1.0, "B": 0.5, "Y": 1.0}[channel] if self.v == 1 else 1.0)

    def stated(self) -> dict[str, float]:
        return {"rate_e_per_s": self.s} if self.v == 0 else {}


LISTED: tuple[type[Law], ...] = (
    OpticalLowPassFilter, Defocus, SphericalAberration, Astigmatism, Coma, AxialColour, VeilingGlare, Ghost, Vignetting,
    VignettingDecentre, InfraredCutFilter, VibrationBlur, PixelAperture, ChargeDiffusion, Crosstalk, GreenImbalance,
    DarkCurrentTemperature, AmplifierGlow, HotPixels, ImageLag, BrighterFatter, Nonlinearity, AdcNonlinearity, BlackLevelDrift, BlackLevelTemperature,
    RowNoise, ColumnNoise, RandomTelegraphNoise, OnChipSharpening, OnChipSmoothing, SourceDrift, StrayLight, SourceBandwidth,
    WavelengthOffset, RadiometerNonlinearity, LightFlicker, ExposureOffset, NonUniformIllumination, ScreenPixelStructure, ScreenGamma, LateralColour, AmbientLight,
)  # fmt: skip

#: Of the list too, but to be seen only beside an earlier calibration or a second camera: a challenge of single cameras has neither.
BESIDE: tuple[type[Law], ...] = (LensDistortion, LensDecentre, StereoGain)


# --- kinds that no list names, siblings of listed ones among them -----------------------------------------------------------


class CoverGlassFringe(Law):
    """Interference in a plate: T = 1 + m cos(2 pi (2 n t) / wavelength), mild enough for 1 nm steps."""

    name, unit, nominal, limits, shown_by = "cover_glass_fringe", "%", 2.0, (0.05, 20.0), SPECTRAL

    def transmission(self, channel: str) -> Array:
        return 1 + self.s / 100 * np.cos(2 * np.pi * (14000.0 + 8000.0 * self.u[0]) / WL)


class AbsorptionBand(Law):
    """A dye or a rare earth in the glass: a dip in the middle of the spectrum (a sibling of the infrared filter)."""

    name, unit, nominal, limits, shown_by = "absorption_band", "%", 10.0, (0.2, 70.0), SPECTRAL

    def transmission(self, channel: str) -> Array:
        return 1 - self.s / 100 * np.exp(-0.5 * ((WL - 480.0 - 120.0 * self.u[0]) / (8.0 + 10.0 * self.u[1])) ** 2)


class RedLeak(Law):
    """One colour filter lets long wavelengths through again."""

    name, unit, nominal, limits, shown_by = "red_leak", "%", 8.0, (0.1, 60.0), SPECTRAL

    def transmission(self, channel: str) -> Array:
        if channel not in {"B", "Y"}:
            return 1.0
        return 1 + self.s / 10.0 / (1 + np.exp(-(WL - 640.0) / 8.0))


class PolarisedLight(Law):
    """Past an anomaly of the grating the light is polarised, and the camera answers otherwise: a step by wavelength."""

    name, unit, nominal, limits, shown_by = "polarised_light", "%", 3.0, (0.05, 20.0), SPECTRAL

    def radiance(self, radiance: Array, kind: str) -> Array:
        at = 500.0 + 100.0 * self.u[0]
        return radiance * (1 + self.s / 100 / (1 + np.exp(-(WL - at) / 2.0))) if kind == "narrowband" else radiance


class TapGain(Law):
    name, unit, nominal, limits = "tap_gain", "%", 1.0, (0.02, 8.0)

    def lit(self, electrons: Array, rate: Array) -> Array:
        out = electrons.copy()
        out[:, out.shape[1] // 2 :] *= 1 + self.s / 100
        return out


class PeriodicBanding(Law):
    """Rows that pick up a ripple of fixed period and wandering phase (a sibling of row noise)."""

    name, unit, nominal, limits, power, shown_by = "periodic_banding", "e", 3.0, (0.1, 40.0), 2.0, DARK

    def noise(self, shape: tuple[int, int], k: int) -> Array:
        phase = self.rng(7, k).random()
        return self.s * np.sin(2 * np.pi * (np.arange(shape[0]) / (6.0 + 10.0 * self.u[0]) + phase))[:, None]


class TapOffset(Law):
    """The right half is read by another amplifier, with another black level."""

    name, unit, nominal, limits, shown_by = "tap_offset", "e", 1.0, (0.02, 30.0), DARK

    def noise(self, shape: tuple[int, int], k: int) -> Array:
        return np.where(np.arange(shape[1]) < shape[1] // 2, 0.0, self.s)[None, :] * np.ones((shape[0], 1))


class LightLeak(Law):
    """Light finds its way past the cap, most of it about one place inside the frame (a sibling of the amplifier's glow)."""

    name, unit, nominal, limits, shown_by = "light_leak", "e/s", 5.0, (0.05, 400.0), DARK

    def dark(self, rate: Array, temperature_c: float) -> Array:
        x, y = self.cam.place
        r2 = (x - 0.8 * (self.u[0] - 0.5)) ** 2 + (y - 0.6 * (self.u[1] - 0.5)) ** 2
        return rate + self.s * np.exp(-0.5 * r2 / 0.3**2)


class TreeRings(Law):
    """Rings of doping in the wafer: the response ripples with the distance from a far centre."""

    name, unit, nominal, limits = "tree_rings", "%", 1.0, (0.02, 10.0)

    def shade(self, x: Array, y: Array) -> Array:
        return 1 + self.s / 100 * np.cos(2 * np.pi * (1.5 + 2.0 * self.u[0]) * np.hypot(x + 1.2, y + 0.9) ** 1.5)


class PulsedLight(Law):
    """A lamp dimmed by pulses of 2 kHz under a rolling shutter (a sibling of flicker)."""

    name, unit, nominal, limits = "pulsed_light", "%", 60.0, (5.0, 95.0)

    def rows(self, count: int, exposure_s: float, k: int) -> Array:
        on, period = 1 - self.s / 100, 5e-4
        start = self.rng(8, k).random() * period + np.arange(count)[:, None] * 60e-6

        def lit(t: Array) -> Array:
            return np.floor(t / period) * on + np.minimum(t / period % 1.0, on)

        return (lit(start + exposure_s) - lit(start)) * period / exposure_s / on


class ResponseTail(Law):
    """Pixels of low response beside the normal spread: lognormal shadows of dust on the sensor."""

    name, unit, nominal, limits = "response_tail", "%", 2.0, (0.05, 20.0)

    def shade(self, x: Array, y: Array) -> Array:
        return 1 - np.where(
            self.rng(9).random(np.shape(x)) < 0.02, self.s / 100 * self.rng(10).lognormal(0, 0.7, np.shape(x)), 0
        )


class CompandingKnee(Law):
    """A broken line in place of a bend (a sibling of nonlinearity)."""

    name, unit, nominal, limits = "companding_knee", "%", 3.0, (0.05, 20.0)

    def respond(self, electrons: Array) -> Array:
        knee = (0.3 + 0.3 * self.u[0]) * self.cam.full
        return electrons - self.s / 100 * np.maximum(electrons - knee, 0)


class DefectInterpolation(Law):
    """Pixels replaced by the mean of their neighbours in the row: their noise shrinks, edges break."""

    name, unit, nominal, limits = "defect_interpolation", "%", 5.0, (0.1, 60.0)

    def processed(self, dn: Array) -> Array:
        odd = self.rng(11).random(dn.shape) < self.s / 100
        step = 1 if self.cam.cfa == "MONO" else 2
        padded = np.pad(dn, [(0, 0), (step, step)], mode="reflect")
        return np.where(odd, 0.5 * (padded[:, : -2 * step] + padded[:, 2 * step :]), dn)


class DigitalGain(Law):
    """Codes multiplied after the converter: some come twice as often or never (a sibling of converters' nonlinearity)."""

    name, unit, nominal, limits = "digital_gain", "%", 10.0, (1.0, 60.0)

    def processed(self, dn: Array) -> Array:
        black = self.cam.black
        return np.floor(black + (np.round(dn) - black) * (1 + self.s / 100))


class LossyCodes(Law):
    """Codes kept in equal steps of their root, as compression with losses does."""

    name, unit, nominal, limits = "lossy_codes", "1", 0.05, (0.003, 0.5)

    def processed(self, dn: Array) -> Array:
        return np.square(np.round(np.sqrt(np.clip(dn, 0, None)) / self.s) * self.s)


class LeakyShutter(Law):
    """Light goes on being collected while rows wait to be read: more of it the later the row (a sibling of exposure_offset)."""

    name, unit, nominal, limits = "leaky_shutter", "us", 60.0, (0.5, 5000.0)

    def lit(self, electrons: Array, rate: Array) -> Array:
        return electrons + rate * self.s * 1e-6 * (np.arange(len(electrons)) / len(electrons))[:, None]


class DoubleImage(Law):
    """A second image two and a half pixels aside, of a plate with two faces."""

    name, unit, nominal, limits, shown_by = "double_image", "%", 3.0, (0.1, 25.0), OPTICAL

    def grey(self, fx: Array, fy: Array) -> Array:
        r = self.s / 100
        return (1 - r) + r * np.exp(2j * np.pi * fx * 2.5 * self.cam.pitch)


class Motion(Law):
    """Even motion along a direction, a box and no oscillation (a sibling of vibration)."""

    name, unit, nominal, limits, power, shown_by = "motion", "um", 2.0, (0.1, 8.0), 2.0, OPTICAL
    accepts = frozenset({"vibration_blur"})

    def grey(self, fx: Array, fy: Array) -> Array:
        t = np.pi * (self.u[0] - 0.5)
        return np.sinc(self.s * (fx * np.cos(t) + fy * np.sin(t)))


class Trefoil(Law):
    name, unit, nominal, limits, power, shown_by = "trefoil", "um", 0.2, (0.02, 1.5), 2.0, OPTICAL

    def wavefront(self, x: Array, y: Array, lam_nm: float) -> Array:
        return self.s * (x**3 - 3 * x * y * y)


class Halo(Law):
    """Scatter in the cover glass: an exponential skirt of some pixels (a sibling of diffusion and of glare)."""

    name, unit, nominal, limits, shown_by = "halo", "%", 3.0, (0.05, 30.0), OPTICAL

    def mono(self, f_cy_um: Array, lam_um: float) -> Array:
        r = (2.0 + 4.0 * self.u[0]) * self.cam.pitch
        return 1 - self.s / 100 + self.s / 100 / (1 + (2 * np.pi * r * f_cy_um) ** 2) ** 1.5


class InterPixelCapacitance(Law):
    """Neighbours share voltages after the noise was made (a sibling of crosstalk)."""

    name, unit, nominal, limits = "inter_pixel_capacitance", "%", 0.8, (0.02, 6.0)
    accepts = frozenset({"crosstalk", "inter_pixel_capacitance"})

    def collected(self, electrons: Array, mean: Array) -> Array:
        c = self.s / 100
        return convolve(electrons, np.array([[0, c, 0], [c, 1 - 4 * c, c], [0, c, 0]]), mode="mirror")


class PinkNoise(Law):
    """1/f noise along the read-out (a sibling of row noise)."""

    name, unit, nominal, limits, power, shown_by = "pink_noise", "e", 3.0, (0.2, 40.0), 2.0, DARK
    accepts = frozenset({"row_noise"})

    def noise(self, shape: tuple[int, int], k: int) -> Array:
        n = shape[0] * shape[1]
        f = np.fft.rfftfreq(n)
        f[0] = 1.0
        wave = np.fft.irfft(np.fft.rfft(self.rng(12, k).standard_normal(n)) / np.sqrt(f), n)
        return (self.s * (wave - wave.mean()) / wave.std()).reshape(shape)


class DustShadow(Law):
    """A mote far in front of the sensor: a soft round shadow off the centre (a sibling of vignetting)."""

    name, unit, nominal, limits = "dust_shadow", "%", 2.0, (0.05, 25.0)

    def shade(self, x: Array, y: Array) -> Array:
        r = np.hypot(x - 0.8 * (self.u[0] - 0.5), y - 0.6 * (self.u[1] - 0.5))
        return 1 - self.s / 100 / (1 + np.exp((r - 0.18) / 0.03))


class LampJump(Law):
    """The lamp's arc moves once (a sibling of drift)."""

    name, unit, nominal, limits, signed = "lamp_jump", "%", 1.0, (0.01, 10.0), True

    def source(self, elapsed_s: float) -> float:
        return 1 + self.a / 100 * (elapsed_s > 60.0 * (5.0 + 12.0 * self.u[0]))


class Smear(Law):
    """Charge that is shifted through light: every column picks up a share of its own sum."""

    name, unit, nominal, limits = "smear", "%", 0.5, (0.01, 5.0)
    shown_by = frozenset({"chart", "checkerboard"})

    def lit(self, electrons: Array, rate: Array) -> Array:
        return electrons + self.s / 100 * electrons.mean(0, keepdims=True)


class JitteredRows(Law):
    """A shift of every other row's picture by part of a pixel, as a faulty sensor's timing leaves it."""

    name, unit, nominal, limits, power, needs, shown_by = "jittered_rows", "px", 0.3, (0.05, 1.0), 2.0, "mono", OPTICAL

    def image(self, image: Array) -> Array:
        out = image.copy()
        out[1::2] = shift(image, (0.0, self.s), order=3, mode="nearest")[1::2]
        return out


OUTSIDE: tuple[type[Law], ...] = (
    CoverGlassFringe, AbsorptionBand, RedLeak, PolarisedLight, TapGain, TapOffset, LightLeak, PeriodicBanding, TreeRings, PulsedLight, ResponseTail,
    CompandingKnee, DefectInterpolation, DigitalGain, LossyCodes, LeakyShutter, DoubleImage, Motion, Trefoil, Halo, InterPixelCapacitance, PinkNoise,
    DustShadow, LampJump, Smear, JitteredRows,
)  # fmt: skip
