"""Random telegraph noise: a few pixels jump between two levels."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from pydantic import Field

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.sensor.defects import Jumps
from sim.stages import Signal


class RandomTelegraphNoise(Effect):
    """A share of the pixels, `pattern_seed` says which, jumps between two levels at a distance A, anew in every frame
    (traps much faster than the frame rate): it is read with +(1 - p) A in a share p of the frames, else with -p A. Mean
    0, variance p (1 - p) A^2, two peaks in a pixel's histogram. A is the same in all (relative spread 0), or gamma
    distributed about its mean.
    """

    name: ClassVar[str] = "random_telegraph_noise"
    family: ClassVar[Family] = Family.DEFECTIVE_PIXELS
    reference: ClassVar[str] = "X. Wang et al., Random telegraph signal in CMOS image sensor pixels, IEDM 2006"
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset(
        {"f_number", "exposure", "wavelength", "field", "level", "orientation", "time"}
    )
    shapes: ClassVar[frozenset[str]] = frozenset({"share_percent", "relative_spread", "high_share"})
    sentence: ClassVar[str] = (
        "A few pixels blink: always the same ones jump between two levels, with far more temporal noise than their "
        "neighbours."
    )

    amplitude_e: Annotated[
        float,
        Quantity(
            "e",
            "distance of the two levels, mean over these pixels",
            lower=0.0,
            upper=1e4,
            prior=(0.0, 60.0),
            absent=0.0,
            linear_power=2,
        ),
    ] = 0.0
    share_percent: Annotated[
        float,
        Quantity(
            "%", "share of the pixels that blink, one at least", lower=0.0, upper=100.0, prior=(0.2, 1.0), absent=0.2
        ),
    ] = 0.2
    relative_spread: Annotated[
        float,
        Quantity(
            "1",
            "standard deviation of the distances, relative to their mean",
            lower=0.0,
            upper=3.0,
            prior=(0.5, 0.5),
            absent=0.0,
        ),
    ] = 0.0
    high_share: Annotated[
        float,
        Quantity(
            "1",
            "share of the frames in which such a pixel is at its higher level",
            lower=0.02,
            upper=0.98,
            prior=(0.5, 0.25),
            absent=0.5,
        ),
    ] = 0.5
    pattern_seed: Annotated[int, Field(description="which of the patterns that the law can draw")] = 0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return tuple(
            (cls(amplitude_e=amplitude, share_percent=share, relative_spread=spread, high_share=high),)
            for amplitude in (5.0, 12.0, 30.0, 80.0)
            for share in (0.02, 0.2, 2.0)
            for spread, high in ((0.0, 0.5), (1.0, 0.5), (0.0, 0.25))
        )

    def on_signal(self, signal: Signal) -> Signal:
        if self.amplitude_e == 0.0:
            return signal
        return signal.add_laws(
            telegraph=Jumps(
                self.share_percent / 100.0, self.amplitude_e, self.relative_spread, self.pattern_seed, self.high_share
            )
        )
