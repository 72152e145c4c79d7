"""The lens table of a prescription, computed by ray tracing: chief rays, illumination and point spread functions over
field and wavelength.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim.optics import rays as rt
from sim.optics.planewaves import PupilRays, interpolate_rays, point_spread
from sim.optics.prescription import Prescription, PrescriptionError
from sim.optics.system import Focus, OpticalSystem, field_angles
from sim.optics.table import TABLE_VERSION, LensTable, load_cached, store_cached
from sim.parameters import Frozen
from sim.spectrum import FloatArray

#: Wavelengths of a lens table by default: 33.
TABLE_WAVELENGTHS_NM = tuple(float(w) for w in range(400, 721, 10))
#: Share of a point spread function's light within its window below which the table warns.
LEAST_SHARE = 0.9
_SPECTRAL_NODES = 8
#: Largest relative difference of solid angle between interpolated and traced pupils.
_SOLID_ANGLE_TOLERANCE = 3e-4
_STEEPEST = math.tan(math.radians(60.0))

Progress = Callable[[str, float], None]
Point = tuple[float, float]


@dataclass(frozen=True)
class TracedField:
    """Trace of one field point at w wavelengths.

    `chief_mm` (2,): the chief ray's place at the reference wavelength. `window_um` (2,): middle of the windows from
    there. `solid_angle` (w,), `centroid_um` (w, 2), `psf` (w, samples, samples).
    """

    chief_mm: FloatArray
    window_um: FloatArray
    solid_angle: FloatArray
    centroid_um: FloatArray
    psf: FloatArray
    warnings: tuple[str, ...]


#: Does a piece of work for each item, wherever that is; gives each item's number and result, in any order.
Each = Callable[
    [Callable[[tuple[Point, Point]], TracedField], Sequence[tuple[Point, Point]]], Iterable[tuple[int, TracedField]]
]


class TableSettings(Frozen):
    """Sampling of a lens table.

    `fields` field points from the centre to the corner along y, in equal steps of tan(theta) (of theta beyond 60 deg);
    or `grid` x `grid` of them where the lens isn't centred, unless `line` asks for the line. `maximum_field_deg` is
    the corner, None: the file's largest field. `sample_pitch_um` None: as fine as diffraction at the shortest
    wavelength needs. `focus`: whether the image lies where the file has it, or where the wavefront on the axis is
    flattest.
    """

    wavelength_nm: tuple[float, ...] = TABLE_WAVELENGTHS_NM
    fields: int = 21
    grid: int = 11
    line: bool = False
    maximum_field_deg: float | None = None
    samples: int = 64
    sample_pitch_um: float | None = None
    focus: Focus = "file"


def content_hash(prescription: Prescription, settings: TableSettings) -> str:
    """Hash of everything that a table depends on: the prescription, the settings and the version of the computation."""
    parts = [prescription.model_dump(mode="json"), settings.model_dump(mode="json"), TABLE_VERSION]
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:32]


def lens_table(
    prescription: Prescription,
    settings: TableSettings | None = None,
    progress: Progress | None = None,
    each: Each | None = None,
) -> LensTable:
    """Trace a lens and compute its `LensTable`. `each`: see `OpticalTable.table`. PrescriptionError where it makes no
    image.
    """
    settings = settings or TableSettings()
    return OpticalTable(OpticalSystem(prescription, settings.focus), settings).table(progress, each)


def read_or_trace_table(
    prescription: Prescription, folder: Path, settings: TableSettings | None = None, progress: Progress | None = None
) -> LensTable:
    """Return the table of a lens from the cache folder; computed and stored there where it is missing or damaged."""
    settings = settings or TableSettings()
    stored = load_cached(folder, content_hash(prescription, settings))
    if stored is not None:
        return stored
    table = lens_table(prescription, settings, progress)
    store_cached(folder, table)
    return table


class OpticalTable:
    """Field points and sampling of a lens table, and its computation."""

    def __init__(self, system: OpticalSystem, settings: TableSettings) -> None:
        self.system, self.settings = system, settings
        self.warnings: list[str] = []
        self.wavelengths = np.array(settings.wavelength_nm, float)
        if self.wavelengths.size == 0 or np.any(np.diff(self.wavelengths) <= 0):
            raise PrescriptionError(f"wavelengths {settings.wavelength_nm[:4]} don't ascend; sort them")
        system.prepare(self.wavelengths)
        self._nodes = _spectral_nodes(self.wavelengths)
        self.symmetric = system.prescription.is_centred
        self._line_only = self.symmetric or settings.line
        self.tangents = self._field_points()
        self.pitch_um = settings.sample_pitch_um or self._pitch()

    def _outermost(self) -> float:
        stated = self.settings.maximum_field_deg
        if stated is None:
            outermost = self.system.file_field_tangent()
            if outermost == 0.0:
                raise PrescriptionError(
                    "the file's only field is the axis; give the corner of the field in degrees, by --field-deg 10 of "
                    "calibench lens or by YFLN 0 10 in the file"
                )
            return outermost
        if not 0 < stated < 90:
            raise PrescriptionError(
                f"maximum field {stated:g} deg isn't between the limits of 0 and 90 deg; correct it"
            )
        return math.tan(math.radians(stated))

    def _line(self, outermost: float, count: int) -> list[float]:
        if outermost <= _STEEPEST:
            return [outermost * i / (count - 1) for i in range(count)]
        return [math.tan(math.atan(outermost) * i / (count - 1)) for i in range(count)]

    def _spokes(self) -> list[tuple[float, float]]:
        """Directions along which the field is checked out to its edge."""
        if self._line_only:
            return [(0.0, 1.0)]
        corner = math.sqrt(0.5)
        return [(corner * a, corner * b) for a in (-1.0, 1.0) for b in (-1.0, 1.0)]

    def _field_points(self) -> list[tuple[float, float]]:
        """Return the table's field points, limited to those that the lens images."""
        settings, outermost = self.settings, self._outermost()
        if min(settings.fields, settings.grid) < 2 and outermost > 0:
            raise PrescriptionError("a table needs two field points at least; ask for more")
        checked = sorted({self._nodes[0], self._nodes[-1], self.system.reference_nm})
        for spoke in self._spokes():
            outermost = self._find_limit(outermost, spoke, checked)
        if self._line_only:
            return [(0.0, t) for t in self._line(outermost, settings.fields)]
        half = self._line(outermost * math.sqrt(0.5), (settings.grid + 1) // 2)
        line = [-t for t in reversed(half[1:])] + half
        return [(tx, ty) for ty in line for tx in line]

    def _find_limit(self, outermost: float, spoke: tuple[float, float], wavelengths_nm: list[float]) -> float:
        """Largest tangent along a direction that the lens images, `outermost` at most; found by bisection."""

        def points(end: float) -> list[tuple[float, float]]:
            return [(spoke[0] * t, spoke[1] * t) for t in self._line(end, self.settings.fields)]

        count, reason = self.system.works(points(outermost), wavelengths_nm)
        if count == self.settings.fields:
            return outermost
        if count == 0:
            raise PrescriptionError(f"on the axis {reason}: the lens makes no image; check the apertures and the stop")
        line = self._line(outermost, self.settings.fields)
        low, high = line[max(count - 1, 0)], line[count]
        while high - low > 1e-4 * high:
            middle = 0.5 * (low + high)
            if self.system.works(points(middle), wavelengths_nm)[0] == self.settings.fields:
                low = middle
            else:
                high = middle
        if low <= 0:
            raise PrescriptionError(f"off the axis {reason}: the lens has no field; check the apertures and the stop")
        stated, reached = (math.degrees(math.atan(t)) for t in (outermost, low))
        self.warnings.append(f"the table ends at {reached:.2f} deg, not at {stated:.2f} deg: beyond, {reason}")
        return low

    def _pitch(self) -> float:
        """Sample pitch: wavelength N / 2 at the shortest wavelength, rounded down to steps of 0.05 um."""
        finest = 0.5e-3 * self.wavelengths[0] * self.system.first_order.working_f_number
        return max(0.05 * math.floor(finest / 0.05), 0.05)

    def table(self, progress: Progress | None = None, each: Each | None = None) -> LensTable:
        """Compute it. `each` does the field points' work, None: one after the other, here."""
        system, settings = self.system, self.settings
        w_count, f_count, n = self.wavelengths.size, len(self.tangents), settings.samples
        chief, window = np.zeros((f_count, 2)), np.zeros((f_count, 2))
        solid = np.zeros((w_count, f_count))
        psf = np.zeros((w_count, f_count, n, n))
        centroid = np.zeros((w_count, f_count, 2))
        points = list(zip(self.tangents, self._starts(), strict=True))
        warnings_at: dict[int, tuple[str, ...]] = {}
        traced = each(self.trace_field, points) if each else ((f, self.trace_field(p)) for f, p in enumerate(points))
        for f, point in traced:
            chief[f], window[f], solid[:, f] = point.chief_mm, point.window_um, point.solid_angle
            centroid[:, f], psf[:, f], warnings_at[f] = point.centroid_um, point.psf, point.warnings
            if progress is not None:
                progress(f"field {len(warnings_at)} of {f_count}", len(warnings_at) / f_count)
        share = psf.sum(axis=(2, 3))
        w, f = divmod(int(np.argmin(share)), f_count)
        if share[w, f] < LEAST_SHARE:
            self.warnings.append(
                f"{share[w, f]:.0%} of the light of {self.wavelengths[w]:g} nm at {field_angles(self.tangents[f])} "
                f"arrives within the {n * self.pitch_um:g} um of its window, the least of all: the rest is in no "
                "picture of the table; take more samples or a coarser pitch"
            )
        axis = self._axis_index()
        # Everything is seen through the same unit of the entrance pupil; the image's own solid angle is what lights it.
        relative = solid / solid[:, axis : axis + 1]
        return LensTable(
            wavelength_nm=self.wavelengths,
            field_deg=np.degrees(np.arctan(np.array(self.tangents))),
            grid_shape=(f_count,) if self._line_only else (settings.grid, settings.grid),
            symmetric=self.symmetric,
            reference_wavelength_nm=system.reference_nm,
            focal_length_mm=system.first_order.focal_length_mm,
            f_number=system.first_order.f_number,
            entrance_pupil_mm=system.first_order.entrance_pupil_mm,
            chief_mm=chief,
            relative_illumination=relative,
            psf=psf,
            window_um=window,
            sample_pitch_um=self.pitch_um,
            encircled_share=share,
            centroid_um=centroid,
            warnings=tuple(
                dict.fromkeys(
                    [*system.warnings, *(w for f in sorted(warnings_at) for w in warnings_at[f]), *self.warnings]
                )
            ),
            content_hash=content_hash(system.prescription, settings),
        )

    def trace_field(self, point: tuple[Point, Point]) -> TracedField:
        """Trace a field point, given as its tangents and the pupil point of its chief ray."""
        (tangent, start), system, n = point, self.system, self.settings.samples
        before = len(system.warnings)
        half_diagonal = 0.5e-3 * math.sqrt(2.0) * n * self.pitch_um
        row = system.chief(tangent, system.reference_nm, start)
        assert row is not None
        chief = np.array([row[rt.X], row[rt.Y]])
        centre = self._centre(tangent, start)
        coarse = [self._pupil(tangent, w, centre, 0.0) for w in self.wavelengths]
        solid = np.array([pupil.solid_angle for pupil in coarse])
        centroid = np.array([(np.array(pupil.centroid_mm) - chief) * 1e3 for pupil in coarse])
        window = 0.5 * (centroid.min(axis=0) + centroid.max(axis=0))
        about = float(chief[0] + 1e-3 * window[0]), float(chief[1] + 1e-3 * window[1])
        blur = max(float(np.max(np.hypot(p.x_mm - about[0], p.y_mm - about[1]))) for p in coarse)
        # Of light that arrives four half diagonals away, next to nothing is diffracted into the window.
        reach = min(blur, 4.0 * half_diagonal)
        sine = max(0.5 * max(np.ptp(p.rim_cosine_x), np.ptp(p.rim_cosine_y)) for p in coarse)
        span = coarse[0].wave_number_per_mm * float(sine) * (half_diagonal + reach)
        psf = np.array(
            [
                point_spread(pupil, about, n, self.pitch_um, reach if reach < blur else math.inf)
                for pupil in self._pupils(tangent, centre, span, solid)
            ]
        )
        return TracedField(chief, window, solid, centroid, psf, tuple(system.warnings[before:]))

    def _axis_index(self) -> int:
        return int(np.argmin([math.hypot(*tangent) for tangent in self.tangents]))

    def _starts(self) -> list[tuple[float, float]]:
        """Pupil points of the field points' chief rays, found from the centre outwards."""
        system = self.system
        if self._line_only:
            starts = system.starts(self.tangents, system.reference_nm)
        else:
            starts = []
            for tx, ty in self.tangents:
                spoke = [(tx * share, ty * share) for share in (0.0, 0.5, 1.0)]
                starts.append(system.starts(spoke, system.reference_nm)[-1])
        lost = [tangent for tangent, place in zip(self.tangents, starts, strict=True) if place is None]
        if lost:
            raise PrescriptionError(f"the chief ray at {field_angles(lost[0])} is lost; ask for a smaller field")
        return [place for place in starts if place is not None]

    def _centre(self, tangent: tuple[float, float], start: tuple[float, float]) -> tuple[float, float]:
        centre = self.system.open_centre(tangent, [self._nodes[0], self.system.reference_nm, self._nodes[-1]], start)
        if centre is None:
            raise PrescriptionError(f"no light comes through at {field_angles(tangent)}; ask for a smaller field")
        return centre

    def _pupil(
        self, tangent: tuple[float, float], wavelength_nm: float, centre: tuple[float, float], span: float
    ) -> PupilRays:
        rays = self.system.pupil(tangent, wavelength_nm, span, centre)
        if rays is None:
            raise PrescriptionError(
                f"no light comes through at {field_angles(tangent)}, {wavelength_nm:g} nm; ask for a smaller field"
            )
        return rays

    def _pupils(
        self, tangent: tuple[float, float], centre: tuple[float, float], span: float, solid_angle: FloatArray
    ) -> list[PupilRays]:
        """Return the pupil at every wavelength of the table.

        Rays are traced at a few wavelengths and interpolated between them: at a fixed relative position in the open
        pupil, rays are as smooth in 1 / wavelength^2 as the indices are. Where the interpolated solid angles differ
        from traced ones (different apertures clip at the two ends of the spectrum), every wavelength is traced.
        """
        traced = [self._pupil(tangent, w, centre, span) for w in self._nodes]
        if len({rays.area.size for rays in traced}) == 1 and len({rays.rim_cosine_x.size for rays in traced}) == 1:
            interpolated = interpolate_rays(
                traced, self.wavelengths, [self.system.index(w)[-2] for w in self.wavelengths]
            )
            if all(
                abs(p.solid_angle / s - 1.0) < _SOLID_ANGLE_TOLERANCE
                for p, s in zip(interpolated, solid_angle, strict=True)
            ):
                return interpolated
        return [self._pupil(tangent, w, centre, span) for w in self.wavelengths]


def _spectral_nodes(wavelengths: FloatArray) -> list[float]:
    """Wavelengths that are traced, the ends among them: Chebyshev's extrema in 1 / wavelength^2, or all where there
    are few."""
    if wavelengths.size <= _SPECTRAL_NODES:
        return [float(w) for w in wavelengths]
    low, high = wavelengths[-1] ** -2.0, wavelengths[0] ** -2.0
    u = 0.5 * (low + high) + 0.5 * (high - low) * np.cos(np.pi * np.arange(_SPECTRAL_NODES) / (_SPECTRAL_NODES - 1))
    nodes = u**-0.5
    nodes[0], nodes[-1] = wavelengths[0], wavelengths[-1]
    return [float(w) for w in nodes]
