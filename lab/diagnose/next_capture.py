"""The capture that would best tell apart what is still undecided."""

from __future__ import annotations

from collections.abc import Sequence

from lab.diagnose.side import SideFindings
from sim.effects.library import effects as library

SMALLEST_RIVAL = 0.005

#: The capture that tells two effects apart where one depends on a thing and the other doesn't.
SETTLING = {
    "f_number": "the slanted edges again at twice the f-number",
    "wavelength": "slanted edges in narrowband light, at 450 and at 650 nm",
    "orientation": "slanted edges at four orientations, 5, 50, 95 and 140 degrees from the vertical",
    "exposure": "the same captures at a quarter of the exposure and four times the light",
    "level": "the same captures at a quarter of the light",
    "field": "the same captures at the corners of the field",
    "time": "the same captures again, in the reverse order",
}


def next_capture(found: Sequence[SideFindings]) -> str | None:
    """What tells the nearest rivals apart: something that one of them depends on and the other doesn't."""
    pairs = [
        (c.effect.name, name, p)
        for f in found
        for c in (*(one.candidate for one in f.named), *f.abstained)
        for name, p in c.rivals
        if p >= SMALLEST_RIVAL
    ]
    pairs = [p for p in pairs if p[1] in library()]
    if not pairs:
        open_ends = [u for f in found for u in f.unexplained]
        return (
            "Repeat the captures that are off at another exposure and another f-number: what the mismatch follows says where it arises."
            if open_ends
            else None
        )
    one, other, _ = max(pairs, key=lambda p: p[2])
    differs = library()[one].invariances ^ library()[other].invariances
    for thing, capture in SETTLING.items():
        if thing in differs:
            steady = one if thing in library()[one].invariances else other
            return f"{capture[0].upper()}{capture[1:]} would tell {one} from {other}: only {steady} stays the same."
    return f"More repeats of the captures that show it would tell {one} from {other}: both depend on the same things."
