"""Lights: colour-science's illuminants and displays, and radiance to luminance and back."""

from __future__ import annotations

import warnings
from functools import cache
from types import ModuleType

import numpy as np

from sim.extensions import extensions, refuse
from sim.scene.screen import Screen, SubPixels
from sim.spectrum import FloatArray, Spectrum

#: Luminous efficacy of the SI, lm/W: luminance = 683 x integral of radiance x V.
LUMENS_PER_WATT = 683.0


def colour_science() -> ModuleType:
    """Return the library, imported on first use: it takes a second to load."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns at import that it can't draw
        import colour
    return colour


@cache
def _photopic() -> Spectrum:
    curve = colour_science().SDS_LEFS["CIE 1924 Photopic Standard Observer"]
    return Spectrum.of(curve.wavelengths, curve.values)


def luminance_cd_m2(radiance: Spectrum) -> float:
    """Compute the luminance of a radiance, 683 lm/W x integral of L V, V of the CIE's observer of 1924.

    radiance : L, W sr^-1 m^-2 nm^-1

    Returns cd/m^2.

    >>> round(luminance_cd_m2(Spectrum.of([554.5, 555.0, 555.5], [0.0, 2.0, 0.0])), 1)  # 1 W/(sr m^2) where V is 1
    683.0
    """
    photopic = _photopic()
    knots = np.unique(np.concatenate([radiance.arrays[0], photopic.arrays[0]]))
    # both are linear between the knots: Simpson's rule is exact for their product
    middle = 0.5 * (knots[1:] + knots[:-1])
    ends, within = (radiance.at(w) * photopic.at(w) for w in (knots, middle))
    return float(LUMENS_PER_WATT * np.sum(np.diff(knots) * (ends[:-1] + 4.0 * within + ends[1:])) / 6.0)


def at_luminance(curve: Spectrum, wanted_cd_m2: float) -> Spectrum:
    """Scale a spectral curve of any unit to a luminance.

    curve : any unit over nm; wanted_cd_m2 : cd/m^2

    Returns W sr^-1 m^-2 nm^-1. Raises ValueError for a curve without visible light.

    >>> round(luminance_cd_m2(at_luminance(Spectrum.of([400.0, 700.0], [1.0, 1.0]), 100.0)), 6)
    100.0
    """
    if not (np.isfinite(wanted_cd_m2) and wanted_cd_m2 >= 0):
        raise ValueError(f"luminance {wanted_cd_m2} cd/m^2 is below the limit of 0 or not finite: give cd/m^2")
    has = luminance_cd_m2(curve)
    if not has > 0:
        raise ValueError(
            f"a light of {has:g} cd/m^2 between {curve.wavelength_nm[0]:g} and {curve.wavelength_nm[-1]:g} nm can't be "
            f"scaled to {wanted_cd_m2:g} cd/m^2: it needs visible light above 0; state its radiance instead"
        )
    return curve.scale(wanted_cd_m2 / has)


def _load_illuminants() -> dict[str, Spectrum]:
    """Return the illuminants of other packages, by name in small letters: entry points of `calibench.illuminants` that
    are spectra."""
    illuminants = {}
    for name, spectrum in extensions("illuminants"):
        if isinstance(spectrum, Spectrum):
            illuminants[name.lower()] = spectrum
        else:
            refuse("illuminants", name, f"{spectrum!r} is no sim.spectrum.Spectrum")
    return illuminants


def illuminant(name: str, luminance_cd_m2: float) -> Spectrum:
    """Compute the radiance of a perfect white diffuser under a named illuminant.

    name : D65, A, FL2, LED-B1, ... (colour-science's), or an entry point of `calibench.illuminants`
    luminance_cd_m2 : cd/m^2

    Returns W sr^-1 m^-2 nm^-1. Raises ValueError that lists the names for one that isn't known.

    >>> round(luminance_cd_m2(illuminant("D65", 100.0)), 6)
    100.0
    """
    known = colour_science().SDS_ILLUMINANTS
    matching = {key.lower(): key for key in known}
    added = _load_illuminants()
    if name.lower() not in matching and name.lower() in added:
        return at_luminance(added[name.lower()], luminance_cd_m2)
    if name.lower() not in matching:
        names = ", ".join([*known, *added])
        raise ValueError(f"illuminant {name!r} is not known: name one of {names}, or a CSV file of a measured light")
    curve = known[matching[name.lower()]]
    return at_luminance(Spectrum.of(curve.wavelengths, curve.values), luminance_cd_m2)


def screen(
    white_cd_m2: float = 120.0,
    contrast_ratio: float = 1000.0,
    gamma: tuple[float, float, float] = (2.2, 2.2, 2.2),
    falloff_exponent: float = 0.0,
    sub_pixels: SubPixels | None = None,
) -> Screen:
    """Return a liquid-crystal screen with the measured primaries of colour-science's "Apple Studio Display", white of
    `white_cd_m2`, black of white / `contrast_ratio` in white's colour.
    """
    if not contrast_ratio > 1:
        raise ValueError(
            f"the screen's contrast ratio is {contrast_ratio}, not above the limit of 1: give white over black"
        )
    measured = colour_science().MSDS_DISPLAY_PRIMARIES["Apple Studio Display"]
    curves: FloatArray = np.asarray(measured.values).T
    total = Spectrum.of(measured.wavelengths, np.sum(curves, axis=0))
    factor = white_cd_m2 / luminance_cd_m2(total)
    lit = factor * (1.0 - 1.0 / contrast_ratio)
    red, green, blue = (Spectrum.of(measured.wavelengths, curve * lit) for curve in curves)
    return Screen(
        primaries=(red, green, blue),
        black_radiance=total.scale(factor / contrast_ratio),
        gamma=gamma,
        falloff_exponent=falloff_exponent,
        sub_pixels=sub_pixels,
    )
