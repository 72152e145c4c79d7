"""Stereo gain mismatch: one side of a pair answers a scene more strongly than its own calibration says."""

from __future__ import annotations

from typing import Annotated, ClassVar

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.stages import Light


class StereoGainMismatch(Effect):
    """I_right = (1 + a) I_left in every scene that both see, beyond what either side's captures of uniform light say.

    What both sides' sensitivities differ by is each camera's own and no mismatch: this is what changes between
    calibration and use, an automatic gain, an iris that was turned, a window before one side.
    """

    name: ClassVar[str] = "stereo_gain_mismatch"
    family: ClassVar[Family] = Family.RESPONSE
    reference: ClassVar[str] = "H. Hirschmueller and D. Scharstein, IEEE Trans. PAMI 31, 1582 (2009)"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset(
        {"exposure", "wavelength", "field", "level", "orientation", "time"}
    )
    sentence: ClassVar[str] = (
        "The ratio of the right camera's signal to the left one's in the same scene differs from that in uniform "
        "light, by one factor over the whole scene."
    )

    gain_percent: Annotated[
        float,
        Quantity("%", "right over left, beyond both calibrations", lower=-60.0, upper=150.0, prior=(0.0, 3.0),
                 absent=0.0),
    ] = 0.0  # fmt: skip

    def on_light(self, light: Light) -> Light:
        return light if self.gain_percent == 0.0 else light.add_laws(pair_gain=1.0 + 0.01 * self.gain_percent)
