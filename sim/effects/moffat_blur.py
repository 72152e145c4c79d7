"""Moffat blur: light spreads into wings that fall as a power of the distance."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np
from scipy.special import gamma, kv

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Image


class MoffatBlur(Effect):
    """A share s of the light has the point spread (b - 1) / (pi a^2) (1 + r^2 / a^2)^-b, a the radius and b the
    exponent; the rest stays in focus. The transfer factor is

        1 - s + s 2 (x / 2)^(b - 1) K_(b-1)(x) / Gamma(b - 1),    x = 2 pi a f,

    K the modified Bessel function of the second kind: exp(-x) for b = 3/2, a Gaussian for large b. With all of the
    light and b of 2.5 to 4.8 it is a turbulent air's blur, with a small share the halo of scatter in a lens or behind a
    thin sensor.
    """

    name: ClassVar[str] = "moffat_blur"
    title: ClassVar[str] = "Moffat blur"
    family: ClassVar[Family] = Family.ISOTROPIC_CONTRAST
    reference: ClassVar[str] = "A. Moffat, Astron. Astrophys. 3, 455 (1969); I. Trujillo et al., MNRAS 328, 977 (2001)"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset(
        {"f_number", "exposure", "wavelength", "field", "level", "orientation", "time"}
    )
    shapes: ClassVar[frozenset[str]] = frozenset({"share_percent", "exponent"})
    sentence: ClassVar[str] = (
        "Light spreads into wide wings about each point: coarse detail loses contrast already, alike in all directions "
        "and colours, and light reaches far into the dark."
    )

    radius_um: Annotated[
        float,
        Quantity("um", "radius a of the spread's core", lower=0.0, upper=100.0, prior=(0.0, 1.0), absent=0.0),
    ] = 0.0
    share_percent: Annotated[
        float,
        Quantity("%", "share of the light that is spread", lower=0.0, upper=100.0, absent=100.0, dispensable=True),
    ] = 100.0
    exponent: Annotated[
        float,
        Quantity("1", "power b of the spread's wings, r^-2b", lower=1.25, upper=5.0, absent=1.5),
    ] = 1.5

    def log_prior(self) -> float:
        """Return -ln 10: few cameras look through turbulent air, or scatter more than a veil's worth."""
        return -float(np.log(10.0)) if self.radius_um else 0.0

    @classmethod
    def limits(cls, camera: CameraModel) -> dict[str, tuple[float, float]]:
        """A wider core's light is a veil to detail of some pixels (`veiling_glare`)."""
        return {"radius_um": (0.0, min(100.0, 3.0 * camera.pixel_pitch_um))}

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        pitch_um = camera.pixel_pitch_um
        return (
            (cls(radius_um=0.02 * pitch_um),),
            (cls(radius_um=0.2 * pitch_um, exponent=2.5),),
            (cls(radius_um=1.0 * pitch_um, share_percent=2.0, exponent=1.5),),
            (cls(radius_um=2.5 * pitch_um, share_percent=2.0, exponent=2.5),),
        )

    def on_image(self, image: Image) -> Image:
        share = self.share_percent / 100.0
        if self.radius_um == 0.0 or share == 0.0:
            return image

        def transfer(fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float) -> FloatArray:
            x = 2.0 * np.pi * self.radius_um * np.hypot(fx_cy_per_um, fy_cy_per_um)
            order, apart = self.exponent - 1.0, np.maximum(x, 1e-6)
            kept = 2.0 * (0.5 * apart) ** order * kv(order, apart) / gamma(order)
            return np.asarray(1.0 - share + share * np.where(x > 1e-6, kept, 1.0))

        return image.add_laws(transfer=transfer)
