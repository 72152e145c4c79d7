"""All measurements: every module of this package is searched for declarations (`Measurement`)."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

import lab.diagnose.measurements
from lab.diagnose.measurements.block import Measurement


@cache
def measurements() -> tuple[Measurement, ...]:
    """All measurements in the order of the report. Raises ValueError where two have the same name."""
    found: dict[str, Measurement] = {}
    for module in pkgutil.iter_modules(lab.diagnose.measurements.__path__):
        content = importlib.import_module(f"{lab.diagnose.measurements.__name__}.{module.name}")
        for item in vars(content).values():
            if isinstance(item, Measurement) and found.setdefault(item.name, item) is not item:
                raise ValueError(f"two measurements are named {item.name!r}: give one another name")
    return tuple(sorted(found.values(), key=lambda one: (one.order, one.name)))


def measurement_title(name: str) -> str:
    """Return a measurement's title in reports; its name in words where it no longer exists, as in an older result."""
    return next((one.title for one in measurements() if one.name == name), name.replace("_", " "))
