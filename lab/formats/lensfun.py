"""A lens in lensfun's XML: distortion, lateral colour and vignetting, out of a camera file and into one.

Lensfun's radii have two units: half of the frame's shorter side for distortion and lateral colour, half of its diagonal
for vignetting. The models that are written are poly5 (r_d = r_u (1 + k1 r_u^2 + k2 r_u^4)), poly3 (r_red = v r) and pa
(1 + k1 r^2 + k2 r^4 + k3 r^6). Those of its database are read, too: poly3, ptlens and acm of distortion, linear of
lateral colour, acm of vignetting. OpenCV's distortion is the same law as poly5 with the focal length (px) as its unit.

Between calibrations the coefficients are interpolated as lensfun 0.3 does it (`lens.cpp`): a Hermite spline over focal
length for distortion and lateral colour, inverse distance weighting for vignetting. Each kind of correction is taken
from the calibration whose frame is the smallest that covers the camera's.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lab.errors import InputError, one_line
from lab.formats.camera_file import CameraFile
from lab.formats.cgats import COMMA_NUMBER
from lab.formats.geometry_files import geometry_of
from lab.formats.raw_file import replacing
from sim.camera import CameraModel, Geometry
from sim.effects.base import Effect
from sim.effects.distortion import Distortion
from sim.effects.lateral_chromatic_aberration import REFERENCE_NM, LateralChromaticAberration
from sim.effects.vignetting import Vignetting
from sim.optics.fall_off import RadialIllumination
from sim.optics.illumination import optical_axis_px, relative_illumination
from sim.scene.warp import distort
from sim.spectrum import FloatArray

#: Diagonal (mm) of the frame whose crop factor is 1.
FULL_FRAME_MM = math.hypot(36.0, 24.0)
#: Distance (m) that stands for infinity.
FAR_M = 1000.0
#: Greatest file that is read (bytes): lensfun's whole database has a tenth.
MOST_BYTES = 64 << 20
#: Samples a side of the grid over the frame on which the laws are fitted, and along the radius that is read.
NODES = 41
#: Departures of lensfun's law from the camera's that are told: px of distortion, and share of the light.
TOLD_PX, TOLD_SHARE = 0.05, 0.002


#: What lensfun takes for the frame's sides where a file has no aspect-ratio.
DEFAULT_ASPECT = 1.5
#: A calibration serves a camera whose frame is larger than the calibration's by this factor at most: lensfun's limit.
COVERED = 1.0 / 0.96
#: Share by which a focal length may lie outside the calibrated ones: marked focal lengths are rounded by as much.
MARKED_SHARE = 0.06
#: Power of the inverse distance by which vignetting is interpolated, and the distance beyond which it isn't: lensfun's.
NEARNESS_POWER, FARTHEST = 3.5, 1.0
#: A calibration within this distance is taken as it is (lensfun's).
EXACT = 1e-4


@dataclass(frozen=True)
class LensfunLens:
    """One lens at one focal length and aperture, as functions of the radius on the sensor (mm). None: not calibrated.

    `distortion`: r_d / r_u of r_u; `decentring`: p1 and p2 of OpenCV's; `tca`: radius of red and of blue over green's;
    `vignetting`: relative illumination. `real_focal_length_mm`: focal length at the centre of the image, where the file
    states it. `centre`: optical axis from the frame's middle (x, y), in half of the frame's shorter side.
    """

    model: str
    focal_length_mm: float
    real_focal_length_mm: float | None = None
    distortion: Callable[[FloatArray], FloatArray] | None = None
    decentring: tuple[float, float] = (0.0, 0.0)
    tca: Callable[[FloatArray], tuple[FloatArray, FloatArray]] | None = None
    vignetting: Callable[[FloatArray], FloatArray] | None = None
    centre: tuple[float, float] | None = None
    remarks: tuple[str, ...] = ()


def write_lensfun(file: Path, content: CameraFile) -> tuple[str, ...]:
    """Write the lens of a camera as a lensfun database of one lens.

    file : XML, to be written
    content : the camera

    Returns what lensfun's laws don't hold. Raises InputError where the camera doesn't state the focal length.

    >>> from tempfile import TemporaryDirectory
    >>> from lab.formats.camera_file import default_camera
    >>> with TemporaryDirectory() as folder:
    ...     _ = write_lensfun(Path(folder) / "lens.xml", default_camera())
    ...     'model="poly5"' in (Path(folder) / "lens.xml").read_text()
    True
    """
    camera = content.camera
    if camera.lens.focal_length_mm is None:
        raise InputError(f"{content.name}: lens.focal_length_mm is not set; write it into the camera file")
    k1, k2, remarks = _poly5(camera, content.effects)
    red, blue = _scales(camera, content.effects)
    shading, more = _pa(camera, content.effects)
    diagonal_mm = 2e-3 * camera.half_diagonal_um
    crop = FULL_FRAME_MM / diagonal_mm
    focal, aperture = f"{camera.lens.known_focal_length_mm:.6g}", f"{camera.lens.f_number:.6g}"
    root = ET.Element("lensdatabase", version="1")
    mount = ET.SubElement(root, "mount")
    ET.SubElement(mount, "name").text = "calibench"
    for tag in ("camera", "lens"):
        entry = ET.SubElement(root, tag)
        ET.SubElement(entry, "maker").text = "calibench"
        ET.SubElement(entry, "model").text = content.name or "camera"
        ET.SubElement(entry, "mount").text = "calibench"
        ET.SubElement(entry, "cropfactor").text = f"{crop:.9g}"
    wide, narrow = max(camera.rows, camera.cols), min(camera.rows, camera.cols)
    ET.SubElement(entry, "aspect-ratio").text = f"{wide}:{narrow}"
    centre = _centre(camera)
    if centre != (0.0, 0.0):
        ET.SubElement(entry, "center", x=f"{centre[0]:.9g}", y=f"{centre[1]:.9g}")
    calibration = ET.SubElement(entry, "calibration")
    ET.SubElement(calibration, "distortion", model="poly5", focal=focal, k1=f"{k1:.9g}", k2=f"{k2:.9g}")
    if camera.cfa != "MONO":
        ET.SubElement(calibration, "tca", model="poly3", focal=focal, vr=f"{red:.9g}", vb=f"{blue:.9g}")
    named = {f"k{n}": f"{k:.9g}" for n, k in enumerate(shading, start=1)}
    for distance_m in ("10", f"{FAR_M:g}"):
        ET.SubElement(
            calibration,
            "vignetting",
            {"model": "pa", "focal": focal, "aperture": aperture, "distance": distance_m} | named,
        )
    ET.indent(root)
    with replacing(file) as partial:
        partial.write_bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True))
    return (*remarks, *more)


def _half_short_px(camera: CameraModel) -> float:
    return 0.5 * min(camera.rows, camera.cols)


def _focal_px(camera: CameraModel) -> float:
    return camera.lens.known_focal_length_mm * 1e3 / camera.pixel_pitch_um


def _centre(camera: CameraModel) -> tuple[float, float]:
    """Return the optical centre from the frame's middle (x, y), in lensfun's unit."""
    matrix = geometry_of(camera).camera_matrix
    x, y = matrix[0][2] - 0.5 * (camera.cols - 1), matrix[1][2] - 0.5 * (camera.rows - 1)
    half = _half_short_px(camera)
    return x / half, y / half


def _grid(camera: CameraModel) -> tuple[FloatArray, FloatArray]:
    """Columns and rows (px) over the frame, as flat arrays."""
    row, col = np.meshgrid(
        np.linspace(0.0, camera.rows - 1.0, NODES), np.linspace(0.0, camera.cols - 1.0, NODES), indexing="ij"
    )
    return col.ravel(), row.ravel()


def _poly5(camera: CameraModel, effects: Sequence[Effect]) -> tuple[float, float, tuple[str, ...]]:
    """k1, k2 of poly5, fitted to the camera's own distortion over the frame; exact for k1 and k2 of OpenCV's alone."""
    geometry, half = geometry_of(camera), _half_short_px(camera)
    matrix = geometry.camera_matrix
    col, row = _grid(camera)
    to_col, to_row = (np.asarray(coordinate, float) for coordinate in distort(col, row, geometry))
    x, y = (col - matrix[0][2]) / half, (row - matrix[1][2]) / half
    u, v = (to_col - matrix[0][2]) / half, (to_row - matrix[1][2]) / half
    for effect in effects:
        if isinstance(effect, Distortion):
            share = effect.corner_percent / 100.0 * (u * u + v * v) * (half / camera.half_diagonal_px) ** 2
            u, v = u * (1.0 + share), v * (1.0 + share)
    r2 = x * x + y * y
    design = np.concatenate([np.stack([x * r2, x * r2**2], axis=1), np.stack([y * r2, y * r2**2], axis=1)])
    shift = np.concatenate([u - x, v - y])
    (k1, k2), *_ = np.linalg.lstsq(design, shift, rcond=None)
    left_px = float(np.abs(shift - design @ np.array([k1, k2])).max()) * half
    remarks = (f"distortion: poly5 leaves {left_px:.2f} px at most (k3, p1, p2 have no place in it)",)
    return float(k1), float(k2), remarks if left_px > TOLD_PX else ()


def _moments(camera: CameraModel) -> dict[str, tuple[float, float]]:
    """Mean of t and of t^2 by channel in light of equal energy, t = (wavelength - 550 nm) / 100 nm."""
    moments = {}
    for channel, curve in camera.quantum_efficiency.items():
        wavelength_nm, value = curve.arrays
        t, weight = (wavelength_nm - REFERENCE_NM) / 100.0, value * np.gradient(wavelength_nm)
        total = float(weight.sum())
        moments[channel] = (float((weight * t).sum()) / total, float((weight * t * t).sum()) / total)
    return moments


def _scales(camera: CameraModel, effects: Sequence[Effect]) -> tuple[float, float]:
    """Radius of red and of blue over that of green."""
    if camera.cfa == "MONO":
        return 1.0, 1.0
    moments, scale = _moments(camera), dict.fromkeys(("R", "G", "B"), 1.0)
    for effect in effects:
        if isinstance(effect, LateralChromaticAberration):
            for channel, (mean, square) in moments.items():
                scale[channel] += (effect.slope_um * mean + effect.curvature_um * square) / camera.half_diagonal_um
    return scale["R"] / scale["G"], scale["B"] / scale["G"]


def _pa(camera: CameraModel, effects: Sequence[Effect]) -> tuple[tuple[float, float, float], tuple[str, ...]]:
    """k1, k2, k3 of pa, fitted to the camera's own fall-off of light over the frame."""
    col, row = _grid(camera)
    light = np.asarray(relative_illumination(camera, row, col), float).ravel()
    row0, col0 = optical_axis_px(camera)
    r2 = ((col - col0) ** 2 + (row - row0) ** 2) / camera.half_diagonal_px**2
    for effect in effects:
        if isinstance(effect, Vignetting):
            light = light * (1.0 - effect.corner_loss_percent / 100.0 * r2 ** (0.5 * effect.exponent))
    design = np.stack([r2, r2**2, r2**3], axis=1)
    k, *_ = np.linalg.lstsq(design, light - 1.0, rcond=None)
    left = float(np.abs(light - 1.0 - design @ k).max())
    remarks = (f"vignetting: pa leaves {100 * left:.2f} % of the light at most",) if left > TOLD_SHARE else ()
    return (float(k[0]), float(k[1]), float(k[2])), remarks


