"""The range in which each figure of a working camera lies, declared once, and the likely causes of a figure outside it.

A limit is physical (an electron needs a photon), or beyond what sensors and lenses are sold with: its comment says
which. A figure is reported where it lies outside by more than `OUTSIDE_SIGMA` standard deviations
(`lab.formats.plausible_range`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from statistics import median_low

import numpy as np
from scipy import optimize

from lab.formats.plausible_range import LENGTH_UNIT, STATED, Plausible
from lab.formats.recording_set import DataSheet
from lab.formats.results.fit import CameraFit, FitResult, GeometryFit, MtfCurve, NoiseFit, SpectralFit, StereoFit
from lab.formats.results.words import plain_name, unit_of
from sim.camera import Side
from sim.optics.diffraction import aperture_otf, diffraction_otf

#: Shortest light of an edge, nm: diffraction spreads all other visible light more.
SHORTEST_NM = 380.0
#: Side of a pixel's aperture where the fill factor isn't stated, px. A smaller one loses three quarters of the light.
LEAST_SIDE_PX = 0.5
#: Relative error of the MTF50 of an edge by its estimate, beyond noise: at most 0.4 % from 0.5 to 85 degrees.
ESTIMATE_ERROR = 0.005


_AVERAGED = "the repeats may be averaged, denoised or compressed; record single raw frames"
_SCALED = "codes may be scaled up, or gain_db isn't stated; correct bit_depth or gain_db"
_RESIZED = "frames may be resized, or binned in one direction; give them as they were read out"
_CROPPED = "the frames may be cropped off the axis, or the boards don't cover the frame; check them"
_SQUARES = f"square_mm or marker_mm may be {LENGTH_UNIT}"

#: Field of a result, or what is computed from several -> range.
FIGURES: dict[str, Plausible] = {
    # 8 bit over the 10^6 e of a large CCD: 2.5e-4 DN/e; 16 bit at the gain of an EMCCD or at ISO 100,000: 100 DN/e
    "conversion_gain_dn_per_e": Plausible(1e-5, 300.0, _AVERAGED, _SCALED),
    # the best skipper CCDs and photon-counting CMOS: 0.07 to 0.2 e; read-outs of infrared sensors: some 100 e
    "read_noise_e": Plausible(
        0.03, 3e3, _AVERAGED, "the light of the darks may vary, or frames aren't raw; record darks with a cap"
    ),
    # pixels of 0.5 um at a high gain: some 100 e; read-outs of infrared sensors: 10^7 e
    "full_well_e": Plausible(30.0, 1e8, _SCALED, _AVERAGED),
    # codes aren't negative, and rounding moves a mean by half a code at most. The upper limit is half of the range
    "black_level_dn": Plausible(
        -0.5, None,
        "the dark signal may not grow as the exposure, or exposures are misstated; check the darks",
        "the darks may be lit, or bit_depth or white_level_dn is misstated; check the cap and correct them",
    ),
    # leakage isn't negative. Uncooled infrared sensors: 10^7 e/s
    "dark_current_e_per_s": Plausible(
        0.0, 1e8,
        "the black level may be clamped on dark pixels, or the sensor cooled during the darks; check them",
        "the darks may be lit, or their exposures aren't in seconds; check the cap and exposure_s",
    ),
    # infrared sensors: some 1,000 e
    "dsnu_e": Plausible(None, 1e5, above="the darks may be lit; record them with a cap"),
    # of pixels, shading removed. Sensors of visible light: 0.2 to 3 %; infrared sensors: up to 15 %
    "prnu_percent": Plausible(
        None, 25.0, above="the flats may show dust, a scene or a pattern; light the sensor evenly, without a lens"
    ),
    # linear sensors: below 3 %; a tone curve with a gamma of 2.2: 30 %
    "linearity_error_percent": Plausible(
        None, 10.0, above="codes may follow a tone curve (gamma), or exposures or photons are misstated; check them"
    ),
    # an electron needs a photon; below 1 % a sensor is hardly of use in that light
    "quantum_efficiency": Plausible(
        0.01, 1.0,
        "the stated light may be too strong (photons of a second, or of the whole sensor?), or of a wavelength that "
        "the sensor hardly sees; check the numbers of photons",
        "there can't be more electrons than photons: the stated light is too weak (photons are those of one pixel in "
        "one exposure), or K is too small as repeats were averaged or denoised; correct them",
    ),
    # silicon: activation energies of 0.5 to 1.2 eV, 5 to 13 C at room temperature
    "doubling_temperature_c": Plausible(
        2.0, 40.0,
        "temperature_c may not be that of the sensor; check it",
        "temperature_c may not be that of the sensor; check it",
    ),
    # a lens covers from half a degree to 80 degrees off its axis over half of the frame's diagonal
    "focal length over the frame's diagonal": Plausible(
        0.5 / math.tan(math.radians(80.0)), 0.5 / math.tan(math.radians(0.5)),
        "a pinhole doesn't describe a lens of so wide a field, or all boards stand straight; tilt them, or fit a "
        "fisheye model",
        "all boards may stand straight before the camera; tilt them by some 30 degrees",
    ),
    # lithography makes square pixels; lenses that aren't anamorphic keep them to 1 %
    "focal length x over y": Plausible(0.97, 1.03, _RESIZED, _RESIZED),
    # focal lengths are engraved within 5 to 10 %; a board that fills the frame at a quarter of its size adds 25 %
    "focal length over the stated one": Plausible(
        0.85, 1.35,
        "frames may be binned or resized, or focal_length_mm or pixel_pitch_um is misstated; correct it",
        "focal_length_mm or pixel_pitch_um may be misstated, or the lens is focused nearer than four focal lengths; "
        "correct it",
    ),
    # shares of the frame's width and height; shift lenses and crops of a part of the sensor move it farther
    "principal point x over the width": Plausible(0.25, 0.75, _CROPPED, _CROPPED),
    "principal point y over the height": Plausible(0.25, 0.75, _CROPPED, _CROPPED),
    # pairs of one module: some mm; pairs on vehicles: a few m
    "baseline_mm": Plausible(1.0, 1e4, _SQUARES, _SQUARES),
    # light only adds up: a point-spread function without negative values has its highest modulation at frequency 0
    "mtf": Plausible(
        None, 1.0, above="the camera may sharpen, or codes may follow a tone curve; switch processing off"
    ),
    # the upper limit is that of the pixel's aperture and of diffraction
    "mtf50_cy_per_px": Plausible(
        None, 1.0,
        above="the camera may sharpen, codes may follow a tone curve, or f_number, pixel_pitch_um or fill_factor is "
        "misstated; switch processing off and correct them",
    ),
}  # fmt: skip


def implausible_figures(
    fit: FitResult, sheets: Mapping[Side, DataSheet], squares_mm: Sequence[float] = ()
) -> tuple[str, ...]:
    """Return a line for each figure of a fit, and each length of the data sheets and the boards, outside its range."""
    lines = [
        f"{side}: {line}"
        for side, camera in fit.cameras.items()
        for line in (*_of_sheet(sheets[side]), *_of_camera(camera, sheets[side]))
    ]
    boards = [STATED["square_mm"].sentence("square_mm", size, None, "mm") for size in dict.fromkeys(squares_mm)]
    lines += [f"boards: {line}" for line in boards if line]
    lines += [f"stereo: {line}" for line in _of_pair(fit.stereo)]
    return tuple(dict.fromkeys(lines))


def _of_sheet(sheet: DataSheet) -> Iterator[str]:
    highest = 2.0**sheet.bit_depth - 1.0
    values = {name: getattr(sheet, name, None) for name in STATED}
    if sheet.white_level_dn is not None:
        values["white_level_dn over the highest code"] = sheet.white_level_dn / highest
    for name, value in values.items():
        unit = next((unit for end, unit in (("_um", "um"), ("_mm", "mm")) if name.endswith(end)), "1")
        if value is not None and (line := STATED[name].sentence(name, value, None, unit)):
            yield line


def _of_camera(fit: CameraFit, sheet: DataSheet) -> Iterator[str]:
    if fit.noise is not None:
        yield from _of_noise(fit.noise, sheet)
    if fit.spectral is not None:
        yield from _of_curves(fit.spectral)
    yield from _of_edges(fit.mtf, sheet)
    if fit.geometry is not None:
        yield from _of_geometry(fit.geometry, sheet)


def _of_noise(noise: NoiseFit, sheet: DataSheet) -> Iterator[str]:
    black = sheet.black_level_dn or 0.0
    middle = replace(FIGURES["black_level_dn"], upper=black + 0.5 * (sheet.saturation_dn - black))
    for name, limits in (FIGURES | {"black_level_dn": middle}).items():
        value = getattr(noise, name, None)
        if value is None:
            continue
        title, nm = plain_name(name), noise.quantum_efficiency_wavelength_nm
        if name == "quantum_efficiency" and nm is not None:
            title += f" at {nm:g} nm"
        if line := limits.sentence(title, value, getattr(noise, f"{name}_std"), unit_of(name)):
            yield line
    law, limits = noise.dark_current_temperature, FIGURES["doubling_temperature_c"]
    if law is not None and law.doubling_temperature_c is not None:
        title = plain_name("doubling_temperature_c")
        if line := limits.sentence(title, law.doubling_temperature_c, law.doubling_temperature_c_std, "C"):
            yield line
    if noise.quantum_efficiency is None:  # of a colour camera, whose planes may be dark in this light: of the best
        planes = [
            (figures.quantum_efficiency, name) for name, figures in noise.emva1288.items() if figures.quantum_efficiency
        ]
        if planes:
            name = max(planes)[1]
            title = f"{plain_name('quantum_efficiency')} {name}"
            figures = noise.emva1288[name]
            if line := FIGURES["quantum_efficiency"].sentence(
                title, figures.quantum_efficiency or 0.0, figures.quantum_efficiency_std
            ):
                yield line


def _of_curves(fit: SpectralFit) -> Iterator[str]:
    """Judge the peak of each channel's curve; below 1 % all channels have to be, as one may be filtered."""
    limits = FIGURES["quantum_efficiency"]
    peaks = {channel: int(np.argmax(curve)) for channel, curve in fit.quantum_efficiency.items() if curve}

    def peak(channel: str) -> tuple[float, float]:
        stds = fit.quantum_efficiency_std.get(channel)
        return fit.quantum_efficiency[channel][peaks[channel]], stds[peaks[channel]] if stds else 0.0

    all_dark = all(limits.is_below(*peak(channel)) for channel in peaks)
    for channel, number in peaks.items():
        name = f"peak {plain_name('quantum_efficiency')} {channel} at {fit.wavelength_nm[number]:g} nm"
        if (all_dark or limits.is_above(*peak(channel))) and (line := limits.sentence(name, *peak(channel))):
            yield line


