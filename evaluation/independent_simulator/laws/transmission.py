"""Laws of the lens that change how much light arrives: filters, vignetting, glare and ghosts."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.special import erfc

from evaluation.independent_simulator.law import SPECTRAL, WAVELENGTH_NM, Array, Law


class InfraredCutFilterLaw(Law):
    """A cut-off at (720 - strength) nm. Variants of the edge: logistic; error function; power of the wavelength."""

    name = effect = "infrared_cut_filter"
    variants, unit, nominal, limits, shown_by = 3, "nm", 55.0, (4.0, 110.0), SPECTRAL

    @property
    def cut(self) -> float:
        return 720.0 - self.strength

    def transmittance(self, channel: str) -> Array:
        if self.variant == 0:
            return 1.0 / (1.0 + np.exp((WAVELENGTH_NM - self.cut) / 6.0))
        if self.variant == 1:
            return 0.5 * erfc((WAVELENGTH_NM - self.cut) / (np.sqrt(2.0) * 10.0))
        return 0.97 / (1.0 + (WAVELENGTH_NM / self.cut) ** 120)

    def library_parameters(self) -> dict[str, float]:
        return {"cut_wavelength_nm": self.cut}


class CoverGlassFringeLaw(Law):
    """Interference in a plate, slow enough for steps of 1 nm. Variants: T = 1 + m cos(2 pi (2 n t) / wavelength); an
    etalon's, by the sum of all reflections (Airy), with the loss of the mean in the quantum efficiency."""

    name, effect = "cover_glass_fringe", "fringes"
    variants, unit, nominal, limits, shown_by = 2, "%", 2.0, (0.05, 20.0), SPECTRAL

    @property
    def _path_nm(self) -> float:
        return 14000.0 + 8000.0 * float(self.uniform[0])

    def transmittance(self, channel: str) -> Array:
        depth = self.strength / 100
        if self.variant == 0:
            return 1 + depth * np.cos(2 * np.pi * self._path_nm / WAVELENGTH_NM)
        finesse = 2 * depth / (1 - depth)
        passed = 1 / (1 + finesse * np.sin(np.pi * self._path_nm / WAVELENGTH_NM) ** 2)
        return passed * np.sqrt(1 + finesse)

    def library_parameters(self) -> dict[str, float]:
        return {"cos_percent": self.strength, "optical_thickness_um": self._path_nm / 2000.0}


class AbsorptionBandLaw(Law):
    """A dye or a rare earth in the glass absorbs a Gaussian band (related to the infrared cut filter)."""

    name, unit, nominal, limits, shown_by = "absorption_band", "%", 10.0, (0.2, 70.0), SPECTRAL
    families = frozenset({"spectral_filter"})

    def transmittance(self, channel: str) -> Array:
        return 1 - self.strength / 100 * np.exp(
            -0.5 * ((WAVELENGTH_NM - 480.0 - 120.0 * self.uniform[0]) / (8.0 + 10.0 * self.uniform[1])) ** 2
        )


class RedLeakLaw(Law):
    """One colour filter transmits long wavelengths again."""

    name, unit, nominal, limits, shown_by = "red_leak", "%", 8.0, (0.1, 60.0), SPECTRAL
    families = frozenset({"spectral_filter"})

    def transmittance(self, channel: str) -> Array:
        if channel not in {"B", "Y"}:
            return 1.0
        return 1 + self.strength / 10.0 / (1 + np.exp(-(WAVELENGTH_NM - 640.0) / 8.0))


class VignettingLaw(Law):
    """Fall-off towards the corners. Variants: squared radius; overlap of two displaced discs; fourth power of the
    radius."""

    name = effect = "vignetting"
    variants, unit, nominal, limits = 3, "%", 4.0, (0.02, 30.0)

    def relative_response(self, x: Array, y: Array) -> Array:
        r2 = x * x + y * y
        if self.variant == 1:
            d = np.clip(0.5 * np.sqrt(r2) * self.strength / 64.0, 0, 1)
            return 2.0 / np.pi * (np.arccos(d) - d * np.sqrt(1.0 - d * d))
        return 1.0 - self.strength / 100.0 * (r2 if self.variant == 0 else r2 * r2)

    def library_parameters(self) -> dict[str, float]:
        return {"corner_loss_percent": self.strength} if self.variant == 0 else {}


class VignettingDecentreLaw(Law):
    """A fall-off of 8 % about a displaced centre, further off than an optical axis may lie. Variants: squared radius;
    third power."""

    name = effect = "vignetting_decentre"
    accepts = frozenset({"vignetting"})
    variants, unit, nominal, limits = 2, "1", 0.3, (0.15, 0.8)

    def relative_response(self, x: Array, y: Array) -> Array:
        t = 2 * np.pi * self.uniform[0]
        r2 = (x - self.strength * np.cos(t)) ** 2 + (y - self.strength * np.sin(t)) ** 2
        return 1.0 - 0.08 * (r2 if self.variant == 0 else r2 * np.sqrt(r2))