def read_lensfun(file: Path, camera: CameraModel, model: str = "") -> LensfunLens:
    """Return a lens of a lensfun file at the focal length and the aperture of a camera.

    file : XML of lensfun's database
    camera : before which the lens is
    model : name of the lens; by default the file's only one

    Raises InputError, one line that begins with the file: it isn't lensfun's, or holds several lenses or not this one,
    or this one isn't calibrated for such a camera.

    >>> from tempfile import TemporaryDirectory
    >>> from lab.formats.camera_file import default_camera
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "lens.xml"
    ...     _ = write_lensfun(file, default_camera())
    ...     read_lensfun(file, default_camera().camera).focal_length_mm
    8.0
    """
    try:
        if file.stat().st_size > MOST_BYTES:
            raise InputError(f"has {file.stat().st_size >> 20} MiB, beyond the limit of {MOST_BYTES >> 20}")  # noqa: TRY301
        root = ET.fromstring(file.read_bytes())
    except OSError as error:
        raise InputError(f"{file}: can't be read ({error.strerror}); give a lensfun XML file") from error
    except (ET.ParseError, InputError) as error:
        raise InputError(f"{file}: isn't lensfun's XML ({one_line(error)}); give a file of its database") from error
    lenses = [lens for lens in root.iter("lens") if lens.find("calibration") is not None]
    if root.tag != "lensdatabase" or not lenses:
        raise InputError(f"{file}: holds no lens with a calibration; give a file of lensfun's database")
    name, element = _choose(file, lenses, model)
    try:
        return _Calibrations(name, element, camera).lens()
    except InputError as error:
        raise InputError(f"{file}: lens {name!r}: {error}") from error


