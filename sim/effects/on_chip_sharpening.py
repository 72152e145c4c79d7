"""On-chip sharpening: the raw data was sharpened before it left the camera."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from sim.camera import CameraModel
from sim.effects.families import Family
from sim.effects.on_chip_filter import CornerShare, OnChipFilter
from sim.parameters import Quantity


class OnChipSharpening(OnChipFilter):
    """OTF factor 1 + k (1 - B), B the transfer of a mean over the eight pixels of one colour around; the noise with it,
    so that what neighbours have in common is negative.
    """

    name: ClassVar[str] = "on_chip_sharpening"
    title: ClassVar[str] = "on-chip sharpening"
    family: ClassVar[Family] = Family.ON_CHIP_PROCESSING
    reference: ClassVar[str] = "ISO 12233:2023, annex on sharpening"
    sentence: ClassVar[str] = (
        "The camera sharpens on the chip: contrast rises above what optics and pixel allow, and the noise of "
        "neighbouring pixels is anticorrelated, in light and in the dark."
    )

    strength: Annotated[
        float,
        Quantity(
            "1",
            "share of the detail that is added again",
            lower=0.0,
            upper=5.0,
            prior=(0.0, 0.3),
            absent=0.0,
            linear_power=1,
        ),
    ] = 0.0
    corner_share: CornerShare = 0.33

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return tuple((cls(strength=0.05, corner_share=share),) for share in (0.0, 0.33))

    def detail(self) -> tuple[float, float]:
        return self.strength, self.corner_share