class DustShadowLaw(Law):
    """A dust particle far in front of the sensor: a soft round shadow off the centre (related to vignetting)."""

    name, unit, nominal, limits = "dust_shadow", "%", 2.0, (0.05, 25.0)
    families = frozenset({"field_of_light"})

    def relative_response(self, x: Array, y: Array) -> Array:
        r = np.hypot(x - 0.8 * (self.uniform[0] - 0.5), y - 0.6 * (self.uniform[1] - 0.5))
        return 1 - self.strength / 100 / (1 + np.exp((r - 0.18) / 0.03))


class VeilingGlareLaw(Law):
    """A share of the light spread over the frame. Variants: evenly; half of it in a Gaussian of a quarter of the
    frame's width; falling towards the corners."""

    name = effect = "veiling_glare"
    variants, unit, nominal, limits, shown_by = 3, "%", 1.5, (0.02, 8.0), frozenset({"chart", "checkerboard"})

    def image(self, image: Array) -> Array:
        g, mean = self.strength / 100.0, image.mean()
        if self.variant == 1:
            mean = 0.5 * (mean + gaussian_filter(image, 0.25 * image.shape[1], mode="nearest"))
        elif self.variant == 2:
            x, y = self.camera.field_position
            mean = mean * (1.1 - 0.2 * np.hypot(x, y) ** 2) / (1.1 - 0.2 * np.mean(np.hypot(x, y) ** 2))
        return (1 - g) * image + g * mean

    def library_parameters(self) -> dict[str, float]:
        return {"share_percent": self.strength} if self.variant == 0 else {}


class GhostLaw(Law):
    """An image rotated by 180 degrees about the axis is added. Variants: sharp; blurred by 4 px."""

    name = effect = "ghost"
    variants, unit, nominal, limits, shown_by = 2, "%", 1.0, (0.02, 5.0), frozenset({"chart", "checkerboard"})

    def image(self, image: Array) -> Array:
        copy = image[::-1, ::-1]
        copy = gaussian_filter(copy, 4.0, mode="nearest") if self.variant == 1 else copy
        return image + self.strength / 100.0 * copy


class MicrolensAngleLaw(Law):
    """Microlenses for other chief rays than the lens's: light misses its diode, and 45 % of that falls on the next one
    outwards. Variants: along rows and columns in proportion to the squares of the place; by a spot of normal profile
    that leaves a square diode, wider in red; towards the nearer axis alone."""

    name = effect = "microlens_angle"
    variants, unit, nominal, limits, needs = 3, "%", 6.0, (0.1, 60.0), "bayer"
    kept = 0.45

    def _missing(self, channel: str) -> tuple[Array, Array]:
        """Shares of the light that miss their diode along rows and along columns, `strength` in the corner for
        green."""
        x, y = np.abs(self.camera.field_position)
        if self.variant == 2:
            r2, beside = x * x + y * y, x > y
            return self.strength / 100 * r2 * beside, self.strength / 100 * r2 * ~beside
        if self.variant == 0:
            return self.strength / 100 * x * x, self.strength / 100 * y * y

        def outside(off: Array, spot: float) -> Array:  # of a diode of half a side 2.2 spots
            return 0.5 * (erfc((2.2 - off) / spot / 2**0.5) + erfc((2.2 + off) / spot / 2**0.5)) - erfc(
                2.2 / spot / 2**0.5
            )

        spot = {"R": 1.04, "G": 1.0, "B": 0.97}[channel]
        whole = outside(x.max(), 1.0) + outside(y.max(), 1.0)
        return self.strength / 100 * outside(x, spot) / whole, self.strength / 100 * outside(y, spot) / whole

    def colours(self, images: dict[str, Array]) -> dict[str, Array]:
        along, down = ({c: self._missing(c)[axis] * image for c, image in images.items()} for axis in (0, 1))
        red_row = (np.arange(self.camera.rows) % 2 == self.camera.cfa.index("R") // 2)[:, None]
        inner = {c: (self._from_inside(along[c], 1), self._from_inside(down[c], 0)) for c in images}
        green = inner["G"][0] + inner["G"][1]
        red_rows, blue_rows = inner["R"][0] + inner["B"][1], inner["B"][0] + inner["R"][1]
        found = {"R": green, "B": green, "G": np.where(red_row, red_rows, blue_rows)}
        return {c: image - along[c] - down[c] + self.kept * found[c] for c, image in images.items()}

    def _from_inside(self, light: Array, axis: int) -> Array:
        """Return the light of the next pixel towards the centre along an axis."""
        ahead, behind = (np.roll(light, step, axis=axis) for step in (1, -1))
        return np.where(self.camera.field_position[1 - axis] > 0, ahead, behind)

    def library_parameters(self) -> dict[str, float]:
        if self.variant != 0:
            return {}
        loss = (1 - self.kept) * self.strength  # of which the rest is a share, in the corner
        return {"crosstalk_percent": self.kept * self.strength / (1 - loss / 100), "loss_percent": loss}