def _choose(file: Path, lenses: Sequence[ET.Element], model: str) -> tuple[str, ET.Element]:
    """Return the lens of this name. Lenses that share a name have their maker, mounts and crop factor in it."""
    models = [_text(lens, "model") for lens in lenses]
    names = [name if models.count(name) == 1 else _full_name(lens) for name, lens in zip(models, lenses, strict=True)]
    names = [
        f"{name} #{names[: at + 1].count(name)}" if names.count(name) > 1 else name for at, name in enumerate(names)
    ]
    fit = [at for at in range(len(lenses)) if model in ("", names[at], models[at])]
    if len(fit) == 1:
        return names[fit[0]], lenses[fit[0]]
    offered = [names[at] for at in fit] or names
    listed = ", ".join(repr(name) for name in sorted(offered)[:8]) + (", ..." if len(offered) > 8 else "")
    if not fit:
        raise InputError(f"{file}: holds no lens {model!r}; it has {listed}")
    called = f" of the name {model!r}" if model else ""
    raise InputError(f"{file}: holds {len(fit)} lenses{called}; choose one by --lens: {listed}")


def _full_name(lens: ET.Element) -> str:
    mounts = "/".join(mount.text or "" for mount in lens.findall("mount"))
    return ", ".join(
        part
        for part in (
            _text(lens, "model"),
            _text(lens, "maker"),
            f"mount {mounts}" if mounts else "",
            f"crop {_text(lens, 'cropfactor') or 'not stated'}",
        )
        if part
    )


