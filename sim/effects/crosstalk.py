"""Crosstalk: a share of each pixel's charge ends up in its four neighbours."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np
from scipy.ndimage import convolve

from sim.camera import CameraModel
from sim.effects.base import Effect, Stage
from sim.parameters import Quantity
from sim.spectrum import FloatArray


class Crosstalk(Effect):
    """Kernel (c - d; c + d, 1 - 4 c, c + d; c - d): colours mix in uniform light, OTF factor
    1 - 2 (c + d) (1 - cos 2 pi fx p) - 2 (c - d) (1 - cos 2 pi fy p). Each electron goes its own way: the noise stays white."""

    name: ClassVar[str] = "crosstalk"
    stage: ClassVar[Stage] = Stage.CHARGE
    reference: ClassVar[str] = "K. Hirakawa, Cross-talk explained, ICIP 2008"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "level", "time", "field"})
    shown_by: ClassVar[frozenset[str]] = frozenset({"flat", "narrowband", "chart", "slanted_edge", "bernoulli"})
    rivals: ClassVar[frozenset[str]] = frozenset(
        {
            "charge_diffusion",
            "defocus",
            "optical_low_pass_filter",
            "pixel_aperture",
            "spherical_aberration",
            "vibration_blur",
            "stray_light",
            "on_chip_smoothing",
            "green_imbalance",
            "inter_pixel_capacitance",
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
    row_excess_percent: Annotated[
        float,
        Quantity(
            "%",
            "share of each neighbour in the row above their mean, and of each in the column below it",
            lower=-20.0,
            upper=20.0,
            prior=(0.0, 0.5),
            absent=0.0,
        ),
    ] = 0.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        # neither axis gives what it hasn't: all charge along the rows, along the columns
        return ((cls(share_percent=0.3, row_excess_percent=0.3), cls(share_percent=0.3, row_excess_percent=-0.3)),)

    def shares(self) -> tuple[float, float]:
        """What goes to each neighbour in the row, and in the column."""
        c, d = self.share_percent / 100.0, self.row_excess_percent / 100.0
        return c + d, c - d

    def transfer(
        self, fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float, camera: CameraModel
    ) -> FloatArray | None:
        along, down = self.shares()
        if along == down == 0.0:
            return None
        p = camera.pixel_pitch_um
        return np.asarray(
            1.0
            - 2.0 * along * (1.0 - np.cos(2.0 * np.pi * fx_cy_per_um * p))
            - 2.0 * down * (1.0 - np.cos(2.0 * np.pi * fy_cy_per_um * p))
        )

    def charge(self, electrons: FloatArray, exposure_s: float, camera: CameraModel) -> FloatArray:
        along, down = self.shares()
        if along == down == 0.0:
            return electrons
        kernel = np.array([[0.0, down, 0.0], [along, 1.0 - 2.0 * along - 2.0 * down, along], [0.0, down, 0.0]])
        # "mirror" about the outermost pixels' centres keeps the mosaic's phases
        return np.asarray(convolve(electrons, kernel, mode="mirror"))
