"""Hot pixels: a few pixels with far more dark current than the rest."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from pydantic import Field

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.sensor.defects import Defects
from sim.stages import Charge


class HotPixels(Effect):
    """A share of the pixels, `pattern_seed` says which, has additional dark current, gamma distributed about its mean:
    a relative spread of 1 is an exponential distribution, 0 are pixels that are all alike.
    """

    name: ClassVar[str] = "hot_pixels"
    family: ClassVar[Family] = Family.DEFECTIVE_PIXELS
    reference: ClassVar[str] = "EMVA Standard 1288 release 4.0, logarithmic histograms of defect pixels"
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset(
        {"f_number", "wavelength", "field", "level", "orientation", "time"}
    )
    shapes: ClassVar[frozenset[str]] = frozenset({"share_ppm", "relative_spread"})
    sentence: ClassVar[str] = (
        "A few pixels are hot: always the same ones, they collect dark charge that grows with the exposure and stands "
        "far above the rest."
    )

    excess_e_per_s: Annotated[
        float,
        Quantity(
            "e/s",
            "mean additional dark current of the hot pixels",
            lower=0.0,
            upper=1e6,
            prior=(0.0, 1000.0),
            absent=0.0,
        ),
    ] = 0.0
    share_ppm: Annotated[
        float,
        Quantity(
            "ppm",
            "share of the pixels that are hot, one at least",
            lower=0.0,
            upper=1e5,
            prior=(200.0, 1000.0),
            absent=200.0,
        ),
    ] = 200.0
    relative_spread: Annotated[
        float,
        Quantity(
            "1",
            "standard deviation of the hot pixels' dark current, relative to its mean",
            lower=0.0,
            upper=3.0,
            prior=(1.0, 0.5),
            absent=1.0,
        ),
    ] = 1.0
    pattern_seed: Annotated[int, Field(description="which of the patterns that the law can draw")] = 0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return tuple(
            (cls(excess_e_per_s=excess, share_ppm=share, relative_spread=spread),)
            for excess in (15.0, 50.0, 150.0, 500.0, 2000.0)
            for share in (20.0, 200.0, 2000.0)
            for spread in (1.0, 0.3)
        )

    def on_charge(self, charge: Charge) -> Charge:
        if self.excess_e_per_s == 0.0:
            return charge
        return charge.add_laws(
            defects=Defects(self.share_ppm * 1e-6, self.excess_e_per_s, self.relative_spread, self.pattern_seed)
        )
