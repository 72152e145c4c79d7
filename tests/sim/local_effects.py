"""Effects that only tests know, and scenes of every kind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import cv2
import numpy as np

from sim.camera import Geometry
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.scene import (
    Darkness,
    EdgeRegion,
    KnifeEdge,
    PlanarTarget,
    ReflectanceChart,
    Scene,
    ScreenPattern,
    UniformField,
    Warp,
)
from sim.spectrum import FloatArray, Spectrum
from sim.stages import Charge, Image, Light, Signal


class Local(Effect):
    """Base of the effects that only these tests know."""

    family: ClassVar[Family] = Family.DISCREPANCY
    reference: ClassVar[str] = "tests"
    sentence: ClassVar[str] = "tests"


class Birefringent(Local):
    name: ClassVar[str] = "test_birefringent"
    d_um: float = 0.0

    def on_image(self, image: Image) -> Image:
        return image.add_laws(
            transfer=lambda fx, fy, wavelength_nm: np.cos(np.pi * fx * self.d_um) * np.cos(np.pi * fy * self.d_um)
        )


class Shift(Local):
    name: ClassVar[str] = "test_shift"
    x_um: float = 0.0
    y_um: float = 0.0

    def on_image(self, image: Image) -> Image:
        return image.add_laws(
            transfer=lambda fx, fy, wavelength_nm: np.exp(-2j * np.pi * (fx * self.x_um + fy * self.y_um))
        )


class Veil(Local):
    name: ClassVar[str] = "test_veil"
    share: float = 0.0

    def on_image(self, image: Image) -> Image:
        return image.add_laws(
            transfer=lambda fx, fy, wavelength_nm: np.where(np.hypot(fx, fy) > 0, 1.0 - self.share, 1.0)
        )


class AngleCut(Local):
    """A filter's edge that moves to the blue with the ray's angle."""

    name: ClassVar[str] = "test_angle_cut"

    def on_image(self, image: Image) -> Image:
        return image.add_laws(transmittance=self.through)

    def through(self, wavelength_nm: FloatArray, sin_theta: FloatArray | float) -> FloatArray:
        cut = 650.0 * np.sqrt(1 - np.asarray(sin_theta) ** 2 / 2.25)
        return 1 / (1 + np.exp((wavelength_nm - cut) / 5.0))


class EveryStage(Local):
    name: ClassVar[str] = "test_every_stage"

    def on_light(self, light: Light) -> Light:
        return light.add_laws(
            spectrum=lambda wavelength_nm, radiance, kind: radiance * (1.1 if kind == "flat" else 1.0),
            level=lambda elapsed_s: 1.0 + 0.01 * elapsed_s,
            shading=lambda x_um, y_um: 1.0 + 0.001 * x_um + 0.0 * y_um,
            ambient_e_per_s={"R": 100.0, "G": 200.0, "B": 300.0}.__getitem__,
        )

    def on_charge(self, charge: Charge) -> Charge:
        return charge.add_laws(
            exposure_s=lambda exposure_s: exposure_s + 0.002,
            overflow=lambda electrons: electrons + 7.0,
            variance_e2=lambda electrons, variance_e2: variance_e2 * 0.5,
        )

    def on_signal(self, signal: Signal) -> Signal:
        return signal.add_laws(
            response=lambda electrons: electrons * 0.98,
            offset_dn=lambda elapsed_s, temperature_c: 0.5 * elapsed_s + (temperature_c or 0.0),
        )


@dataclass(frozen=True)
class Ramp:
    """e (r / (R - 1))^2 electrons in row r of R."""

    last_row_e: float

    def draw(self, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        return self.mean_e(shape)

    def mean_e(self, shape: tuple[int, ...]) -> FloatArray:
        return self.last_row_e * np.linspace(0.0, 1.0, shape[0])[:, None] ** 2

    def variance_e2(self, shape: tuple[int, ...]) -> float:
        return 0.0


class ReadOutRamp(Local):
    name: ClassVar[str] = "test_read_out_ramp"

    last_row_e: Annotated[float, Quantity("e", "of the last row", prior=(0.0, 10.0), absent=0.0)] = 0.0

    def on_signal(self, signal: Signal) -> Signal:
        return signal.add_laws(disturbances=Ramp(self.last_row_e))


def scenes(lamp: Spectrum) -> list[Scene]:
    pattern = np.random.default_rng(0).integers(0, 2, (20, 20)).astype(np.uint8)
    return [
        Darkness(),
        UniformField(lamp),
        KnifeEdge(
            (EdgeRegion((10, 10, 40, 40), 5.0), EdgeRegion((10, 50, 40, 90), -80.0, 2.5)), lamp.scale(0.02), lamp
        ),
        ReflectanceChart(((8.0, 10.0), (9.0, 88.0), (64.0, 86.0), (62.0, 8.0)), lamp),
        ScreenPattern(pattern, Warp.from_corners(20, 20, [(5, 8), (6, 90), (66, 88), (64, 6)]), lamp.scale(0.01), lamp),
        planar(pattern, lamp),
    ]


def planar(texture: np.ndarray, lamp: Spectrum) -> PlanarTarget:
    rotation = cv2.Rodrigues(np.array([0.1, -0.2, 0.05]))[0]
    geometry = Geometry(
        camera_matrix=((300.0, 0.0, 48.0), (0.0, 300.0, 36.0), (0.0, 0.0, 1.0)), distortion=(-0.1, 0.02)
    )
    return PlanarTarget(
        texture,
        4.0,
        tuple(map(tuple, rotation.tolist())),
        (-40.0, -40.0, 400.0),
        geometry,
        lamp.scale(0.02),
        lamp,
        1.0,
    )
