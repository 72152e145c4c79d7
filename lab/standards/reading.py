"""Reading of all standards on a recording set."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from lab.errors import NotDetermined
from lab.formats.recording_set import RecordingSet
from lab.formats.results import FitResult, Skipped
from lab.formats.results.fit import CameraFit
from lab.formats.results.standards import StandardReading, StandardsResult
from lab.standards import (
    emva1288_general,
    emva1288_linear,
    ieee1858,
    iso12233,
    iso13655,
    iso14524,
    iso15739,
    iso17321,
    iso17850,
    iso17957,
    iso18844,
    iso19084,
)
from lab.standards.standard import MeasuredSide, Standard

#: Each standard's name and what reads it, in the order of the report.
STANDARDS: dict[str, Callable[[MeasuredSide], Iterator[Standard]]] = {
    emva1288_linear.Emva1288Linear.name: emva1288_linear.read,
    emva1288_general.Emva1288General.name: emva1288_general.read,
    iso12233.Iso12233.name: iso12233.read,
    ieee1858.Ieee1858.name: ieee1858.read,
    iso14524.Iso14524.name: iso14524.read,
    iso15739.Iso15739.name: iso15739.read,
    iso17321.Iso17321.name: iso17321.read,
    iso17850.Iso17850.name: iso17850.read,
    iso19084.Iso19084.name: iso19084.read,
    iso17957.Iso17957.name: iso17957.read,
    iso18844.Iso18844.name: iso18844.read,
    iso13655.Iso13655.name: iso13655.read,
}


def standard_kinds() -> tuple[type[Standard], ...]:
    """Return the class of each standard, in the order of the report; that of the frame after that of its edges."""
    return (
        emva1288_linear.Emva1288Linear,
        emva1288_general.Emva1288General,
        iso12233.Iso12233,
        iso12233.Iso12233Field,
        ieee1858.Ieee1858,
        iso14524.Iso14524,
        iso15739.Iso15739,
        iso17321.Iso17321,
        iso17850.Iso17850,
        iso19084.Iso19084,
        iso17957.Iso17957,
        iso18844.Iso18844,
        iso13655.Iso13655,
    )


def read_standards(
    recordings: RecordingSet, fit: FitResult, progress: Callable[[str, float], None] | None = None
) -> StandardsResult:
    """Return the figures of all standards that the recordings determine, and why others aren't.

    `fit`: of the same recordings. `progress` is called with the standard and the share (0..1) that is done; an
    exception that it raises ends the work.
    """
    readings: list[StandardReading] = []
    skipped: list[Skipped] = []
    total = len(recordings.sides) * len(STANDARDS)
    for number, side in enumerate(recordings.sides):
        measured = MeasuredSide(recordings, side, fit.cameras.get(side, CameraFit()))
        for place, (name, read) in enumerate(STANDARDS.items()):
            if progress is not None:
                progress(f"{name}, {side}", (number * len(STANDARDS) + place) / total)
            try:
                for standard in read(measured):
                    try:
                        readings.append(standard.read())
                    except NotDetermined as refused:
                        reason = f"{standard.subject}: {refused.reason}"
                        skipped.append(Skipped(step=name, reason=reason, side=side))
            except NotDetermined as refused:
                skipped.append(Skipped(step=name, reason=refused.reason, side=side))
    return StandardsResult(source=recordings.source, readings=tuple(readings), skipped=tuple(skipped))
