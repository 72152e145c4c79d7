"""Etaloning: a thinned, back-illuminated sensor is an etalon for near-infrared light, of a thickness that differs by
place."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import GainPattern, Image

#: Refractive index of silicon at 850 nm; 3.75 at 720 nm, 3.58 at 1000 nm.
INDEX = 3.65
#: Absorption of silicon at 300 K by wavelength in nm, 1/um (Green 2008).
SILICON_NM = 400.0, 500.0, 600.0, 700.0, 750.0, 800.0, 850.0, 900.0, 950.0, 1000.0, 1050.0, 1100.0
SILICON_PER_UM = 9.52, 1.11, 0.414, 0.19, 0.13, 0.085, 0.0535, 0.0306, 0.0157, 0.0064, 0.00163, 0.00035
#: Changes of the thickness over the frame that are tried first, um.
WEDGES_UM = 0.25, 0.7, 1.5, 3.0


class Etaloning(Effect):
    """Sensitivity 1 + a t cos(4 pi n L / wavelength), L the thickness at a place and t = exp(-2 L alpha) what silicon
    leaves of light on its way there and back: fringes along lines of equal thickness, none in visible light. White
    light has all phases at once, and next to none. What a frame's mean has of it is part of the quantum efficiency.

    The thickness grows by `wedge_x_um` and `wedge_y_um` from edge to edge, and by `bow_um` from the middle to the
    corners. Real maps of thickness have more shapes: they are in the form tolerance.
    """

    name: ClassVar[str] = "etaloning"
    family: ClassVar[Family] = Family.FIELD_OF_LIGHT
    reference: ClassVar[str] = (
        "D. E. Groom et al., Quantum efficiency of a back-illuminated CCD imager: an optical approach, Proc. SPIE 3649 "
        "(1999) 80; M. A. Green, Sol. Energy Mater. Sol. Cells 92 (2008) 1305"
    )
    form_tolerance: ClassVar[float] = 0.3
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "level", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"thickness_um", "wedge_x_um", "wedge_y_um", "bow_um"})
    sentence: ClassVar[str] = (
        "Near-infrared light interferes in the thinned sensor: flats in it have fringes that move with the wavelength, "
        "and flats in visible light have none."
    )

    strength_percent: Annotated[
        float,
        Quantity("%", "amplitude of the fringes where silicon absorbs nothing", lower=0.0, upper=80.0, prior=(0.0, 5.0),
                 absent=0.0),
    ] = 0.0  # fmt: skip
    thickness_um: Annotated[
        float,
        Quantity("um", "thickness of the silicon", lower=1.0, upper=500.0, absent=15.0, logarithmic=True),
    ] = 15.0
    wedge_x_um: Annotated[
        float, Quantity("um", "by how much it grows from left to right", lower=-20.0, upper=20.0, absent=1.0)
    ] = 1.0
    wedge_y_um: Annotated[
        float, Quantity("um", "by how much it grows from top to bottom", lower=-20.0, upper=20.0, absent=0.8)
    ] = 0.8
    bow_um: Annotated[
        float,
        Quantity("um", "by how much it grows from the middle to the corners", lower=-20.0, upper=20.0, absent=0.0),
    ] = 0.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return tuple(
            (cls(strength_percent=3.0, wedge_x_um=wedge, wedge_y_um=turn * wedge, bow_um=0.3 * wedge),)
            for turn in (0.8, -0.8)
            for wedge in WEDGES_UM
        )

    def on_image(self, image: Image) -> Image:
        if self.strength_percent == 0.0:
            return image
        camera = image.camera
        across_um, down_um = camera.cols * camera.pixel_pitch_um, camera.rows * camera.pixel_pitch_um

        def thickness(x_um: FloatArray, y_um: FloatArray) -> FloatArray:
            plane = self.wedge_x_um * x_um / across_um + self.wedge_y_um * y_um / down_um
            return np.asarray(
                self.thickness_um + plane + self.bow_um * (x_um**2 + y_um**2) / camera.half_diagonal_um**2
            )

        def factor(wavelength_nm: FloatArray, thickness_um: FloatArray) -> FloatArray:
            absorbed = np.exp(np.interp(wavelength_nm, SILICON_NM, np.log(SILICON_PER_UM)))
            left = np.exp(-2.0 * absorbed * np.maximum(thickness_um, 0.0))
            turn = 4e3 * np.pi * INDEX * thickness_um / wavelength_nm
            return np.asarray(1.0 + 0.01 * self.strength_percent * left * np.cos(turn))

        return image.add_laws(patterns=GainPattern(thickness, factor))
