"""The light that flats state: photons, a photodiode's irradiance, a radiance, or the exposure alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lab.capture_kinds.flat import FlatCapture
from lab.formats.recording_set import DataSheet, RecordingSet
from sim.spectrum import Spectrum

# --- stated light --------------------------------------------------------------------------------------------------
# How much light a flat's manifest states: photons a pixel, or else the time of exposure to one lamp.


@dataclass(frozen=True)
class StatedLight:
    """The light of one flat. Amounts of one unit and wavelength compare where the lamp is the same.

    `std`, `calibration_std`: relative standard uncertainties where it was measured, by its readings, and by the
    reference's calibration, which is common to all that it measured.
    """

    amount: float
    unit: Literal["photons", "s"]
    wavelength_nm: float | None
    std: float = 0.0
    calibration_std: float = 0.0

    @property
    def lamp(self) -> tuple[bool, float | None]:
        """What flats without a measured radiance share where their amounts compare."""
        return self.unit == "photons", self.wavelength_nm


def stated_light(flat: FlatCapture) -> StatedLight:
    """Photons per pixel where they are stated, else the exposure (s)."""
    if flat.photons_per_pixel is not None:
        return StatedLight(flat.photons_per_pixel, "photons", flat.wavelength_nm)
    return StatedLight(flat.exposure_s, "s", flat.wavelength_nm)


def most_frequent_gain_db(flats: Sequence[FlatCapture]) -> float:
    """Return the amplification, dB, of most of the flats, the lowest of several that are equally frequent; 0 without
    flats."""
    gains = [flat.gain_db or 0.0 for flat in flats]
    return max(sorted(set(gains)), key=gains.count, default=0.0)


#: Relative difference below which two radiances are readings of one lamp.
SAME_LAMP = 0.02


def lamps_of(recordings: RecordingSet, flats: Sequence[FlatCapture]) -> dict[str, int]:
    """Return the number of the lamp of each radiance file that the flats name.

    A lamp that is measured anew before every pass over the levels is one lamp: its spectra differ by less than
    `SAME_LAMP`, in the sum of the magnitudes."""
    found: list[Spectrum] = []
    lamps: dict[str, int] = {}
    for path in dict.fromkeys(flat.radiance for flat in flats if flat.radiance is not None):
        spectrum = recordings.spectrum(path)
        wavelength_nm, value = spectrum.arrays
        for number, other in enumerate(found):
            if np.abs(value - other.at(wavelength_nm)).sum() <= SAME_LAMP * np.abs(value).sum():
                lamps[path] = number
                break
        else:
            lamps[path] = len(found)
            found.append(spectrum)
    return lamps


# --- photon numbers ------------------------------------------------------------------------------------------------
# Photons on a pixel by the irradiance that a reference photodiode measured, for flats whose manifest states no
# number of photons.
#
#     n = E A t wavelength / (h c)
#
# E: irradiance in the plane of the sensor; A: area of a pixel, the square of the pitch; t: exposure. Source: EMVA 1288
# release 4.0, eq. 3. The photodiode stands where the sensor is, and the camera has no lens: behind one the sensor's
# irradiance is another.


#: Irradiances of one exposure that differ by less are one level: sd of their readings, and a share that lamps move by.
SAME_SIGMA, SAME_SHARE = 4.0, 0.005


def why_not(flats: Sequence[FlatCapture], camera: DataSheet) -> str | None:
    """Why measured irradiances give no numbers of photons; None where they do, or where none was measured."""
    if not any(flat.photon_irradiance_per_m2_s and flat.photons_per_pixel is None for flat in flats):
        return None
    if camera.f_number is not None:
        return (
            "the flats' irradiances give no numbers of photons: the data sheet states a lens "
            f"(f/{camera.f_number:g}), and the photodiode "
            "doesn't look through it; take the lens off for them, and f_number out of the data sheet"
        )
    if camera.pixel_pitch_um is None:
        return (
            "the flats' irradiances give no numbers of photons: pixel_pitch_um is unknown; state it in the data sheet"
        )
    return None


def light_of(flats: Sequence[FlatCapture], camera: DataSheet) -> dict[str, StatedLight]:
    """Return the light of each flat by its id: photons, stated or else measured, or else the exposure."""
    return {flat.id: stated_light(flat) for flat in flats} | photon_numbers(flats, camera)


def photon_numbers(flats: Sequence[FlatCapture], camera: DataSheet) -> dict[str, StatedLight]:
    """Photons by the id of the capture, of flats that have an irradiance and state no photons. Flats of one exposure
    whose irradiances agree are one level, and have its mean."""
    if why_not(flats, camera) is not None or camera.pixel_pitch_um is None:
        return {}
    area_m2 = (camera.pixel_pitch_um * 1e-6) ** 2
    measured = [
        (flat, rate * area_m2 * flat.exposure_s)
        for flat in flats
        if flat.photons_per_pixel is None and (rate := flat.photon_irradiance_per_m2_s) is not None and rate > 0.0
    ]
    measured.sort(key=lambda one: (one[0].exposure_s, one[0].wavelength_nm or 0.0, one[1]))
    levels: list[list[tuple[FlatCapture, float]]] = []
    for flat, photons in measured:
        if levels and _same_level(levels[-1][-1], (flat, photons)):
            levels[-1].append((flat, photons))
        else:
            levels.append([(flat, photons)])
    found: dict[str, StatedLight] = {}
    for level in levels:
        numbers = np.array([photons for _, photons in level])
        mean = float(numbers.mean())
        told = math.sqrt(sum(flat.irradiance_readings_sd**2 for flat, _ in level)) / len(level)
        seen = float(numbers.std(ddof=1)) / mean / math.sqrt(len(level)) if len(level) > 1 else 0.0
        calibration = max(flat.irradiance_calibration_sd for flat, _ in level)
        found |= {
            flat.id: StatedLight(mean, "photons", flat.wavelength_nm, max(told, seen), calibration) for flat, _ in level
        }
    return found


def _same_level(before: tuple[FlatCapture, float], now: tuple[FlatCapture, float]) -> bool:
    (first, fewer), (second, more) = before, now
    if (first.exposure_s, first.wavelength_nm) != (second.exposure_s, second.wavelength_nm):
        return False
    sd = math.hypot(first.irradiance_readings_sd, second.irradiance_readings_sd)
    return more - fewer <= max(SAME_SIGMA * sd, SAME_SHARE) * fewer
