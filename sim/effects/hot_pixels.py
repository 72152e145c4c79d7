"""Hot pixels: a few pixels with far more dark current than the rest."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from sim.camera import CameraModel
from sim.effects.base import Effect, Stage
from sim.parameters import Quantity
from sim.sensor.defects import exponential_excess
from sim.spectrum import FloatArray


class HotPixels(Effect):
    """A share of the pixels, `pattern_seed` says which, has additional dark current, exponentially distributed about its mean."""

    name: ClassVar[str] = "hot_pixels"
    stage: ClassVar[Stage] = Stage.CHARGE
    reference: ClassVar[str] = "EMVA Standard 1288 release 4.0, logarithmic histograms of defect pixels"
    form_tolerance: ClassVar[float] = 0.2
    invariances: ClassVar[frozenset[str]] = frozenset(
        {"f_number", "wavelength", "field", "level", "orientation", "time"}
    )
    shown_by: ClassVar[frozenset[str]] = frozenset({"dark", "flat"})
    rivals: ClassVar[frozenset[str]] = frozenset({"random_telegraph_noise"})
    shapes: ClassVar[frozenset[str]] = frozenset({"share_ppm"})
    sentence: ClassVar[str] = (
        "A few pixels are hot: always the same ones, they collect dark charge that grows with the exposure and stands far above the rest."
    )

    excess_e_per_s: Annotated[
        float,
        Quantity(
            "e/s",
            "mean additional dark current of the hot pixels",
            lower=0.0,
            upper=1e6,
            prior=(0.0, 200.0),
            absent=0.0,
        ),
    ] = 0.0
    share_ppm: Annotated[
        float, Quantity("ppm", "share of the pixels that are hot, one at least", lower=0.0, upper=1e5, absent=200.0)
    ] = 200.0
    pattern_seed: int = 0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return ((cls(excess_e_per_s=60.0),),)

    def dark_current(
        self, e_per_s: FloatArray | float, temperature_c: float | None, camera: CameraModel
    ) -> FloatArray | float:
        if self.excess_e_per_s == 0.0:
            return e_per_s
        excess = exponential_excess((camera.rows, camera.cols), self.share_ppm * 1e-6, self.pattern_seed)
        return e_per_s + self.excess_e_per_s * excess
