"""What is stated of the frames' settings, held against limits, the frames' own files and the times between them.

A contradiction is one line with the file and both values. Three of them can't be anything but a slip and are refused:
an exposure that no frame has, one that is off by a unit, and rows that fit their frames when all are moved by one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import log10
from pathlib import Path

from lab.capture_kinds.base import Capture
from lab.errors import InputError
from lab.formats.importers.frame_header import FrameHeader, frame_header
from lab.formats.recording_set import InstrumentSnapshot, Manifest, differences

#: Longest exposure that is taken without a header that says it (that of a sequence's darks), and of one with light that
#: isn't told, s.
LONGEST_S, LONGEST_LIT_S = 3600.0, 60.0
#: Factor within which a shutter that is marked in thirds of a stop is meant, half of a third: 1/60 s is 1/64 s. Others
#: are measured: relative.
MARKED_FACTOR, MEASURED_SHARE = 2.0 ** (1.0 / 6.0), 0.02
#: Factor within which two f-numbers are one marking: half of a third of a stop, by the square root. f/5.6 is 5.66.
F_NUMBER_FACTOR = 2.0 ** (1.0 / 12.0)
#: Difference of two gains that ISO speeds, marked in thirds of a stop (2 dB), leave open, dB; and of temperatures,
#: degree C.
GAIN_DB, TEMPERATURE_C = 1.0, 1.0
#: What a time that is written to the second leaves open, s.
CLOCK_S = 1.0
#: Factors between units of time.
UNIT_FACTORS = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}
#: Fewest frames that tell whether all rows are moved, and that contradict theirs.
FEWEST_ROWS, FEWEST_OFF = 4, 2


def held_against_frames(manifest: Manifest, images: Mapping[str, Path], where: str) -> tuple[Manifest, list[str]]:
    """Return the manifest with the cameras that the frames' own files name; and one line for each quantity of it that
    these files contradict, and for exposures that are hardly meant in seconds.

    `images`: the file of each frame by its path. Raises InputError where the exposures can't be right: `where` names
    what lists them."""
    headers = {path: frame_header(file) for path, file in images.items()}
    seen = [
        _HeaderSeen(capture, images[capture.frame], header)
        for capture in manifest.captures
        if (header := headers[capture.frame]) is not None
    ]
    lines = _contradictions(manifest, seen, images, where)
    there: dict[str, InstrumentSnapshot] = {}
    for side in manifest.cameras:
        name = f"camera {side}"
        named = [(one, one.header.camera) for one in seen if one.capture.side == side and one.header.camera is not None]
        for one, camera in named:
            first = there.setdefault(name, camera)
            who = {name: camera.model_copy(update={"settings": {}})}  # lens and white balance may differ
            if changed := differences({name: first}, who):
                lines.append(f"{one.file}: {changed[0]}, as in {named[0][0].file.name}: give each camera its own side")
                break
    return manifest.model_copy(update={"instruments": there}) if there else manifest, lines


def _contradictions(
    manifest: Manifest, seen: Sequence[_HeaderSeen], images: Mapping[str, Path], where: str
) -> list[str]:
    """Return the lines of `held_against_frames` on quantities."""
    timed = [one for one in seen if one.capture.exposure_s is not None and one.header.exposure_s is not None]
    off = [one for one in timed if not same_exposure(one.capture.exposure_s, one.header)]
    if off and (unit := _unit(off)):
        one = off[0]
        raise InputError(
            f"{one.file}: exposure_s = {one.capture.exposure_s:g} s, its {one.header.source} says "
            f"{one.header.exposure_s:g} s{_and(off)}: "
            f"it seems to be in {unit}; write seconds"
        )
    confirmed = {one.capture.id for one in timed} - {one.capture.id for one in off}
    doubted = [c for c in manifest.captures if c.exposure_s is not None and c.id not in confirmed]
    _check_limit([c for c in doubted if c.exposure_s > LONGEST_S], images)
    if moved := _moved(timed, off):
        raise InputError(
            f"{where}: {len(off)} of {len(timed)} exposures contradict their frames ({off[0].file.name}: "
            f"{off[0].capture.exposure_s:g} s, its "
            f"{off[0].header.source} says {off[0].header.exposure_s:g} s), and fit those of the frames of {moved}: "
            "move the column of the "
            "frames by one row"
        )
    lines = [_said("exposure_s", "s", [(one, one.capture.exposure_s, one.header.exposure_s) for one in off])]
    warm = [(one, one.capture.temperature_c, one.header.temperature_c) for one in seen]
    lines.append(_said("temperature_c", "degree C", [one for one in warm if _differ(*one[1:], TEMPERATURE_C)]))
    gains = [(one, one.capture.gain_db, one.header.gain_db) for one in seen]
    lines.append(_said("gain_db", "dB", [one for one in gains if _differ(*one[1:], GAIN_DB)]))
    for side, camera in manifest.cameras.items():
        own = [one for one in seen if one.capture.side == side]
        f_number, key = camera.f_number, "f_number"
        if f_number is None and (opened := [one for one in own if one.header.f_number is not None]):
            f_number, key = opened[0].header.f_number, f"f_number (of {opened[0].file.name})"
        wide = [(one, f_number, one.header.f_number) for one in own]
        lines += [_said(key, "", [one for one in wide if not same_f_number(*one[1:])]), _uneven_gain(own)]
    return [line for line in (*lines, _long(doubted, images)) if line] + _overlapping(manifest.captures, images)


@dataclass(frozen=True)
class _HeaderSeen:
    """A capture with its file and what that says."""

    capture: Capture
    file: Path
    header: FrameHeader


def _check_limit(too_long: Sequence[Capture], images: Mapping[str, Path]) -> None:
    """Refuse exposures beyond the limit that no file confirms: InputError with one line."""
    if too_long:
        more = f", and {len(too_long) - 1} more" if len(too_long) > 1 else ""
        raise InputError(
            f"{images[too_long[0].frame]}: exposure_s = {too_long[0].exposure_s:g} is beyond the limit of "
            f"{LONGEST_S:g} s{more}, and no header says "
            "so; write seconds (microseconds over 1e6)"
        )


def same_exposure(stated_s: float | None, header: FrameHeader) -> bool:
    """Return whether an exposure is that of a header, as far as this is rounded; yes where one is unknown."""
    header_s = header.exposure_s
    if not stated_s or not header_s:
        return True
    allowed = MARKED_FACTOR if header.is_marked else 1.0 + MEASURED_SHARE
    return max(stated_s / header_s, header_s / stated_s) <= allowed


def same_f_number(stated: float | None, header: float | None) -> bool:
    """Return whether two f-numbers are one marking; yes where one is unknown."""
    return not stated or not header or max(stated / header, header / stated) <= F_NUMBER_FACTOR


def _differ(stated: float | None, header: float | None, allowed: float) -> bool:
    return stated is not None and header is not None and abs(stated - header) > allowed


def _unit(off: Sequence[_HeaderSeen]) -> str | None:
    """Return the unit in which all these exposures are, where it isn't the second."""
    for factor, name in UNIT_FACTORS.items():
        if all(same_exposure((one.capture.exposure_s or 0.0) / factor, one.header) for one in off):
            return name
    return None


