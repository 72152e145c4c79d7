"""The noise fit of a recording set: darks and flats of one camera, grouped into levels."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import TypeVar

import numpy as np

from lab.capture_kinds.base import Capture
from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.errors import NotDetermined
from lab.fit.noise.alike_planes import alike_planes
from lab.fit.noise.copied_frames import copied_frames
from lab.fit.noise.dark_pixels import DarkPixels, stack_of
from lab.fit.noise.defective_pixels import defective_pixels
from lab.fit.noise.exchanged_frames import exchanged_frames
from lab.fit.noise.level_statistics import MeasuredLevel
from lab.fit.noise.noise_fit import noise_fit
from lab.fit.noise.photon_numbers import light_of, why_not
from lab.fit.noise.recorded_levels import rounded_c
from lab.fit.noise.stated_light import StatedLight
from lab.formats.recording_set import DataSheet, RecordingSet
from lab.formats.results import NoiseFit
from sim.camera import Side
from sim.spectrum import Spectrum

MIN_SIZE_PX = 16
SAME_LAMP = 0.02  # relative difference below which two radiances are one lamp, measured twice
C = TypeVar("C", bound=Capture)


def fit_noise(recordings: RecordingSet, side: Side) -> NoiseFit:
    """Photon transfer of one camera from its darks and flats (two repeats or more per level).

    Flats and darks of the most frequent `gain_db` are used; the conversion gain is given for 0 dB. Every frame is read
    once, and no more than one level is held in memory. Raises `NotDetermined` where the flats don't determine the
    conversion gain. The method: `lab.fit.noise`.
    """
    camera = recordings.camera(side)
    flats = recordings.captures(FlatCapture, side)
    if not flats:
        raise NotDetermined("noise", "no flats: capture two or more at each of several exposures up to saturation")
    if min(camera.rows, camera.cols) < MIN_SIZE_PX:
        raise NotDetermined(
            "noise",
            f"{camera.rows} x {camera.cols} px are too few for a variance: give frames of {MIN_SIZE_PX} x {MIN_SIZE_PX} or more",
        )
    copies = copied_frames(recordings, side, [*recordings.captures(DarkCapture, side), *flats])
    if copies.ids:
        recordings = recordings.without(copies.ids)
    exchanged = exchanged_frames(recordings, side)
    if exchanged is not None:
        recordings = exchanged.corrected
    flats = recordings.captures(FlatCapture, side)
    gains = [flat.gain_db or 0.0 for flat in flats]
    gain_db = max(sorted(set(gains)), key=gains.count)
    flats = [flat for flat in flats if (flat.gain_db or 0.0) == gain_db]
    darks = [dark for dark in recordings.captures(DarkCapture, side) if (dark.gain_db or 0.0) == gain_db]
    dark_levels, pixels = _dark_levels(recordings, darks, camera)
    light = light_of(flats, camera)
    lamps = _lamps_of(recordings, flats, light)
    flat_levels = [
        MeasuredLevel(
            group[0].exposure_s,
            light[group[0].id].amount,
            lamps[group[0].id],
            stack_of(recordings, group, pixels.bad).statistics(),
            group[0].temperature_c,
            tuple(flat.id for flat in group),
            light[group[0].id].std,
            light[group[0].id].calibration_std,
        )
        for group in _grouped(flats, lambda flat: (flat.exposure_s, light[flat.id].amount, lamps[flat.id]))
    ]
    alike = alike_planes(recordings, side)
    mishaps = (*copies.told, *(one.told(side) for one in (exchanged, alike) if one is not None))
    try:
        fitted = noise_fit(dark_levels, flat_levels, camera, gain_db, pixels=pixels)
    except NotDetermined as refused:
        raise NotDetermined("noise", "; ".join((*mishaps, refused.reason))) from refused
    reason = why_not(flats, camera)
    remarks = (*mishaps, *fitted.remarks, *(() if reason is None else (reason,)))
    return fitted.model_copy(update={"remarks": remarks})


def _mean_c(captures: Sequence[Capture]) -> float | None:
    """Mean of the temperatures that the captures state, deg C; None where none does."""
    known = [capture.temperature_c for capture in captures if capture.temperature_c is not None]
    return float(np.mean(known)) if known else None


def _grouped(captures: Sequence[C], key: Callable[[C], Hashable]) -> list[list[C]]:
    groups: dict[Hashable, list[C]] = {}
    for capture in captures:
        groups.setdefault(key(capture), []).append(capture)
    return list(groups.values())


def _lamps_of(
    recordings: RecordingSet, flats: Sequence[FlatCapture], light: Mapping[str, StatedLight]
) -> dict[str, Hashable]:
    """The lamp of each flat, by its id. A lamp that is measured before every pass over the levels is one lamp; measured photons
    compare whatever the lamp."""
    seen: list[tuple[str, Spectrum]] = []
    names: dict[str | None, str | None] = {None: None}
    for path in dict.fromkeys(flat.radiance for flat in flats):
        if path is None:
            continue
        spectrum = recordings.spectrum(path)
        wavelength_nm = np.array(spectrum.wavelength_nm)
        value = np.array(spectrum.value)
        for name, other in seen:
            if np.abs(value - other.at(wavelength_nm)).sum() <= SAME_LAMP * np.abs(value).sum():
                names[path] = name
                break
        else:
            seen.append((path, spectrum))
            names[path] = path
    measured = {flat.id for flat in flats if light[flat.id].unit == "photons" and flat.photons_per_pixel is None}
    return {flat.id: (None if flat.id in measured else names[flat.radiance], *light[flat.id].lamp) for flat in flats}


def _dark_levels(
    recordings: RecordingSet, darks: Sequence[DarkCapture], camera: DataSheet
) -> tuple[list[MeasuredLevel], DarkPixels]:
    """Statistics of the darks, longest exposure first: it shows the hot pixels, which are left out from there on."""
    pixels = DarkPixels(camera.cfa)
    levels = []
    groups = _grouped(darks, lambda dark: (dark.exposure_s, rounded_c(dark.temperature_c)))
    for group in sorted(groups, key=lambda group: -group[0].exposure_s):
        stack = stack_of(recordings, group, pixels.bad)
        if pixels.longest is None and stack.mean is not None:
            bad = defective_pixels(stack.mean, camera.cfa)
            if bad.any():
                pixels.bad = bad
                stack = stack_of(recordings, group, bad)
        pixels.take(stack, group[0].exposure_s)
        levels.append(
            MeasuredLevel(
                group[0].exposure_s,
                0.0,
                "dark",
                stack.statistics(),
                rounded_c(group[0].temperature_c),
                sensor_c=_mean_c(group),
            )
        )
    return levels, pixels