def _of_edges(curves: Sequence[MtfCurve], sheet: DataSheet) -> Iterator[str]:
    """Judge each channel's median edge: of many edges, the noise alone puts some above a limit."""
    for channel in dict.fromkeys(curve.channel for curve in curves):
        excesses = []
        for curve in curves:
            if curve.channel == channel and curve.mtf50_cy_per_px is not None:
                limit = highest_mtf50_cy_per_px(sheet, curve.angle_deg)
                std = math.hypot(curve.mtf50_cy_per_px_std or 0.0, ESTIMATE_ERROR * limit)
                excesses.append(
                    ((curve.mtf50_cy_per_px - limit) / std, curve.capture, curve.mtf50_cy_per_px, std, limit)
                )
        peaks = [_peak_over_one(curve) for curve in curves if curve.channel == channel and curve.mtf]
        if peaks:
            _, capture, value, std = median_low(peaks)
            if line := FIGURES["mtf"].sentence(f"highest MTF {channel} of {capture}", value, std):
                yield line
        if not excesses:
            continue
        _, capture, value, std, limit = median_low(excesses)
        limits = replace(FIGURES["mtf50_cy_per_px"], upper=min(limit, 1.0))
        if line := limits.sentence(f"{plain_name('mtf50_cy_per_px')} {channel} of {capture}", value, std, "cy/px"):
            yield line


