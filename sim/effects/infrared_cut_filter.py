"""Infrared-cut filter: the camera is blind beyond an edge that its data sheet doesn't mention."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from pydantic import Field

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.optics.filters import edge_transmittance
from sim.parameters import Quantity
from sim.stages import Image


class InfraredCutFilter(Effect):
    """Transmittance 1 / (1 + exp(u + steepening u^3)), u = (wavelength - cut) / width: density grows linearly behind
    the edge, as behind the edge of an interference filter's stop band, or faster.

    Of a filter that is known to be such a coating, `effective_index` (1.5 to 2.1 are usual) has its edge move to
    cut sqrt(1 - sin^2 / n^2) at the chief ray's angle; without it the edge stays, as that of glass does.
    """

    name: ClassVar[str] = "infrared_cut_filter"
    title: ClassVar[str] = "infrared-cut filter"
    family: ClassVar[Family] = Family.SPECTRAL_FILTER
    reference: ClassVar[str] = "H. A. Macleod, Thin-Film Optical Filters, chapter on edge filters"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "level", "orientation", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"cut_wavelength_nm", "width_nm", "steepening"})
    sentence: ClassVar[str] = (
        "An infrared-cut filter stands before the sensor: all channels lose their red end at the same wavelength."
    )

    cut_wavelength_nm: Annotated[
        float,
        Quantity("nm", "wavelength at which half of the light gets through", lower=500.0, upper=1500.0, absent=1500.0),
    ] = 1500.0
    width_nm: Annotated[
        float,
        Quantity("nm", "1/e width of the edge", lower=0.5, upper=40.0, absent=6.0),
    ] = 6.0
    steepening: Annotated[
        float,
        Quantity(
            "1",
            "by how much faster than exponentially the light falls behind the edge; 0.0173: as a Gaussian's integral",
            lower=0.0,
            upper=0.2,
            prior=(0.0, 0.02),
            absent=0.0,
            dispensable=True,
        ),
    ] = 0.0

    effective_index: Annotated[
        float | None, Field(ge=1.0, le=4.0, description="effective refractive index of an interference filter's layers")
    ] = None

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return tuple(
            (cls(cut_wavelength_nm=cut, width_nm=width),)
            for cut in (590, 610, 620, 630, 640, 650, 660, 670, 680, 690, 700, 710, 730)
            for width in (3.0, 8.0)
        )

    def on_image(self, image: Image) -> Image:
        return image.add_laws(
            transmittance=lambda wavelength_nm, sin_theta: edge_transmittance(
                wavelength_nm, self.cut_wavelength_nm, self.width_nm, sin_theta, self.effective_index, self.steepening
            )
        )
