"""Stereo time offset: the two cameras of a pair don't capture at the same time."""

from __future__ import annotations

from typing import Annotated, ClassVar

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.stages import Light


class StereoTimeOffset(Effect):
    """The right camera captures later by dt: what moves by v in its picture lies off by v dt; what stands still shows
    nothing.
    """

    name: ClassVar[str] = "stereo_time_offset"
    family: ClassVar[Family] = Family.GEOMETRY
    reference: ClassVar[str] = "P. Furgale, J. Rehder and R. Siegwart, IROS 2013"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "wavelength", "field", "level", "time"})
    sentence: ClassVar[str] = (
        "The right camera captures at another time than the left one: boards that move lie off their place in "
        "proportion to their speed."
    )

    delay_ms: Annotated[
        float,
        Quantity("ms", "by how much the right camera is later", lower=-1000.0, upper=1000.0, prior=(0.0, 10.0),
                 absent=0.0),
    ] = 0.0  # fmt: skip

    def on_light(self, light: Light) -> Light:
        return light if self.delay_ms == 0.0 else light.add_laws(pair_delay_s=1e-3 * self.delay_ms)
