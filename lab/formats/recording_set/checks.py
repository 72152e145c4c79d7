"""Checks of a whole recording set: every problem and every warning, one line each."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from lab.capture_kinds.base import Capture, Names, Open, names_in
from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.errors import InputError
from lab.formats.recording_set.clipping import (
    CLIPPED_LIMIT,
    ClippedLevel,
    clipped_share,
    flat_level,
    saturated_flats,
    wrong_lights,
)
from lab.formats.recording_set.frame_files import Frame
from lab.formats.recording_set.level_order import FrameLevel, exchanged_kinds, moved_rows
from lab.formats.recording_set.manifest import DataSheet, Findings
from lab.formats.recording_set.recordings import RecordingSet
from sim.camera import Side

#: Share of a channel's pixels at its highest code from which on a flat's mean isn't in proportion to the light.
ANY_CLIPPED = 0.01
#: A warning is given where a narrowband light's centre is off the wavelength set by more than this plus a quarter of
#: its bandwidth.
OFF_NAME_NM = 3.0


#: Called with each capture, its frame, and the share of the captures that are done.
Loaded = Callable[[Capture, Frame, float], None]


def _not_used(capture: Capture, frame: Frame, share: float) -> None:
    """Frames that are checked and not used otherwise."""


def _unknown_keys(where: str, item: Open) -> Iterator[str]:
    for key in item.unknown_keys():
        yield f"{where}: unknown key '{key}' is kept but not used; check its spelling"
    for name, value in item:
        if isinstance(value, Open):
            yield from _unknown_keys(f"{where}, {name}", value)


def _camera_problems(camera: DataSheet) -> Iterator[str]:
    limit = 2**camera.bit_depth - 1
    if camera.white_level_dn is not None and camera.white_level_dn > limit:
        yield (
            f"white_level_dn = {camera.white_level_dn:g} is above what {camera.bit_depth} bits hold ({limit}); "
            "correct one"
        )
    if camera.black_level_dn is not None and camera.black_level_dn >= camera.saturation_dn:
        yield (
            f"black_level_dn = {camera.black_level_dn:g} isn't below the white level {camera.saturation_dn:g}; "
            "correct one"
        )
    for channel in camera.quantum_efficiency or {}:
        if channel not in camera.channels:
            yield (
                f"quantum_efficiency of a channel '{channel}', but a {camera.cfa} sensor has "
                f"{', '.join(camera.channels)}; rename it"
            )


def _check_frames(recordings: RecordingSet, found: Findings, loaded: Loaded) -> None:
    """Load every frame once and hand it to `loaded`; find damaged frames, saturated flats, clipped captures, and darks
    and flats whose levels contradict their kind or their place."""
    flats: dict[Side, list[ClippedLevel]] = defaultdict(list)
    levels: dict[Side, list[FrameLevel]] = defaultdict(list)
    clipped_of: dict[tuple[Side, str], list[str]] = defaultdict(list)
    captures = recordings.manifest.captures
    for number, capture in enumerate(captures, start=1):
        camera = recordings.manifest.cameras[capture.side]
        try:
            frame = recordings.frame(capture)
        except InputError as error:
            found.problems.append(str(error))
            continue
        loaded(capture, frame, number / len(captures))
        if isinstance(capture, DarkCapture):
            levels[capture.side].append(_frame_level(recordings, capture, float(frame.mean()), 0.0, None))
        if not capture.clipping_matters:
            continue
        clipped = clipped_share(frame, camera)
        if isinstance(capture, FlatCapture):
            with suppress(InputError):  # a spectrum that can't be used is reported with the spectra
                flat = flat_level(recordings, capture, frame, clipped)
                flats[capture.side].append(flat)
                level = _frame_level(recordings, capture, float(frame.mean()), flat.light, flat.scale)
                levels[capture.side].append(replace(level, is_clipped=max(clipped.values()) > ANY_CLIPPED))
        elif max(clipped.values()) > CLIPPED_LIMIT:
            clipped_of[capture.side, capture.kind].append(capture.id)
    for side, of_flats in flats.items():
        found.problems += saturated_flats(of_flats, recordings.manifest.cameras[side])
        found.warnings += wrong_lights(of_flats, recordings.manifest.cameras[side])
    for side, of_frames in levels.items():
        problems, warnings = exchanged_kinds(of_frames, recordings.manifest.cameras[side])
        found.problems += problems
        found.warnings += [*warnings, *([] if problems else moved_rows(of_frames))]
    for (side, kind), ids in clipped_of.items():
        found.warnings.append(
            f"{recordings.source}: {len(ids)} {kind} captures of the {side} camera have a channel clipped "
            f"({_some(ids)}); "
            "what a clipped channel saw is not used; expose shorter"
        )


def _frame_level(
    recordings: RecordingSet, capture: Capture, mean_dn: float, light: float, scale: str | None
) -> FrameLevel:
    return FrameLevel(
        capture.id,
        f"{recordings.where(capture.frame)} (capture {capture.id})",
        capture.gain_db,
        capture.exposure_s,
        capture.temperature_c,
        mean_dn,
        light,
        scale,
    )


def _check_cameras(recordings: RecordingSet, found: Findings) -> None:
    for side, camera in recordings.manifest.cameras.items():
        where = f"{recordings.source}: camera {side}"
        found.warnings += _unknown_keys(where, camera)
        found.problems += [f"{where}: {problem}" for problem in _camera_problems(camera)]
        if camera.lens_file is not None:
            try:
                recordings.file(camera.lens_file)
            except InputError as error:
                found.problems.append(f"{recordings.where(camera.lens_file)} (lens_file of camera {side}): {error}")


def _check_captures(recordings: RecordingSet, found: Findings) -> None:
    manifest, source = recordings.manifest, recordings.source
    for id, count in Counter(capture.id for capture in manifest.captures).items():
        if count > 1:
            found.problems.append(f"{source}: capture id '{id}' is used {count} times; give every capture its own")
    framed: dict[str, Capture] = {}
    remarked: dict[str, list[str]] = {}
    for capture in manifest.captures:
        where = f"{source}: capture {capture.id}"
        found.warnings += _unknown_keys(where, capture)
        camera = manifest.cameras[capture.side]
        found.problems += [f"{where}: {text}" for text in capture.problems(camera.rows, camera.cols)]
        for text in capture.remarks():
            remarked.setdefault(text, []).append(capture.id)
        first = framed.setdefault(capture.frame, capture)
        if first is not capture and not capture.shares_frame:
            found.warnings.append(f"{where}: its frame is that of {first.id} too, so it is no repeat; check the path")
    for text, ids in remarked.items():
        what = f"capture {ids[0]}" if len(ids) == 1 else f"{len(ids)} captures ({_some(ids)})"
        found.warnings.append(f"{source}: {what}: {text}")


def _some(ids: Sequence[str]) -> str:
    """Return the first three of some captures and the last."""
    return ", ".join(ids[:3]) + (f" .. {ids[-1]}" if len(ids) > 3 else "")


def _check_spectra_and_targets(recordings: RecordingSet, found: Findings) -> None:
    manifest = recordings.manifest
    efficiencies = {
        path: f"quantum_efficiency {channel} of camera {side}"
        for side, camera in manifest.cameras.items()
        for channel, path in (camera.quantum_efficiency or {}).items()
    }
    lights: dict[str, str] = {}
    targets: dict[str, str] = {}
    for capture in manifest.captures:
        for key, what, path in names_in(capture):
            if what in (Names.SPECTRUM, Names.TARGET):
                users = lights if what is Names.SPECTRUM else targets
                users.setdefault(path, f"{key} of capture {capture.id}")
    for path, user in [*efficiencies.items(), *lights.items()]:
        where = f"{recordings.where(path)} ({user})"
        try:
            lowest, highest = min(value := recordings.spectrum(path).value), max(value)
        except InputError as error:
            found.problems.append(f"{where}: {error.__cause__}")
            continue
        if user.startswith("quantum_efficiency") and not 0 <= lowest <= highest <= 1:
            found.problems.append(
                f"{where}: {lowest:g}..{highest:g} isn't a quantum efficiency of 0..1 electrons a photon; "
                "divide percent by 100"
            )
        elif not user.startswith("quantum_efficiency") and highest <= 0:
            found.warnings.append(f"{where}: no light at any wavelength; was the shutter open?")
    found.warnings += _lights_off_their_names(recordings)
    for path, user in targets.items():
        try:
            recordings.target(path)
        except InputError as error:
            found.problems.append(f"{recordings.where(path)} ({user}): {error.__cause__}")


def _lights_off_their_names(recordings: RecordingSet) -> Iterator[str]:
    """One line that names the narrowband lights whose measured centre isn't the wavelength set.

    The centre is the mean wavelength of the samples above half of the maximum, weighted by the radiance.
    """
    off: dict[str, str] = {}
    for capture in recordings.manifest.captures:
        if not isinstance(capture, NarrowbandCapture) or capture.radiance in off:
            continue
        try:
            wavelength, value = recordings.spectrum(capture.radiance).arrays
        except InputError:  # reported with the spectra
            continue
        if value.max() > 0:
            share = value / value.max()
            above = share > 0.5
            centre_nm = float(np.average(wavelength[above], weights=share[above]))
            if abs(centre_nm - capture.wavelength_nm) > OFF_NAME_NM + 0.25 * (capture.bandwidth_nm or 0.0):
                off[capture.radiance] = f"{capture.wavelength_nm:g} nm: {centre_nm:.1f} nm"
    if off:
        yield (
            f"{recordings.source}: {len(off)} narrowband lights are centred elsewhere than they are set "
            f"({'; '.join(off.values())}); "
            "their measured spectra are used; correct wavelength_nm, or measure again"
        )


def inspect(recordings: RecordingSet, loaded: Loaded = _not_used) -> tuple[list[str], list[str]]:
    """(problems, warnings) of a recording set, one line each. `read` refuses a set with problems.

    Every frame, spectrum and target is read once; frames are handed to `loaded`.
    """
    found = Findings(warnings=list(_unknown_keys(f"{recordings.source}: manifest", recordings.manifest)))
    _check_cameras(recordings, found)
    _check_captures(recordings, found)
    _check_spectra_and_targets(recordings, found)
    _check_frames(recordings, found, loaded)
    return found.problems, found.warnings
