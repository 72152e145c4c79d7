"""Crosstalk: a share of each pixel's charge ends up in its four neighbours."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from scipy.ndimage import convolve

from sim.camera import CameraModel
from sim.effects.base import Effect, Stage
from sim.parameters import Quantity
from sim.spectrum import FloatArray


class Crosstalk(Effect):
    """Kernel (c; c, 1 - 4 c, c; c): colours mix in uniform light, OTF factor 1 - 2 c (2 - cos 2 pi fx p - cos 2 pi fy p)."""

    name: ClassVar[str] = "crosstalk"
    stage: ClassVar[Stage] = Stage.CHARGE
    reference: ClassVar[str] = "K. Hirakawa, Cross-talk explained, ICIP 2008"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "level", "time", "field"})
    shown_by: ClassVar[frozenset[str]] = frozenset({"narrowband", "chart", "slanted_edge", "bernoulli"})
    rivals: ClassVar[frozenset[str]] = frozenset(
        {
            "charge_diffusion",
            "defocus",
            "optical_low_pass_filter",
            "pixel_aperture",
            "spherical_aberration",
            "vibration_blur",
            "stray_light",
        }
    )
    sentence: ClassVar[str] = (
        "Charge or light leaks into neighbouring pixels: each colour answers where only its neighbours should, and contrast falls."
    )

    share_percent: Annotated[
        float,
        Quantity(
            "%",
            "share of the charge that goes to each of the four neighbours",
            lower=0.0,
            upper=20.0,
            prior=(0.0, 1.5),
            absent=0.0,
            slope_power=1,
        ),
    ] = 0.0

    def transfer(
        self, fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float, camera: CameraModel
    ) -> FloatArray | None:
        if self.share_percent == 0.0:
            return None
        c, p = self.share_percent / 100.0, camera.pixel_pitch_um
        return np.asarray(
            1.0 - 2.0 * c * (2.0 - np.cos(2.0 * np.pi * fx_cy_per_um * p) - np.cos(2.0 * np.pi * fy_cy_per_um * p))
        )

    def charge(self, electrons: FloatArray, exposure_s: float, camera: CameraModel) -> FloatArray:
        if self.share_percent == 0.0:
            return electrons
        c = self.share_percent / 100.0
        kernel = np.array([[0.0, c, 0.0], [c, 1.0 - 4.0 * c, c], [0.0, c, 0.0]])
        # "mirror" about the outermost pixels' centres keeps the mosaic's phases
        return np.asarray(convolve(electrons, kernel, mode="mirror"))