def _text(element: ET.Element, tag: str) -> str:
    return next((child.text or "" for child in element.findall(tag) if "lang" not in child.attrib), "").strip()


#: Coefficients of each model in lensfun's order, with the values that stand for an absent one.
_TERMS: dict[str, dict[str, dict[str, float]]] = {
    "distortion": {
        "poly3": {"k1": 0.0},
        "poly5": {"k1": 0.0, "k2": 0.0},
        "ptlens": {"a": 0.0, "b": 0.0, "c": 0.0},
        "acm": {"k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.0, "k5": 0.0},
    },
    "tca": {
        "linear": {"kr": 1.0, "kb": 1.0},
        "poly3": {"vr": 1.0, "vb": 1.0, "cr": 0.0, "cb": 0.0, "br": 0.0, "bb": 0.0},
    },
    "vignetting": {model: {"k1": 0.0, "k2": 0.0, "k3": 0.0} for model in ("pa", "acm")},
}


def _power(kind: str, model: str, index: int) -> float:
    """Return the power of the focal length by which a coefficient is multiplied before it is interpolated: with it,
    most lenses' coefficients are straight lines over focal length (lensfun, `__parameter_scales`)."""
    if kind == "vignetting":
        return 0.0 if model == "pa" else -2.0 * (index + 1)
    if kind == "tca" and index < 2:
        return 0.0
    return -1.0 - 2.0 * index if model == "acm" and index < 3 else 0.0 if model == "acm" else 1.0


@dataclass(frozen=True)
class _Entry:
    """One line of a calibration."""

    focal_mm: float
    real_focal_mm: float | None
    terms: FloatArray
    aperture: float
    distance_m: float


@dataclass(frozen=True)
class _Correction:
    """One kind of correction: its model, its entries, and half the sides of the frame that they were made on (mm)."""

    kind: str
    model: str
    entries: tuple[_Entry, ...]
    half_diagonal_mm: float
    half_short_mm: float


class _Calibrations:
    """The calibrations of one lens, read for one camera."""

    def __init__(self, name: str, lens: ET.Element, camera: CameraModel) -> None:
        self.name, self.element, self.camera = name, lens, camera
        self.focal_mm, self.aperture = camera.lens.known_focal_length_mm, camera.lens.f_number
        self.remarks: list[str] = []

    def lens(self) -> LensfunLens:
        projection = _text(self.element, "type") or "rectilinear"
        if projection.lower() not in ("rectilinear", "unknown"):
            raise InputError(
                f"has the projection {projection!r}, and a camera file holds a pinhole's (rectilinear) with k1, k2, k3 "
                "alone; take a rectilinear lens, or fit boards of this one"
            )
        correction_of_kind = {kind: correction for kind in _TERMS if (correction := self._correction(kind)) is not None}
        bent, tca, dark = (correction_of_kind.get(kind) for kind in ("distortion", "tca", "vignetting"))
        real_mm, centre = self._real_focal_mm(bent), self.element.find("center")
        law: Callable[[FloatArray], FloatArray] | None = None if real_mm is None else _undistorted
        decentring = (0.0, 0.0)
        if bent is not None:
            terms = self._along_focal(bent)
            law = _distortion(bent, terms, real_mm or self.focal_mm)
            decentring = (float(terms[3]), float(terms[4])) if bent.model == "acm" else decentring
        colour = None if tca is None else _tca(tca, self._along_focal(tca))
        light = None if dark is None else self._vignetting(dark)
        if law is None and colour is None and light is None:
            reason = f" ({'; '.join(self.remarks)})" if self.remarks else ""
            raise InputError(f"has no calibration that serves this camera{reason}; take another lens or camera file")
        return LensfunLens(
            model=self.name,
            focal_length_mm=self.focal_mm,
            real_focal_length_mm=real_mm,
            distortion=law,
            decentring=decentring,
            tca=colour,
            vignetting=light,
            centre=None if centre is None else (_value(centre, "x", 0.0), _value(centre, "y", 0.0)),
            remarks=tuple(dict.fromkeys(self.remarks)),
        )

    def _correction(self, kind: str) -> _Correction | None:
        """Return this kind of correction from the calibration with the smallest frame that covers the camera's. None:
        there is none, or none for the camera's focal length."""
        having = [calibration for calibration in self.element.findall("calibration") if self._lines(calibration, kind)]
        if not having:
            return None
        diagonals = [FULL_FRAME_MM / self._crop(calibration) for calibration in having]
        needed_mm = 2e-3 * self.camera.half_diagonal_um
        covering = [at for at, diagonal in enumerate(diagonals) if needed_mm <= diagonal * COVERED]
        if not covering:
            self.remarks.append(
                f"{kind}: left out, as its calibration's frame (diagonal {max(diagonals):.2f} mm) is smaller than "
                f"the camera's ({needed_mm:.2f} mm)"
            )
            return None
        at = min(covering, key=lambda index: diagonals[index])
        lines = self._lines(having[at], kind)
        model = lines[0].get("model", "")
        if model not in _TERMS[kind]:
            raise InputError(f"{kind} of model {model!r} isn't known here; {', '.join(_TERMS[kind])} are")
        alike = [line for line in lines if line.get("model") == model]
        if len(alike) < len(lines):
            self.remarks.append(f"{kind}: {model} is read, {len(lines) - len(alike)} lines of other models aren't")
        entries = self._last_of_each_place(kind, [self._entry(line, kind, model) for line in alike])
        if not self._serves(kind, sorted({entry.focal_mm for entry in entries})):
            return None
        half_mm = 0.5 * diagonals[at]
        return _Correction(kind, model, entries, half_mm, half_mm / math.hypot(1.0, self._aspect(having[at])))

    def _last_of_each_place(self, kind: str, entries: Sequence[_Entry]) -> tuple[_Entry, ...]:
        """Return the last calibration of each focal length, and of vignetting also aperture and distance, which is the
        one that lensfun takes, and note places whose calibrations differ."""
        last: dict[tuple[float, float, float], _Entry] = {}
        for entry in entries:
            place = (entry.focal_mm, entry.aperture, entry.distance_m)
            earlier = last.get(place, entry)
            if not np.array_equal(earlier.terms, entry.terms) or earlier.real_focal_mm != entry.real_focal_mm:
                self.remarks.append(
                    f"{kind}: several calibrations at {entry.focal_mm:g} mm differ, and the last one is taken, as "
                    "lensfun does; remove those that don't apply"
                )
            last[place] = entry
        return tuple(last.values())

    def _serves(self, kind: str, focals_mm: list[float]) -> bool:
        """Return whether calibrations at these focal lengths serve the camera's, and note those that are used."""
        low, high, wanted = focals_mm[0], focals_mm[-1], self.focal_mm
        if not low * (1.0 - MARKED_SHARE) <= wanted <= high * (1.0 + MARKED_SHARE):
            self.remarks.append(
                f"{kind}: left out, as it is calibrated at {_span(low, high)} mm and the camera file's focal_length_mm "
                f"is {wanted:g}"
            )
            return False
        if kind != "vignetting" and wanted not in focals_mm:
            below, above = (
                (focal_mm for focal_mm in focals_mm if focal_mm < wanted),
                (focal_mm for focal_mm in focals_mm if focal_mm > wanted),
            )
            span = _span(max(below, default=low), min(above, default=high))
            self.remarks.append(f"{kind}: taken at {wanted:g} mm from calibrations at {span} mm")
        return True

    @staticmethod
    def _lines(calibration: ET.Element, kind: str) -> list[ET.Element]:
        return [line for line in calibration.findall(kind) if line.get("model") != "none"]

    def _crop(self, calibration: ET.Element) -> float:
        stated = calibration.get("cropfactor") or _text(self.element, "cropfactor")
        if not stated:
            raise InputError(
                "has no cropfactor, the unit of its radii; add that of the camera it was calibrated on to <lens>, as "
                "in <cropfactor>1.5</cropfactor>"
            )
        return _parse_number(stated, "cropfactor")

    def _aspect(self, calibration: ET.Element) -> float:
        """Return the longer side of the calibration's frame over the shorter one."""
        stated = calibration.get("aspect-ratio") or _text(self.element, "aspect-ratio")
        if not stated:
            self.remarks.append("aspect-ratio isn't stated: 3:2 is taken, lensfun's default")
            return DEFAULT_ASPECT
        wide, _, narrow = stated.partition(":")
        aspect = _parse_number(wide, "aspect-ratio") / _parse_number(narrow or "1", "aspect-ratio")
        return max(aspect, 1.0 / aspect)

    def _entry(self, line: ET.Element, kind: str, model: str) -> _Entry:
        return _Entry(
            focal_mm=_value(line, "focal"),
            real_focal_mm=_value(line, "real-focal") if line.get("real-focal") else None,
            terms=np.array([_value(line, key, absent) for key, absent in _TERMS[kind][model].items()]),
            aperture=_value(line, "aperture", self.aperture) if kind != "vignetting" else _value(line, "aperture"),
            distance_m=_value(line, "distance", FAR_M),
        )

    def _along_focal(self, correction: _Correction) -> FloatArray:
        """Return the coefficients at the camera's focal length."""
        entries = correction.entries
        powers = np.array([_power(correction.kind, correction.model, index) for index in range(len(entries[0].terms))])
        at_mm = np.array([entry.focal_mm for entry in entries])
        scaled = np.array([entry.terms * entry.focal_mm**powers for entry in entries])
        low, high = at_mm.min(), at_mm.max()
        place_mm = min(max(self.focal_mm, low), high)
        return np.asarray(_hermite(at_mm, scaled, place_mm) / place_mm**powers, float)

    def _real_focal_mm(self, bent: _Correction | None) -> float | None:
        """Return the real focal length, stated in the lines of the distortion or in lines of its own."""
        pairs = [(entry.focal_mm, entry.real_focal_mm) for entry in bent.entries if entry.real_focal_mm] if bent else []
        pairs = pairs or [
            (_value(element, "focal"), _value(element, "real-focal"))
            for element in self.element.iter("real-focal-length")
        ]
        if not pairs:
            return None
        at_mm, real_mm = (np.array(column, float) for column in zip(*pairs, strict=True))
        if not at_mm.min() * (1.0 - MARKED_SHARE) <= self.focal_mm <= at_mm.max() * (1.0 + MARKED_SHARE):
            span = _span(at_mm.min(), at_mm.max())
            self.remarks.append(f"real-focal: left out, as it is stated at {span} mm, not at {self.focal_mm:g} mm")
            return None
        return float(_hermite(at_mm, real_mm[:, None], min(max(self.focal_mm, at_mm.min()), at_mm.max()))[0])

    def _vignetting(self, dark: _Correction) -> Callable[[FloatArray], FloatArray] | None:
        """Return the fall-off of light at the camera's focal length and aperture, at infinity."""
        entries, focal_mm = dark.entries, self.focal_mm
        powers = np.array([_power("vignetting", dark.model, index) for index in range(3)])
        low, high = self._focal_range_mm(entries)
        far = [
            math.hypot((entry.focal_mm - focal_mm) / ((high - low) or 1.0), 4.0 / entry.aperture - 4.0 / self.aperture,
                       0.1 / entry.distance_m - 0.1 / FAR_M)
            for entry in entries
        ]  # fmt: skip
        nearest = min(range(len(entries)), key=far.__getitem__)
        if far[nearest] > FARTHEST:
            apertures = [entry.aperture for entry in entries]
            self.remarks.append(
                f"vignetting: left out, as it is calibrated at f/{_span(min(apertures), max(apertures))}, too far from "
                f"f/{self.aperture:g}"
            )
            return None
        if far[nearest] < EXACT:
            k = entries[nearest].terms
        else:
            weight = np.array([distance**-NEARNESS_POWER for distance in far])
            scaled = np.array([entry.terms * entry.focal_mm**powers for entry in entries])
            k = weight @ scaled / weight.sum() / focal_mm**powers
            entry = entries[nearest]
            place = f"at {entry.focal_mm:g} mm, f/{entry.aperture:g}, {entry.distance_m:g} m"
            mean = f"weighted mean of {len(entries)} calibrations, the nearest" if len(entries) > 1 else "as calibrated"
            self.remarks.append(f"vignetting: {mean} {place}")
        unit_mm = dark.half_diagonal_mm if dark.model == "pa" else focal_mm
        return lambda r_mm: 1.0 + sum(k[n] * (r_mm / unit_mm) ** (2 * n + 2) for n in range(3))

    def _focal_range_mm(self, entries: Sequence[_Entry]) -> tuple[float, float]:
        """Return the lens's range of focal lengths, stated or else that of its calibrations."""
        stated = self.element.find("focal")
        if stated is not None and stated.get("min") and stated.get("max"):
            return _value(stated, "min"), _value(stated, "max")
        focals = [_value(element, "focal") for kind in _TERMS for element in self.element.iter(kind)]
        return min(focals), max(focals)


def _span(low: float, high: float) -> str:
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _hermite(at: FloatArray, values: FloatArray, place: float) -> FloatArray:
    """Return the rows `values` at `at` interpolated at a place between: lensfun's spline, whose tangents are half of
    the difference between the neighbours' values, without regard to the distances between them."""
    exact = np.flatnonzero(at == place)
    if exact.size:
        return np.asarray(values[exact[0]])
    order = np.argsort(at)
    at, values = at[order], values[order]
    up = int(np.searchsorted(at, place))
    before, low, high = values[max(up - 2, 0)], values[up - 1], values[up]
    after = values[min(up + 1, len(at) - 1)]
    from_tangent = (high - before) * (0.5 if up >= 2 else 1.0)
    to_tangent = (after - low) * (0.5 if up + 1 < len(at) else 1.0)
    t = (place - at[up - 1]) / (at[up] - at[up - 1])
    return np.asarray(
        (2 * t**3 - 3 * t**2 + 1) * low + (t**3 - 2 * t**2 + t) * from_tangent
        + (3 * t**2 - 2 * t**3) * high + (t**3 - t**2) * to_tangent
    )  # fmt: skip


def _value(element: ET.Element, key: str, otherwise: float | None = None) -> float:
    text = element.get(key)
    if text is None:
        if otherwise is None:
            raise InputError(f"<{element.tag}> has no {key}; add it")
        return otherwise
    above_0 = key in ("focal", "real-focal", "aperture", "distance", "min", "max")
    return _parse_number(text, f"{key} of <{element.tag}>", above_0=above_0)


def _parse_number(text: str, what: str, above_0: bool = True) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or (above_0 and value <= 0):
        comma = COMMA_NUMBER.fullmatch(text.strip())
        remedy = f"write {text.strip().replace(',', '.')}, with a decimal point" if comma else "correct it"
        raise InputError(f"{what} is '{text[:20]}', not a number{' above 0' if above_0 else ''}; {remedy}")
    return value


def _undistorted(r_mm: FloatArray) -> FloatArray:
    return np.ones_like(r_mm)


def _distortion(correction: _Correction, terms: FloatArray, focal_mm: float) -> Callable[[FloatArray], FloatArray]:
    """Return r_d / r_u as a function of the radius (mm). The unit of acm's radii is the focal length."""
    k, unit_mm = terms.tolist(), correction.half_short_mm
    if correction.model == "poly3":
        return lambda r_mm: 1.0 - k[0] + k[0] * (r_mm / unit_mm) ** 2
    if correction.model == "poly5":
        return lambda r_mm: 1.0 + k[0] * (r_mm / unit_mm) ** 2 + k[1] * (r_mm / unit_mm) ** 4
    if correction.model == "acm":
        return lambda r_mm: 1.0 + sum(k[n] * (r_mm / focal_mm) ** (2 * n + 2) for n in range(3))
    a, b, c = k
    return lambda r_mm: a * (r_mm / unit_mm) ** 3 + b * (r_mm / unit_mm) ** 2 + c * (r_mm / unit_mm) + 1.0 - a - b - c


def _tca(correction: _Correction, terms: FloatArray) -> Callable[[FloatArray], tuple[FloatArray, FloatArray]]:
    """Return the radii of red and of blue over green's as functions of the radius (mm)."""
    v, c, b = np.concatenate([terms, np.zeros(6 - len(terms))]).reshape(3, 2)

    def over_green(r_mm: FloatArray, at: int) -> FloatArray:
        r = r_mm / correction.half_short_mm
        return np.asarray(v[at] + c[at] * r + b[at] * r**2)

    return lambda r_mm: (over_green(r_mm, 0), over_green(r_mm, 1))


def with_lens(content: CameraFile, lens: LensfunLens) -> tuple[CameraFile, tuple[str, ...]]:
    """Return the camera with a lens of lensfun's before it, in place of its own distortion, lateral colour and fall-off
    of light; and remarks on what it doesn't hold.

    content : the camera
    lens : as `read_lensfun` returns it

    Raises InputError where the laws make no lens.

    >>> from tempfile import TemporaryDirectory
    >>> from lab.formats.camera_file import default_camera
    >>> with TemporaryDirectory() as folder:
    ...     _ = write_lensfun(Path(folder) / "lens.xml", default_camera())
    ...     lens = read_lensfun(Path(folder) / "lens.xml", default_camera().camera)
    >>> with_lens(default_camera(), lens)[0].camera.geometry is None
    False
    """
    camera, remarks = content.camera, list(lens.remarks)
    taken: list[type[Effect]] = []
    added: list[Effect] = []
    if lens.centre is not None:
        camera = _centre_camera(camera, lens.centre)
    if lens.distortion is not None:
        geometry, left_px = _brown(camera, lens)
        camera = camera.model_copy(update={"geometry": geometry})
        taken.append(Distortion)
        if left_px > TOLD_PX:
            remarks.append(f"distortion: k1, k2, k3 leave {left_px:.2f} px of lensfun's law at most")
    if lens.real_focal_length_mm is not None:
        real_mm = lens.real_focal_length_mm
        remarks.append(f"focal_length_mm {camera.lens.focal_length_mm:g} becomes {real_mm:g}, the real-focal stated")
        camera = camera.model_copy(update={"lens": camera.lens.model_copy(update={"focal_length_mm": real_mm})})
    if lens.vignetting is not None:
        off_px = math.hypot(*_centre(camera)) * _half_short_px(camera)
        radius_mm = np.linspace(0.0, camera.half_diagonal_px + off_px, NODES) * camera.pixel_pitch_um * 1e-3
        light = lens.vignetting(radius_mm)  # to every corner
        if not light.min() > 0:
            raise InputError(f"vignetting: the light is {light.min():.3g} at least, not above 0; take another lens")
        curve = RadialIllumination(radius_mm=tuple(radius_mm.tolist()), relative_illumination=tuple(light.tolist()))
        camera = camera.model_copy(update={"lens": camera.lens.model_copy(update={"illumination": curve})})
        taken.append(Vignetting)
    if lens.tca is not None and camera.cfa != "MONO":
        colour, left_px = _lateral_colour(camera, lens.tca)
        added.append(colour)
        taken.append(LateralChromaticAberration)
        if left_px > TOLD_PX:
            remarks.append(f"tca: one scale a channel, that of the corner, leaves {left_px:.2f} px of lensfun's law")
    kept = [effect for effect in content.effects if not isinstance(effect, tuple(taken))]
    return replace(content, camera=camera, effects=(*kept, *added)), tuple(remarks)


def _centre_camera(camera: CameraModel, centre: tuple[float, float]) -> CameraModel:
    """Return the camera with the optical axis at this place, from the frame's middle in half of its shorter side."""
    geometry, half_px = geometry_of(camera), _half_short_px(camera)
    (fx, skew, _), (shear, fy, _), last = geometry.camera_matrix
    cx, cy = 0.5 * (camera.cols - 1) + centre[0] * half_px, 0.5 * (camera.rows - 1) + centre[1] * half_px
    moved = geometry.model_copy(update={"camera_matrix": ((fx, skew, cx), (shear, fy, cy), last)})
    return camera.model_copy(update={"geometry": moved})


def _brown(camera: CameraModel, lens: LensfunLens) -> tuple[Geometry, float]:
    """OpenCV's distortion nearest to lensfun's law over the frame, and the greatest departure (px). What is
    in proportion to the radius goes into the focal length."""
    assert lens.distortion is not None
    radius_px = camera.half_diagonal_px
    share = np.linspace(0.0, 1.0, 8 * NODES)[1:]  # of the half diagonal
    lands = lens.distortion(share * radius_px * camera.pixel_pitch_um * 1e-3) * share
    design = np.stack([share, share**3, share**5, share**7], axis=1)
    coefficients, *_ = np.linalg.lstsq(design, lands, rcond=None)
    scale = float(coefficients[0])
    centre = float(lens.distortion(np.zeros(1))[0])
    if not min(scale, centre) > 0:
        raise InputError(f"distortion scales the centre by {min(scale, centre):.3g}, not above 0; take another lens")
    left_px = float(np.abs(lands - design @ coefficients).max()) * radius_px
    undistorted = _focal_px(camera)  # focal length (px) of the law's undistorted radii
    if lens.real_focal_length_mm is not None:
        undistorted = lens.real_focal_length_mm * 1e3 / camera.pixel_pitch_um / centre
    focal = undistorted * scale
    k = coefficients[1:] / scale * (undistorted / radius_px) ** np.array([2, 4, 6])
    p1, p2 = lens.decentring
    before: NDArray[np.float64] = np.array(geometry_of(camera).camera_matrix)
    matrix = ((focal, 0.0, float(before[0, 2])), (0.0, focal, float(before[1, 2])), (0.0, 0.0, 1.0))
    return Geometry(camera_matrix=matrix, distortion=(float(k[0]), float(k[1]), p1, p2, float(k[2]))), left_px


def _lateral_colour(
    camera: CameraModel, tca: Callable[[FloatArray], tuple[FloatArray, FloatArray]]
) -> tuple[LateralChromaticAberration, float]:
    """Return the lateral colour that gives red and blue these radii over green's in the corner, and the greatest
    departure elsewhere (px)."""
    share = np.linspace(0.0, 1.0, NODES)[1:]
    curves = tca(share * camera.half_diagonal_um * 1e-3)
    corner = [float(curve[-1]) for curve in curves]
    left = (np.abs(curve - at) * share for curve, at in zip(curves, corner, strict=True))
    left_px = max(float(curve.max()) for curve in left) * camera.half_diagonal_px
    moments, r_um = _moments(camera), camera.half_diagonal_um
    (r1, r2), (g1, g2), (b1, b2) = (moments[channel] for channel in "RGB")
    # (R + a r1 + b r2) = v (R + a g1 + b g2) for red, and for blue: two equations for a, b
    rows = np.array(
        [[first - v * g1, second - v * g2] for v, first, second in ((corner[0], r1, r2), (corner[1], b1, b2))]
    )
    slope, curvature = np.linalg.solve(rows, np.array([(v - 1.0) * r_um for v in corner]))
    try:
        return LateralChromaticAberration(slope_um=float(slope), curvature_um=float(curvature)), left_px
    except ValueError as error:
        raise InputError(f"lateral colour: {one_line(error)}; take another lens") from error
