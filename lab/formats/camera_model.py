"""The baseline camera model, from the data sheet and the fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lab.formats.recording_set import DataSheet, RecordingSet
from lab.formats.results import CameraFit
from lab.formats.results.plausible import FIGURES
from lab.formats.results.words import format_value, unit_of
from sim.camera import CameraModel, Geometry, Lens, Side
from sim.spectrum import Spectrum

USUAL_PITCH_UM = 3.5  # where the pixel pitch isn't stated
#: Gaussian sensitivity curves where neither fit nor data sheet has one, for the colour of edges and screens only:
#: (wavelength of the peak, standard deviation), nm.
TYPICAL_SENSITIVITY_NM = {"R": (600.0, 40.0), "G": (535.0, 40.0), "B": (460.0, 30.0), "Y": (550.0, 90.0)}


@dataclass(frozen=True)
class Assumed:
    """A quantity that is neither stated nor fitted, and the value that the model takes."""

    quantity: str
    value: str


def camera_model(
    recordings: RecordingSet, side: Side, fit: CameraFit | None = None, *, maker_curves: bool = False
) -> CameraModel:
    """Return the baseline model of one camera. Each quantity is the fitted one, else the stated one, else a typical
    value (`assumptions`).

    `maker_curves`: take the stated sensitivity curves even where they were fitted, as a diagnosis tests them.
    """
    camera = recordings.camera(side)
    noise = fit.noise if fit is not None else None

    def first(name: str, default: float) -> float:
        for source in (noise, camera):
            value = getattr(source, name, None)
            if value is not None:
                return float(value)
        return default

    white = camera.white_level_dn if camera.white_level_dn is not None else 2.0**camera.bit_depth - 1.0
    black = first("black_level_dn", 0.0)
    gain = first("conversion_gain_dn_per_e", 1.0)
    geometry = None
    if fit is not None and fit.geometry is not None:
        fitted = fit.geometry
        geometry = Geometry(
            camera_matrix=fitted.camera_matrix,
            distortion=fitted.distortion,
            projection=fitted.lens_projection,
            spline_angle_deg=fitted.spline_angle_deg,
        )
    curves, spread = _curves(recordings, side, fit, maker_curves)
    return CameraModel(
        rows=camera.rows,
        cols=camera.cols,
        pixel_pitch_um=camera.pixel_pitch_um if camera.pixel_pitch_um is not None else USUAL_PITCH_UM,
        fill_factor=camera.fill_factor if camera.fill_factor is not None else 1.0,
        cfa=camera.cfa,
        bit_depth=camera.bit_depth,
        black_level_dn=max(black, 0.0),
        white_level_dn=white,
        conversion_gain_dn_per_e=gain,
        full_well_e=first("full_well_e", max((white - black) / gain, 1.0)),
        read_noise_e=first("read_noise_e", 0.0),
        dark_current_e_per_s=max(first("dark_current_e_per_s", 0.0), 0.0),
        dsnu_e=first("dsnu_e", 0.0),
        prnu_percent=first("prnu_percent", 0.0),
        quantum_efficiency=curves,
        quantum_efficiency_std=spread,
        lens=Lens(
            f_number=camera.f_number if camera.f_number is not None else 8.0,
            focal_length_mm=camera.focal_length_mm,
            transmittance=camera.lens_transmittance if camera.lens_transmittance is not None else 1.0,
        ),
        geometry=geometry,
        shutter=camera.shutter,
    )


def assumptions(camera: DataSheet, fit: CameraFit | None = None) -> tuple[Assumed, ...]:
    """Return the quantities for which `camera_model` takes typical values, given this data sheet and fit."""
    assumed = []
    if camera.f_number is None:
        assumed.append(Assumed("f_number", "8"))
    if camera.focal_length_mm is None:
        assumed.append(Assumed("focal_length_mm", "no fall-off of the light"))
    if camera.lens_transmittance is None:
        assumed.append(Assumed("lens_transmittance", "1"))
    if camera.pixel_pitch_um is None:
        assumed.append(Assumed("pixel_pitch_um", f"{USUAL_PITCH_UM:g}"))
    if camera.fill_factor is None:
        assumed.append(Assumed("fill_factor", "1"))
    unknown = set(camera.channels) - set(camera.quantum_efficiency or {})
    if fit is not None and fit.spectral is not None:
        unknown -= set(fit.spectral.quantum_efficiency)
    if unknown:
        assumed.append(Assumed("quantum_efficiency", f"typical curves{_how_scaled(fit)}"))
    return tuple(assumed)


def _how_scaled(fit: CameraFit | None) -> str:
    """Say what a measured quantum efficiency does to the typical curve of a MONO sensor."""
    noise = fit.noise if fit is not None else None
    if noise is None or noise.quantum_efficiency is None:
        return ""
    nm = noise.quantum_efficiency_wavelength_nm
    measured = format_value(noise.quantum_efficiency, noise.quantum_efficiency_std)
    if nm is None:
        return f" (the measured {measured} isn't used: the wavelength of its light isn't stated)"
    at_nm = _measured_efficiency(fit)
    if at_nm is None:
        return f" (the measured {measured} at {nm:g} nm isn't used: it is beyond 0..1)"
    limited = ", limited to 1" if _peak_level(*at_nm) > 1.0 or at_nm[1] != noise.quantum_efficiency else ""
    return f", scaled to {at_nm[1]:.4g} as measured at {nm:g} nm{limited}"


#: Figures of the noise that a model needs, whether or not they are known.
NOISE_FIGURES = (
    "black_level_dn",
    "conversion_gain_dn_per_e",
    "full_well_e",
    "read_noise_e",
    "dark_current_e_per_s",
    "dsnu_e",
    "prnu_percent",
)


def assumed_noise(camera: DataSheet, fit: CameraFit | None, model: CameraModel) -> tuple[Assumed, ...]:
    """Return the figures of the noise that `camera_model` takes though neither this data sheet nor the fit has them."""
    noise = fit.noise if fit is not None else None
    return tuple(
        Assumed(name, f"{getattr(model, name):.6g}")
        for name in NOISE_FIGURES
        if getattr(noise, name, None) is None and getattr(camera, name) is None
    )


def limited_values(fit: CameraFit | None) -> tuple[str, ...]:
    """Return a line for each fitted value that a camera can't have and `camera_model` therefore changes, or that
    `read_camera` refuses."""
    remarks = []
    noise, spectral = (fit.noise, fit.spectral) if fit is not None else (None, None)
    for name in ("black_level_dn", "dark_current_e_per_s"):
        value = getattr(noise, name, None)
        if value is not None and value < 0.0:
            text = format_value(value, getattr(noise, f"{name}_std"), unit_of(name))
            remarks.append(f"{name}: the fitted {text} is below the limit of 0; written as 0")
    for channel, curve in (spectral.quantum_efficiency if spectral is not None else {}).items():
        if (below := sum(value < 0.0 for value in curve)) > 0:
            remarks.append(
                f"quantum_efficiency.{channel}: {below} of {len(curve)} fitted values are below the limit of 0, down "
                f"to {min(curve):.2g}; written as 0"
            )
        if max(curve) > 1.0:
            remarks.append(
                f"quantum_efficiency.{channel}: fitted values up to {max(curve):.4g} are above the limit of 1 electron "
                "a photon; a camera file with them is refused: correct the stated light and fit again"
            )
    return tuple(remarks)


def remarks_on_values(camera: DataSheet, fit: CameraFit | None, model: CameraModel) -> tuple[str, ...]:
    """Return a line for each value of a model that nobody stated or fitted, and for each that isn't the fitted one."""
    assumed = (*assumptions(camera, fit), *assumed_noise(camera, fit, model))
    taken = (f"{value.quantity}: neither fitted nor stated; taken as {value.value}" for value in assumed)
    return (*taken, *limited_values(fit))


