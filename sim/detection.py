"""Electrons detected, by wavelength: light x responsivity, on a quadrature rule that follows both.

What the three entries `sim.uniform`, `sim.point` and `sim.frame` have in common.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from sim.camera import CameraModel
from sim.optics.illumination import irradiance_factor
from sim.scene.render import LitSurface
from sim.spectrum import FloatArray, Spectrum, gauss_rule, photons_from_energy, quadrature
from sim.stages import Acts, Light, image_of, light_of


def responsivity(
    camera: CameraModel,
    channel: str,
    wavelength_nm: ArrayLike,
    effects: Sequence[Acts] = (),
    sin_theta: ArrayLike = 0.0,
) -> FloatArray:
    """Electrons per photon that would arrive at the image behind a lossless lens, by wavelength (nm).

    QE(wavelength) x lens transmittance x the effects' transmittance at the chief ray's `sin_theta`, which broadcasts
    against `wavelength_nm`. Raises ValueError for a channel the camera doesn't have.
    """
    wavelength_nm = np.asarray(wavelength_nm, float)
    value = efficiency(camera, channel).at(wavelength_nm) * camera.lens.transmittance
    return np.asarray(value * image_of(camera, effects).transmit(wavelength_nm, np.asarray(sin_theta, float)))


def efficiency(camera: CameraModel, channel: str) -> Spectrum:
    if channel not in camera.channels or channel not in camera.quantum_efficiency:
        raise ValueError(
            f"channel {channel!r} has no quantum efficiency in this {camera.cfa} camera (known: "
            f"{', '.join(camera.quantum_efficiency)}): add the curve or ask for another channel"
        )
    return camera.quantum_efficiency[channel]


def collection_m2_sr(camera: CameraModel, magnification: float = 0.0) -> float:
    """Radiance to a pixel's flux: irradiance factor x light-sensitive area."""
    area_m2 = (camera.pixel_pitch_um * 1e-6) ** 2 * camera.fill_factor
    return irradiance_factor(camera.lens.f_number, magnification) * area_m2


def detect_light(
    camera: CameraModel,
    channel: str,
    lights: Sequence[LitSurface],
    effects: Sequence[Acts],
    kind: str,
    sin_theta: FloatArray | float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Wavelengths (nm) and electrons detected at each: photons s^-1 m^-2 sr^-1 x responsivity x quadrature weight.

    The second is (lights, wavelengths), or (angles, lights, wavelengths) where `sin_theta` is (angles,).
    """
    curves = (curve for light in lights for curve in light if curve is not None)
    wavelength_nm, width = _rule(efficiency(camera, channel), *curves)
    before_lens = light_of(camera, effects)
    spectra: dict[int, FloatArray] = {}
    rows = []
    for radiance, reflectance in lights:
        if id(radiance) not in spectra:
            light = _at_lens(before_lens, radiance, wavelength_nm, kind)
            _check_radiance(wavelength_nm, light)
            spectra[id(radiance)] = light
        light = spectra[id(radiance)]
        rows.append(light if reflectance is None else light * reflectance.at(wavelength_nm))
    angles = np.asarray(sin_theta, float)[..., None, None]
    factor = responsivity(camera, channel, wavelength_nm, effects, angles) * width
    return wavelength_nm, photons_from_energy(wavelength_nm, np.stack(rows)) * factor


def _at_lens(light: Light, radiance: Spectrum | None, wavelength_nm: FloatArray, kind: str) -> FloatArray:
    """Radiance in front of the lens. What changes the light does so over the wavelengths at which it is stated,
    whatever the camera's reach; None: equal energy at all.
    """
    if radiance is None:
        return light.radiance(wavelength_nm, np.ones_like(wavelength_nm), kind)
    stated, _ = radiance.arrays
    if len(stated) < 2:  # nothing lies between its ends
        return np.zeros_like(wavelength_nm)
    inside = (wavelength_nm >= stated[0]) & (wavelength_nm <= stated[-1])
    radiance_at_lens = np.zeros_like(wavelength_nm)
    radiance_at_lens[inside] = light.radiance(wavelength_nm[inside], radiance.at(wavelength_nm[inside]), kind)
    return radiance_at_lens


@lru_cache(maxsize=256)
def _rule(*curves: Spectrum) -> tuple[FloatArray, FloatArray]:
    """`quadrature` of curves that whoever changes the effects asks for again."""
    rule = quadrature(curves)
    for part in rule:
        part.flags.writeable = False
    return rule


def _check_radiance(wavelength_nm: FloatArray, radiance: FloatArray) -> None:
    lowest = int(np.argmin(np.where(np.isfinite(radiance), radiance, -np.inf)))
    if not (radiance[lowest] >= 0 and np.isfinite(radiance[lowest])):
        raise ValueError(
            f"radiance is {radiance[lowest]:g} W sr^-1 m^-2 nm^-1 at {wavelength_nm[lowest]:g} nm, below the limit of "
            "0 or not finite: subtract the radiometer's dark reading, and set what stays below 0 to 0"
        )


def otf_wavelengths(
    camera: CameraModel, channel: str, wavelength_nm: FloatArray, weight: FloatArray, count: int
) -> tuple[FloatArray, FloatArray]:
    """Return a few wavelengths (nm) and shares (sum 1) over which to average the transfer function for detected light
    `weight`.
    """
    return gauss_rule(*otf_weight(camera, channel, wavelength_nm, weight), count)


def otf_weight(
    camera: CameraModel, channel: str, wavelength_nm: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Wavelengths (nm) and how much each counts (sum 1) in a transfer function, for detected light `weight`."""
    total = float(np.sum(weight))
    if not total > 0:
        # No light: any transfer function will do, and that of equal energy is the natural one.
        wavelength_nm, equal = detect_light(camera, channel, [(None, None)], (), "flat")
        weight, total = equal[0], float(np.sum(equal))
    if not total > 0:
        raise ValueError(
            f"quantum efficiency x lens transmittance of channel {channel!r} is 0 everywhere: give a curve above 0"
        )
    return wavelength_nm, weight / total


def check_finite(what: str, value: FloatArray, unit: str) -> None:
    if not np.all(np.isfinite(value)):
        bad = value[~np.isfinite(value)].flat[0]
        raise ValueError(f"{what} is {bad} {unit}, and has to be a finite number: leave such points out")