def _peak_over_one(curve: MtfCurve) -> tuple[float, str, float, float]:
    """Return by how many standard deviations the highest modulation of an edge up to Nyquist's frequency is above 1,
    its capture, the modulation, and its standard deviation."""
    below = np.array(curve.frequency_cy_per_px) <= 0.5
    value, std = np.array(curve.mtf)[below], np.hypot(np.array(curve.mtf_std)[below], ESTIMATE_ERROR)
    at = int(np.argmax((value - 1.0) / std))
    return float((value[at] - 1.0) / std[at]), curve.capture, float(value[at]), float(std[at])


def highest_mtf50_cy_per_px(sheet: DataSheet, angle_deg: float = 0.0) -> float:
    """Return the MTF50 of a lens without error before this sensor, for an edge at an angle to the columns.

    The pixel's aperture is the stated one, else a quarter of the pixel; f-number and pitch count where both are stated.

    >>> from lab.formats.recording_set import DataSheet
    >>> sheet = DataSheet(rows=480, cols=640, cfa="MONO", bit_depth=12, fill_factor=1.0)
    >>> round(highest_mtf50_cy_per_px(sheet), 3)  # sinc(0.603) = 0.5
    0.603
    """
    fill, angle = sheet.fill_factor or LEAST_SIDE_PX**2, math.radians(angle_deg)

    def above_half(frequency: float) -> float:
        mtf = float(aperture_otf(frequency * math.cos(angle), frequency * math.sin(angle), fill))
        if sheet.f_number is not None and sheet.pixel_pitch_um is not None:
            mtf *= float(diffraction_otf(frequency / sheet.pixel_pitch_um, SHORTEST_NM, sheet.f_number))
        return mtf - 0.5

    # at this frequency an aperture of side w has sinc(w f) = 0 along an axis, and sinc^2(1 / sqrt(2)) = 0.13 at 45 deg
    return float(optimize.brentq(above_half, 0.0, 1.0 / math.sqrt(fill)))


