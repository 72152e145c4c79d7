"""Parameters in DN where no conversion gain is known: nothing is told in electrons of a gain that was made up."""

from __future__ import annotations

from sim.parameters import Quantity


def told_as(field: str, quantity: Quantity, *, gain_is_known: bool) -> tuple[str, str]:
    """Name and unit of an effect's parameter in a result. Without a known gain the baseline has 1 DN/e, so that its
    electrons are DN."""
    if gain_is_known or quantity.unit not in ("e", "e/s"):
        return field, quantity.unit
    stem, _, more = field.rpartition("_e")
    return f"{stem}_dn{more}", quantity.unit.replace("e", "DN")
