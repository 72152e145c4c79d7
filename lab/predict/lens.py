"""`calibench lens`: first-order quantities, illumination, distortion, MTF and PSF of a lens prescription."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from lab.errors import InputError
from lab.workers import Workers
from sim.optics.prescription import GlassName, Prescription, PrescriptionError
from sim.optics.table import LensTable
from sim.optics.zmx import read_zmx
from sim.parameters import Frozen

if TYPE_CHECKING:
    from sim.optics.system import Focus, OpticalSystem

Progress = Callable[[str, float], None]

MTF_LP_PER_MM = (30.0, 60.0, 100.0)
MTF_WAVELENGTHS_NM = (450.0, 650.0)  # and the reference wavelength
#: Share of the computing time that the MTFs take, for the progress bar.
_MTF_SHARE = 0.3


class LensPsf(Frozen):
    """The image of a field point at one wavelength: its centroid, and the share of its light in the window of the lens
    table."""

    wavelength_nm: float
    encircled_share: float
    centroid_um: tuple[float, float]  # (x, y) from the reference wavelength's chief ray


class LensMtf(Frozen):
    """MTF of a field point at one wavelength, from the traced pupil: no window, no pixel."""

    wavelength_nm: float
    frequency_lp_per_mm: tuple[float, ...]
    sagittal: tuple[float, ...]
    tangential: tuple[float, ...]


class LensField(Frozen):
    """One field point, on the +y side of the axis."""

    angle_deg: float
    height_mm: float
    relative_illumination: float
    distortion_percent: float
    psf: tuple[LensPsf, ...]
    mtf: tuple[LensMtf, ...]


class LensResult(Frozen):
    """First-order quantities at the file's primary wavelength; fields at the reference wavelength."""

    format: Literal["calibench-lens"] = "calibench-lens"
    version: Literal[1] = 1
    name: str
    focal_length_mm: float
    f_number: float
    working_f_number: float
    back_focus_mm: float
    entrance_pupil_mm: float
    entrance_pupil_position_mm: float
    exit_pupil_mm: float | None
    exit_pupil_position_mm: float | None
    primary_wavelength_nm: float
    reference_wavelength_nm: float
    object_distance_mm: float | None
    image_shift_mm: float
    maximum_field_deg: float
    sample_pitch_um: float
    warnings: tuple[str, ...]
    fields: tuple[LensField, ...]


@dataclass(frozen=True)
class TracedPrescription:
    """A result with the traced table and system, for the report's pictures."""

    result: LensResult
    table: LensTable
    system: OpticalSystem


def parse_glasses(replacements: list[str]) -> dict[str, GlassName]:
    """Replacement glasses by name, from NAME=OTHER or NAME=nd,Vd. Raises InputError for anything else."""
    glasses: dict[str, GlassName] = {}
    for text in replacements:
        name, equals, meaning = (part.strip() for part in text.partition("="))
        if not (name and equals and meaning):
            raise InputError(f"--glass {text}: give NAME=OTHER or NAME=nd,Vd, as in L-TIM28_MOLD=L-TIM28")
        first, comma, second = meaning.partition(",")
        if not comma:
            glasses[name.upper()] = GlassName(name=meaning.upper())
            continue
        try:
            index, abbe = float(first), float(second)
        except ValueError:
            raise InputError(f"--glass {text}: nd and Vd aren't numbers; give them as in 1.5168,64.2") from None
        if not (1.0 < index < 5.0 and 0.0 < abbe < math.inf):
            raise InputError(f"--glass {text}: nd has to lie above 1 and Vd above 0; correct them")
        glasses[name.upper()] = GlassName(name=f"nd {index:g} Vd {abbe:g}", model=True, index_d=index, abbe_d=abbe)
    return glasses


def with_glasses(prescription: Prescription, glasses: Mapping[str, GlassName]) -> Prescription:
    """Return the prescription with glasses replaced; each replacement is a warning. Raises InputError for a glass that
    it doesn't have."""
    present = {surface.glass.name for surface in prescription.surfaces if surface.glass is not None}
    for name in glasses:
        if name not in present:
            raise InputError(f"--glass {name}: no surface is of that glass; the lens has {', '.join(sorted(present))}")
    surfaces = tuple(
        surface.model_copy(update={"glass": glasses.get(surface.glass.name, surface.glass)})
        if surface.glass is not None
        else surface
        for surface in prescription.surfaces
    )
    lines = tuple(f"the glass {name} is taken as {glass.name}, as asked for" for name, glass in glasses.items())
    return prescription.model_copy(
        update={"surfaces": surfaces, "warnings": (*prescription.warnings, *lines)}, deep=False
    )


