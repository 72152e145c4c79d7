"""What each instrument was when recordings were taken: its identity, all its settings, and what couldn't be set.

The instruments say it themselves, before the first capture. Two snapshots are compared by `differences`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from lab.capture_kinds.base import Open

#: A setting's value as an instrument reports it.
Value = str | bool | int | float

#: Settings that change by themselves, or are set for each capture and stand with it.
OF_A_CAPTURE = frozenset(
    {"AcquisitionFrameRate", "ExposureTime", "ExposureTimeAbs", "Gain", "GainRaw", "TriggerMode", "TriggerSelector"}
    | {"TriggerSource", "bandwidth_nm", "filter_place"}
)
#: Relative difference of two numbers up to which they are one setting, as a register rounds it.
ROUNDING = 1e-6


class InstrumentSnapshot(Open):
    """One instrument before the first capture.

    settings : every setting that bears on what is measured, by its name
    found : what a setting was before it was set for the measurement, where that changed it
    departures : what couldn't be set as a measurement wants it, in words: it belongs to all that was recorded
    """

    maker: str = ""
    model: str = ""
    serial_number: str = ""
    firmware: str = ""
    settings: dict[str, Value] = {}
    found: dict[str, Value] = {}
    departures: tuple[str, ...] = ()


Snapshots = Mapping[str, InstrumentSnapshot]


def differences(before: Snapshots, now: Snapshots) -> tuple[str, ...]:
    """Return what differs between two sets of instruments, by their names in messages (`camera left`): a line each.

    Nothing where one of them isn't known. Settings of `OF_A_CAPTURE`, and a camera's `Device...`, which says its
    identity again or its temperature, are left out.
    """
    if not before or not now:
        return ()
    lines = [f"{name}: is there, and wasn't" for name in now if name not in before]
    lines += [f"{name}: isn't there, and was" for name in before if name not in now]
    for name in (name for name in now if name in before):
        lines += _changed(name, before[name], now[name])
    return tuple(lines)


def _changed(name: str, before: InstrumentSnapshot, now: InstrumentSnapshot) -> Iterator[str]:
    for key in ("maker", "model", "serial_number", "firmware"):
        was, is_now = getattr(before, key), getattr(now, key)
        if was and is_now and was != is_now:  # one that doesn't say it may be the same
            yield f"{name}: {key.replace('_', ' ')} was {was}, is {is_now}"
    if not before.settings or not now.settings:  # recorded before settings were, or by a driver that tells none
        return
    for key in dict.fromkeys((*before.settings, *now.settings)):
        if key in OF_A_CAPTURE or key.startswith("Device"):
            continue
        was, is_now = before.settings.get(key), now.settings.get(key)
        if not _same(was, is_now):
            yield f"{name}: {key} was {told(was)}, is {told(is_now)}"


def _same(was: Value | None, is_now: Value | None) -> bool:
    if isinstance(was, int | float) and isinstance(is_now, int | float):
        return math.isclose(was, is_now, rel_tol=ROUNDING)
    return was == is_now


def told(value: Value | None) -> str:
    """Return a setting's value in words."""
    return "not there" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
