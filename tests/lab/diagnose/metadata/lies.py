"""Manifests with wrong metadata around recordings of healthy cameras."""

from __future__ import annotations

from typing import Any

from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.diagnose.metadata import misstatements
from lab.formats.recording_set import RecordingSet


def restated(recordings: RecordingSet, **values: Any) -> RecordingSet:
    """The recordings with other values stated of the left camera."""
    manifest = recordings.manifest
    camera = manifest.cameras["left"].model_copy(update=values)
    return recordings.under(manifest.model_copy(update={"cameras": {"left": camera}}))


def with_exchanged_wavelengths(recordings: RecordingSet, first_nm: float, second_nm: float) -> RecordingSet:
    """The recordings with the captures of two narrowband lights stated for each other's."""
    of = {c.wavelength_nm: c for c in recordings.captures(NarrowbandCapture, "left")}
    other = {first_nm: of[second_nm], second_nm: of[first_nm]}

    def changed(capture: Any) -> Any:
        there = other.get(getattr(capture, "wavelength_nm", None) if capture.kind == "narrowband" else None)
        if there is None:
            return capture
        return capture.model_copy(update={key: getattr(there, key) for key in ("wavelength_nm", "radiance")})

    captures = tuple(changed(c) for c in recordings.manifest.captures)
    return recordings.under(recordings.manifest.model_copy(update={"captures": captures}))


def with_dark_exposures(recordings: RecordingSet, exposure_s: float, factor: float) -> RecordingSet:
    """The recordings with the darks of one exposure stated as of `factor` times that."""

    def changed(capture: Any) -> Any:
        mine = capture.kind == "dark" and capture.exposure_s == exposure_s
        return capture.model_copy(update={"exposure_s": factor * exposure_s}) if mine else capture

    captures = tuple(changed(c) for c in recordings.manifest.captures)
    return recordings.under(recordings.manifest.model_copy(update={"captures": captures}))


def with_cells(recordings: RecordingSet, factor: float) -> RecordingSet:
    """The recordings with the cells of the screen stated `factor` times as large."""

    def changed(capture: Any) -> Any:
        screen = getattr(capture, "screen", None)
        if screen is None or screen.cell_camera_px is None:
            return capture
        larger = screen.model_copy(update={"cell_camera_px": factor * screen.cell_camera_px})
        return capture.model_copy(update={"screen": larger})

    captures = tuple(changed(c) for c in recordings.manifest.captures)
    return recordings.under(recordings.manifest.model_copy(update={"captures": captures}))


def told(recordings: RecordingSet) -> list[str]:
    """The findings about wrong metadata, as sentences; the corrected recordings have none."""
    corrected, found = misstatements(recordings, "left")
    assert misstatements(corrected, "left")[1] == ()
    return [one.check for one in found]