def _of_geometry(fit: GeometryFit, sheet: DataSheet) -> Iterator[str]:
    matrix, std = np.array(fit.camera_matrix), np.array(fit.camera_matrix_std or np.zeros((3, 3)))
    (fx, _, cx), (_, fy, cy) = matrix[:2]
    focal, focal_std = 0.5 * (fx + fy), float(np.hypot(std[0, 0], std[1, 1]) / 2.0)
    diagonal = math.hypot(sheet.rows, sheet.cols)
    values = {
        "focal length over the frame's diagonal": (focal / diagonal, focal_std / diagonal),
        "focal length x over y": (fx / fy, float(np.hypot(std[0, 0] / fy, fx * std[1, 1] / fy**2))),
        "principal point x over the width": (cx / sheet.cols, std[0, 2] / sheet.cols),
        "principal point y over the height": (cy / sheet.rows, std[1, 2] / sheet.rows),
    }
    if sheet.focal_length_mm is not None and sheet.pixel_pitch_um is not None:
        scale = 1e-3 * sheet.pixel_pitch_um / sheet.focal_length_mm
        values["focal length over the stated one"] = (focal * scale, focal_std * scale)
    for name, (value, value_std) in values.items():
        if line := FIGURES[name].sentence(name, float(value), float(value_std)):
            yield line


def _of_pair(fit: StereoFit | None) -> Iterator[str]:
    if fit is not None and (
        line := FIGURES["baseline_mm"].sentence(plain_name("baseline_mm"), fit.baseline_mm, fit.baseline_mm_std, "mm")
    ):
        yield line