def _curves(
    recordings: RecordingSet, side: Side, fit: CameraFit | None, maker_curves: bool
) -> tuple[dict[str, Spectrum], dict[str, Spectrum]]:
    """Quantum efficiency by channel, and its standard deviation where it was fitted."""
    camera = recordings.camera(side)
    fitted = fit.spectral if fit is not None else None
    channels = ("Y",) if camera.cfa == "MONO" else ("R", "G", "B")
    curves: dict[str, Spectrum] = {}
    spread: dict[str, Spectrum] = {}
    for channel in channels:
        stated = (camera.quantum_efficiency or {}).get(channel)
        if fitted is not None and channel in fitted.quantum_efficiency and not (maker_curves and stated):
            curve = Spectrum.of(fitted.wavelength_nm, np.maximum(fitted.quantum_efficiency[channel], 0.0))
            curves[channel] = _continue_curve(curve, recordings.spectrum(stated)) if stated else curve
            if channel in fitted.quantum_efficiency_std:
                spread[channel] = Spectrum.of(fitted.wavelength_nm, fitted.quantum_efficiency_std[channel])
        elif stated:
            curves[channel] = recordings.spectrum(stated)
        else:
            peak, width = TYPICAL_SENSITIVITY_NM[channel]
            grid = np.arange(380.0, 781.0, 5.0)
            shape = np.exp(-0.5 * ((grid - peak) / width) ** 2)
            at_nm = _measured_efficiency(fit) if channel == "Y" else None
            level = 0.5 if at_nm is None else _peak_level(*at_nm)
            curves[channel] = Spectrum.of(grid, np.minimum(level * shape, 1.0))
    return curves, spread


def _measured_efficiency(fit: CameraFit | None) -> tuple[float, float] | None:
    """Wavelength (nm) and quantum efficiency that the noise fit measured by stated photon numbers, at most 1; None
    where it has none, or an impossible one."""
    noise = fit.noise if fit is not None else None
    if noise is None or noise.quantum_efficiency is None or noise.quantum_efficiency_wavelength_nm is None:
        return None
    value, std = noise.quantum_efficiency, noise.quantum_efficiency_std
    if value <= 0.0 or FIGURES["quantum_efficiency"].is_above(value, std):
        return None
    return noise.quantum_efficiency_wavelength_nm, min(value, 1.0)


def _peak_level(wavelength_nm: float, efficiency: float) -> float:
    """Return the peak of the typical curve of a MONO sensor that has this efficiency at this wavelength."""
    peak, width = TYPICAL_SENSITIVITY_NM["Y"]
    return efficiency / float(np.exp(-0.5 * ((wavelength_nm - peak) / width) ** 2))


def _continue_curve(fitted: Spectrum, stated: Spectrum) -> Spectrum:
    """Return a fitted sensitivity, continued beyond the sweep's wavelengths by the maker's curve, scaled to join at
    both ends.

    A lamp emits beyond the sweep, too: without this, the last 10 nm at the red end can lack 8 % of a red channel's
    signal."""
    wavelength_nm, value = np.array(fitted.wavelength_nm), np.array(fitted.value)
    outer = np.array(stated.wavelength_nm)
    parts = []
    for beyond, end in ((outer < wavelength_nm[0], 0), (outer > wavelength_nm[-1], -1)):
        level = float(stated.at(wavelength_nm[end]))
        factor = value[end] / level if level > 0 else 0.0
        parts.append((outer[beyond], factor * stated.at(outer[beyond])))
    (before, low), (after, high) = parts
    return Spectrum.of(np.concatenate([before, wavelength_nm, after]), np.concatenate([low, value, high]))
