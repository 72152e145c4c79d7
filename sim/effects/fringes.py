"""Fringes: light that is reflected twice in a thin layer before the pixels interferes: the sensitivity ripples."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Image


def _ripple(meaning: str) -> Quantity:
    return Quantity("%", meaning, lower=-50.0, upper=50.0, prior=(0.0, 1.0), absent=0.0)


class Fringes(Effect):
    """Transmittance 1 + a cos(4 pi L / wavelength) + b sin(4 pi L / wavelength), L the layer's thickness times its
    index: what an etalon of small reflectance passes, 2 sqrt(a^2 + b^2) from trough to crest. Reflections that turn the
    phase, and an index that follows the wavelength, are in the share of b. The angle is that on the axis: plates much
    thicker than 50 um have fringes finer than any line here, and rings over the field.
    """

    name: ClassVar[str] = "fringes"
    family: ClassVar[Family] = Family.SPECTRAL_FILTER
    reference: ClassVar[str] = "M. Born and E. Wolf, Principles of Optics, chapter 7.6, multiple-beam interference"
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "level", "orientation", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"optical_thickness_um"})
    sentence: ClassVar[str] = (
        "Light interferes in a thin layer before the pixels: the sensitivity ripples with the wavelength, evenly in "
        "its inverse, alike in all channels."
    )

    cos_percent: Annotated[
        float, _ripple("ripple with a crest where the wavelength fits 2 L a whole number of times")
    ] = 0.0
    sin_percent: Annotated[float, _ripple("ripple a quarter of a period beside that")] = 0.0
    optical_thickness_um: Annotated[
        float,
        Quantity(
            "um", "thickness of the layer times its index, L", lower=0.5, upper=50.0, absent=5.0, logarithmic=True
        ),
    ] = 5.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        # three phases span all; in a step of the thickness the phase turns by a half between 400 and 700 nm
        phases = (0.5, 0.0), (-0.25, 0.433), (-0.25, -0.433)
        return tuple(
            tuple(cls(cos_percent=a, sin_percent=b, optical_thickness_um=um) for a, b in phases)
            for um in np.arange(1.5, 12.1, 0.4).round(1).tolist()
        )

    def on_image(self, image: Image) -> Image:
        if self.cos_percent == 0.0 and self.sin_percent == 0.0:
            return image

        def ripple(wavelength_nm: FloatArray) -> FloatArray:
            turn = 4e3 * np.pi * self.optical_thickness_um / np.asarray(wavelength_nm)
            return np.asarray(1.0 + 0.01 * (self.cos_percent * np.cos(turn) + self.sin_percent * np.sin(turn)))

        return image.add_laws(ripple=ripple)
