"""Green imbalance: the green pixels on red rows and those on blue rows don't see alike."""

from __future__ import annotations

from typing import Annotated, ClassVar

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.sensor.mosaic import phases, step
from sim.spectrum import FloatArray
from sim.stages import Charge


class GreenImbalance(Effect):
    """Light of G on red rows x (1 + a / 2), on blue rows x (1 - a / 2): a checker in even light, the greens' mean as
    before.
    """

    name: ClassVar[str] = "green_imbalance"
    family: ClassVar[Family] = Family.RESPONSE
    reference: ClassVar[str] = (
        "J. Nakamura (ed.), Image Sensors and Signal Processing for Digital Still Cameras, CRC Press 2006, green "
        "imbalance"
    )
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "level", "orientation", "time"})
    sentence: ClassVar[str] = (
        "The two greens differ: in even light green pixels on red rows and on blue rows have different signals, in one "
        "ratio at all levels."
    )

    imbalance_percent: Annotated[
        float,
        Quantity(
            "%",
            "signal of G on red rows over that on blue rows, less 1",
            lower=-50.0,
            upper=50.0,
            prior=(0.0, 1.0),
            absent=0.0,
        ),
    ] = 0.0

    def on_charge(self, charge: Charge) -> Charge:
        cfa = charge.camera.cfa
        if self.imbalance_percent == 0.0 or cfa == "MONO":
            return charge

        def collect(electrons: FloatArray) -> FloatArray:
            changed, period = electrons.copy(), step(cfa)
            for (row, col), sign in zip(phases(cfa)["G"], (1.0, -1.0), strict=True):
                changed[row::period, col::period] *= 1.0 + sign * 0.005 * self.imbalance_percent
            return changed

        return charge.add_laws(collected=collect)