def trace_prescription(
    file: Path,
    *,
    focus: Focus = "file",
    maximum_field_deg: float | None = None,
    glasses: Mapping[str, GlassName] | None = None,
    progress: Progress | None = None,
    workers: Workers | None = None,
) -> TracedPrescription:
    """Read and trace a prescription: results at 33 wavelengths and 21 field points.

    `workers`: where the field points are traced; None: in this process. Raises InputError for a file that can't be read
    or traced."""
    from sim.optics.system import OpticalSystem  # imports compiled code, which takes a second
    from sim.optics.traced_table import OpticalTable, TableSettings

    try:
        prescription = read_zmx(file)
        if glasses:
            prescription = with_glasses(prescription, glasses)
        system = OpticalSystem(prescription, focus)
        settings = TableSettings(focus=focus, maximum_field_deg=maximum_field_deg, line=True)
        low, high = settings.wavelength_nm[0], settings.wavelength_nm[-1]
        if not low <= system.reference_nm <= high:
            wavelengths_nm = sorted({*prescription.wavelength_nm, system.reference_nm})
            spread = (
                np.linspace(wavelengths_nm[0], wavelengths_nm[-1], 33)
                if len(wavelengths_nm) > 1
                else np.array(wavelengths_nm)
            )
            settings = settings.model_copy(update={"wavelength_nm": tuple(float(w) for w in spread)})
        work = OpticalTable(system, settings)
        workers = workers or Workers()
        table = work.table(
            None if progress is None else lambda text, share: progress(text, share * (1 - _MTF_SHARE)), workers.done
        )
        fields = _fields(system, table, workers, progress)
    except PrescriptionError as error:
        message = str(error)
        raise InputError(message if str(file) in message else f"{file}: {message}") from error
    first = system.first_order
    finite_exit = math.isfinite(first.exit_pupil_mm)
    result = LensResult(
        name=prescription.name,
        focal_length_mm=first.focal_length_mm,
        f_number=first.f_number,
        working_f_number=first.working_f_number,
        back_focus_mm=first.back_focus_mm,
        entrance_pupil_mm=first.entrance_pupil_mm,
        entrance_pupil_position_mm=first.entrance_pupil_position_mm,
        exit_pupil_mm=first.exit_pupil_mm if finite_exit else None,
        exit_pupil_position_mm=first.exit_pupil_position_mm if finite_exit else None,
        primary_wavelength_nm=system.primary_nm,
        reference_wavelength_nm=system.reference_nm,
        object_distance_mm=prescription.object_distance_mm,
        image_shift_mm=system.image_shift_mm,
        maximum_field_deg=float(table.field_deg[-1, 1]),
        sample_pitch_um=table.sample_pitch_um,
        warnings=table.warnings,
        fields=fields,
    )
    return TracedPrescription(result, table, system)


def _fields(
    system: OpticalSystem, table: LensTable, workers: Workers, progress: Progress | None
) -> tuple[LensField, ...]:
    low, high = table.wavelength_nm[0], table.wavelength_nm[-1]
    wavelengths = sorted({system.reference_nm, *(w for w in MTF_WAVELENGTHS_NM if low <= w <= high)})
    tangents = [math.tan(math.radians(float(angle))) for angle in table.field_deg[:, 1]]
    curves: dict[int, tuple[LensMtf, ...]] = {}
    for f, at_field in workers.done(_mtf_curves, tangents, system, wavelengths):
        curves[f] = at_field
        if progress is not None:
            progress(
                f"MTF of field {len(curves)} of {len(tangents)}",
                1 - _MTF_SHARE + _MTF_SHARE * len(curves) / len(tangents),
            )
    return tuple(_field(system, table, f, curves[f]) for f in range(len(tangents)))


def _mtf_curves(tangent: float, system: OpticalSystem, wavelengths_nm: Sequence[float]) -> tuple[LensMtf, ...]:
    """MTF of a field point on the +y side at each wavelength."""
    curves = []
    for w in wavelengths_nm:
        sagittal, tangential = system.mtf((0.0, tangent), w, MTF_LP_PER_MM)
        curves.append(
            LensMtf(
                wavelength_nm=w,
                frequency_lp_per_mm=MTF_LP_PER_MM,
                sagittal=tuple(sagittal.tolist()),
                tangential=tuple(tangential.tolist()),
            )
        )
    return tuple(curves)


def _field(system: OpticalSystem, table: LensTable, f: int, curves: tuple[LensMtf, ...]) -> LensField:
    angle = float(table.field_deg[f, 1])
    tangent = math.tan(math.radians(angle))
    height = float(table.chief_mm[f, 1])
    ideal = system.ideal_height_mm(tangent)
    axis = float(table.chief_mm[0, 1])
    return LensField(
        angle_deg=angle,
        height_mm=height,
        relative_illumination=float(
            np.interp(system.reference_nm, table.wavelength_nm, table.relative_illumination[:, f])
        ),
        distortion_percent=100.0 * ((height - axis) / ideal - 1.0) if f else 0.0,
        psf=tuple(
            LensPsf(
                wavelength_nm=float(w),
                encircled_share=float(table.encircled_share[i, f]),
                centroid_um=(float(table.centroid_um[i, f, 0]), float(table.centroid_um[i, f, 1])),
            )
            for i, w in enumerate(table.wavelength_nm)
        ),
        mtf=curves,
    )