def _moved(timed: Sequence[_HeaderSeen], off: Sequence[_HeaderSeen]) -> str | None:
    """Return the rows whose frames all exposures fit, where these aren't their own."""
    if len(timed) < FEWEST_ROWS or len(off) < FEWEST_OFF:
        return None
    stated, taken = [one.capture.exposure_s for one in timed], [one.header for one in timed]
    for rows, pairs in (
        ("the next rows", zip(stated, taken[1:], strict=False)),
        ("the rows before", zip(stated[1:], taken, strict=False)),
    ):
        if all(same_exposure(one, other) for one, other in pairs):
            return rows
    return None


def _and(off: Sequence[object]) -> str:
    return f" (so do {len(off) - 1} more)" if len(off) > 1 else ""


def _said(key: str, unit: str, off: Sequence[tuple[_HeaderSeen, float | None, float | None]]) -> str:
    """Return the line for a quantity of which frames, what is stated and what their files say differ; empty where none
    does."""
    if not off:
        return ""
    (one, stated, header), of = off[0], f" {unit}" if unit else ""
    return (
        f"{one.file}: {key} = {stated:g}{of}, its {one.header.source} says {header:g}{of}{_and(off)}; the former is "
        "used: correct what is wrong"
    )


def _uneven_gain(own: Sequence[_HeaderSeen]) -> str:
    """Return the line for frames of one side whose ISO speeds differ otherwise than their gains."""
    known = [one for one in own if one.header.iso is not None]
    if not known:
        return ""
    first = known[0]
    iso, gain_db = first.header.iso or 1.0, first.capture.gain_db or 0.0
    off = [
        one
        for one in known
        if abs((one.capture.gain_db or 0.0) - gain_db - 20.0 * log10((one.header.iso or iso) / iso)) > GAIN_DB
    ]
    if not off:
        return ""
    one = off[0]
    stated = "unknown" if one.capture.gain_db is None else f"{one.capture.gain_db:g} dB"
    return (
        f"{one.file}: its {one.header.source} says ISO {one.header.iso:g} and that of {first.file.name} ISO {iso:g}, "
        f"{20.0 * log10((one.header.iso or iso) / iso):+.1f} dB, but gain_db is {stated}{_and(off)}; write the gain "
        "of each into the column gain_db"
    )


def _long(doubted: Sequence[Capture], images: Mapping[str, Path]) -> str:
    """Return the line for exposures with light that are longer than usual; empty where there is none."""
    long = [c for c in doubted if c.kind != "dark" and c.exposure_s > LONGEST_LIT_S]
    if not long:
        return ""
    more = f", and {len(long) - 1} more" if len(long) > 1 else ""
    return (
        f"{images[long[0].frame]}: exposure_s = {long[0].exposure_s:g} of a {long[0].kind}{more}, beyond "
        f"{LONGEST_LIT_S:g} s of light: "
        "check that it is in seconds, not in milliseconds or microseconds"
    )


def _overlapping(captures: Sequence[Capture], images: Mapping[str, Path]) -> list[str]:
    """Return the line for the first exposure of each side that is longer than the time to the next frame."""
    lines = []
    timed = [(c.time.timestamp(), c) for c in captures if c.time is not None and c.exposure_s is not None]
    for side in dict.fromkeys(c.side for _, c in timed):
        own = sorted((one for one in timed if one[1].side == side), key=lambda one: one[0])
        for (at_s, one), (later_s, other) in pairwise(own):
            shorter_s = min(one.exposure_s, other.exposure_s)  # times are of the beginning or of the end of an exposure
            if one.frame != other.frame and later_s - at_s + CLOCK_S < shorter_s * (1.0 - MEASURED_SHARE):
                lines.append(
                    f"{images[one.frame]}: exposure_s = {one.exposure_s:g}, but {images[other.frame].name} of "
                    f"{other.exposure_s:g} s was taken "
                    f"{later_s - at_s:g} s later; check that exposures are in seconds, and the times"
                )
                break
    return lines
