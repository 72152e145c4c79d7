"""Row gain: every row is selected and reset by lines of its own, and gains differ."""

from __future__ import annotations

from typing import ClassVar

from sim.effects.line_gain import LineGain
from sim.sensor.lines import Lines


class RowGain(LineGain):
    """A normal factor on what is read of each row, the same in every frame, of mean 1 over the rows: signal and
    noise grow with it, in addition to the pixels' own PRNU. Dark frames have none.
    """

    name: ClassVar[str] = "row_gain"
    lines: ClassVar[Lines] = "rows"
    sentence: ClassVar[str] = (
        "Each row has a gain of its own: the same stripes stand in every bright frame, in proportion to the "
        "light, and not in the dark."
    )
