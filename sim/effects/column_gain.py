"""Column gain: every column is amplified, or converted, by a circuit of its own, and gains differ."""

from __future__ import annotations

from typing import ClassVar

from sim.effects.line_gain import LineGain
from sim.sensor.lines import Lines


class ColumnGain(LineGain):
    """A normal factor on what is read of each column, the same in every frame, of mean 1 over the columns: signal and
    noise grow with it, in addition to the pixels' own PRNU. Dark frames have none.
    """

    name: ClassVar[str] = "column_gain"
    lines: ClassVar[Lines] = "columns"
    sentence: ClassVar[str] = (
        "Each column is amplified by a circuit of its own: the same stripes stand in every bright frame, in "
        "proportion to the light, and not in the dark."
    )
