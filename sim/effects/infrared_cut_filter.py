"""Infrared-cut filter: the camera is blind beyond an edge that its data sheet doesn't mention."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np
from scipy.special import expit

from sim.camera import CameraModel
from sim.effects.base import Effect, Stage
from sim.parameters import Quantity
from sim.spectrum import FloatArray


class InfraredCutFilter(Effect):
    """Transmittance 1 / (1 + exp((wavelength - cut) / width)): density grows linearly behind the edge, as behind the edge of
    an interference filter's stop band."""

    name: ClassVar[str] = "infrared_cut_filter"
    stage: ClassVar[Stage] = Stage.OPTICS
    reference: ClassVar[str] = "H. A. Macleod, Thin-Film Optical Filters, chapter on edge filters"
    form_tolerance: ClassVar[float] = 0.02
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "level", "orientation", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"cut_wavelength_nm", "width_nm"})
    shown_by: ClassVar[frozenset[str]] = frozenset({"narrowband", "chart"})
    rivals: ClassVar[frozenset[str]] = frozenset(
        {"wavelength_offset", "source_bandwidth", "second_order_light", "stray_light"}
    )
    sentence: ClassVar[str] = (
        "An infrared-cut filter stands before the sensor: all channels lose their red end at the same wavelength."
    )

    cut_wavelength_nm: Annotated[
        float,
        Quantity("nm", "wavelength at which half of the light gets through", lower=500.0, upper=1500.0, absent=1500.0),
    ] = 1500.0
    width_nm: Annotated[
        float,
        Quantity("nm", "wavelength over which the light falls by e behind the edge", lower=0.5, upper=20.0, absent=6.0),
    ] = 6.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return tuple(
            (cls(cut_wavelength_nm=cut, width_nm=width),)
            for cut in (590, 610, 620, 630, 640, 650, 660, 670, 680, 690, 700, 710, 730)
            for width in (3.0, 8.0)
        )

    def transmittance(self, wavelength_nm: FloatArray, sin_theta: FloatArray | float) -> FloatArray:
        wavelength, _ = np.broadcast_arrays(np.asarray(wavelength_nm, float), sin_theta)
        return np.asarray(expit(-(wavelength - self.cut_wavelength_nm) / self.width_nm))
