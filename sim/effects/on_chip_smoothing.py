"""On-chip smoothing: noise was averaged away before the raw data left the camera."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from sim.camera import CameraModel
from sim.effects.families import Family
from sim.effects.on_chip_filter import CornerShare, OnChipFilter
from sim.parameters import Quantity


class OnChipSmoothing(OnChipFilter):
    """OTF factor 1 - k (1 - B), B the transfer of a mean over the eight pixels of one colour around; the noise with it,
    so that neighbours have noise in common, in the same proportion at all levels.
    """

    name: ClassVar[str] = "on_chip_smoothing"
    title: ClassVar[str] = "on-chip smoothing"
    family: ClassVar[Family] = Family.ON_CHIP_PROCESSING
    reference: ClassVar[str] = "ISO 15739:2023, annex on noise filtering"
    sentence: ClassVar[str] = (
        "The camera smooths on the chip: contrast falls alike at all apertures, and the noise of neighbouring pixels "
        "is correlated, in light and in the dark."
    )

    strength: Annotated[
        float,
        Quantity(
            "1",
            "share of the detail that is taken away",
            lower=0.0,
            upper=1.0,
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
        return -self.strength, self.corner_share
