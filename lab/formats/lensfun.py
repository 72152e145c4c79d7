"""A lens in lensfun's XML: distortion, lateral colour and vignetting, out of a camera file and into one.

Lensfun's radii have two units: half of the frame's shorter side for distortion and lateral colour, half of its diagonal
for vignetting. The models that are written are poly5 (r_d = r_u (1 + k1 r_u^2 + k2 r_u^4)), poly3 (r_red = v r) and pa
(1 + k1 r^2 + k2 r^4 + k3 r^6). Those of its database are read, too: poly3 and ptlens of distortion, linear of lateral
colour. Distortion of OpenCV's is the same law as poly5 with the focal length (px) as its unit.
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
from lab.formats.raw_file import replacing
from sim.camera import CameraModel, Geometry
from sim.effects.base import Effect
from sim.effects.distortion import Distortion
from sim.effects.lateral_chromatic_aberration import REFERENCE_NM, LateralChromaticAberration
from sim.effects.vignetting import Vignetting
from sim.optics.illumination import RadialIllumination, optical_axis_px, relative_illumination
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


@dataclass(frozen=True)
class LensfunLens:
    """One lens at one focal length and aperture, in lensfun's units. None: not calibrated.

    `half_diagonal_mm`, `half_short_mm`: of the frame that it was calibrated on, the units of its radii. `distortion`:
    r_d / r_u as a function of r_u; `tca`: (v of red, v of blue); `vignetting`: k1, k2, k3.
    """

    model: str
    focal_length_mm: float
    half_diagonal_mm: float
    half_short_mm: float
    distortion: Callable[[FloatArray], FloatArray] | None = None
    tca: tuple[float, float] | None = None
    vignetting: tuple[float, float, float] | None = None


# --- writing ----------------------------------------------------------------------------------------------------------


def write_lensfun(file: Path, content: CameraFile) -> tuple[str, ...]:
    """Write the lens of a camera as a lensfun database of one lens. Returns what its laws don't hold. Raises InputError
    where the camera doesn't say the focal length."""
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
    if camera.cols != camera.rows:
        wide, narrow = max(camera.rows, camera.cols), min(camera.rows, camera.cols)
        ET.SubElement(entry, "aspect-ratio").text = f"{wide}:{narrow}"
    centre = _centre(camera)
    if centre != (0.0, 0.0):
        ET.SubElement(entry, "center", x=f"{centre[0]:.9g}", y=f"{centre[1]:.9g}")
    found = ET.SubElement(entry, "calibration")
    ET.SubElement(found, "distortion", model="poly5", focal=focal, k1=f"{k1:.9g}", k2=f"{k2:.9g}")
    if camera.cfa != "MONO":
        ET.SubElement(found, "tca", model="poly3", focal=focal, vr=f"{red:.9g}", vb=f"{blue:.9g}")
    named = {f"k{n}": f"{k:.9g}" for n, k in enumerate(shading, start=1)}
    for distance_m in ("10", f"{FAR_M:g}"):
        ET.SubElement(
            found, "vignetting", {"model": "pa", "focal": focal, "aperture": aperture, "distance": distance_m} | named
        )
    ET.indent(root)
    with replacing(file) as partial:
        partial.write_bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True))
    return (*remarks, *more)


def _half_short_px(camera: CameraModel) -> float:
    return 0.5 * min(camera.rows, camera.cols)


def _focal_px(camera: CameraModel) -> float:
    return camera.lens.known_focal_length_mm * 1e3 / camera.pixel_pitch_um


def _geometry(camera: CameraModel) -> Geometry:
    """Return the camera's geometry, or the pinhole that its focal length and pitch give."""
    if camera.geometry is not None:
        return camera.geometry
    f = _focal_px(camera)
    return Geometry(
        camera_matrix=((f, 0.0, 0.5 * (camera.cols - 1)), (0.0, f, 0.5 * (camera.rows - 1)), (0.0, 0.0, 1.0))
    )


def _centre(camera: CameraModel) -> tuple[float, float]:
    """Return the optical centre from the frame's middle (x, y), in lensfun's unit."""
    matrix = _geometry(camera).camera_matrix
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
    geometry, half = _geometry(camera), _half_short_px(camera)
    matrix = geometry.camera_matrix
    col, row = _grid(camera)
    to_col, to_row = (np.asarray(one, float) for one in distort(col, row, geometry))
    x, y = (col - matrix[0][2]) / half, (row - matrix[1][2]) / half
    u, v = (to_col - matrix[0][2]) / half, (to_row - matrix[1][2]) / half
    for one in effects:
        if isinstance(one, Distortion):
            share = one.corner_percent / 100.0 * (u * u + v * v) * (half / camera.half_diagonal_px) ** 2
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
    found = {}
    for channel, curve in camera.quantum_efficiency.items():
        wavelength_nm, value = curve.arrays
        t, weight = (wavelength_nm - REFERENCE_NM) / 100.0, value * np.gradient(wavelength_nm)
        total = float(weight.sum())
        found[channel] = (float((weight * t).sum()) / total, float((weight * t * t).sum()) / total)
    return found


def _scales(camera: CameraModel, effects: Sequence[Effect]) -> tuple[float, float]:
    """Radius of red and of blue over that of green."""
    if camera.cfa == "MONO":
        return 1.0, 1.0
    moments, scale = _moments(camera), dict.fromkeys(("R", "G", "B"), 1.0)
    for one in effects:
        if isinstance(one, LateralChromaticAberration):
            for channel, (mean, square) in moments.items():
                scale[channel] += (one.slope_um * mean + one.curvature_um * square) / camera.half_diagonal_um
    return scale["R"] / scale["G"], scale["B"] / scale["G"]


def _pa(camera: CameraModel, effects: Sequence[Effect]) -> tuple[tuple[float, float, float], tuple[str, ...]]:
    """k1, k2, k3 of pa, fitted to the camera's own fall-off of light over the frame."""
    col, row = _grid(camera)
    light = np.asarray(relative_illumination(camera, row, col), float).ravel()
    row0, col0 = optical_axis_px(camera)
    r2 = ((col - col0) ** 2 + (row - row0) ** 2) / camera.half_diagonal_px**2
    for one in effects:
        if isinstance(one, Vignetting):
            light = light * (1.0 - one.corner_loss_percent / 100.0 * r2 ** (0.5 * one.exponent))
    design = np.stack([r2, r2**2, r2**3], axis=1)
    k, *_ = np.linalg.lstsq(design, light - 1.0, rcond=None)
    left = float(np.abs(light - 1.0 - design @ k).max())
    remarks = (f"vignetting: pa leaves {100 * left:.2f} % of the light at most",) if left > TOLD_SHARE else ()
    return (float(k[0]), float(k[1]), float(k[2])), remarks


# --- reading ----------------------------------------------------------------------------------------------------------


def read_lensfun(file: Path, focal_length_mm: float, f_number: float, model: str = "") -> LensfunLens:
    """Return the lens `model` of a lensfun file, or its only one, as calibrated nearest to a focal length and an
    aperture.

    Raises InputError, one line that begins with the file: it isn't lensfun's, or holds several lenses or not this one.
    """
    try:
        if file.stat().st_size > MOST_BYTES:
            raise InputError(f"has {file.stat().st_size >> 20} MiB, beyond the limit of {MOST_BYTES >> 20}")  # noqa: TRY301
        root = ET.fromstring(file.read_bytes())
    except OSError as error:
        raise InputError(f"{file}: can't be read ({error.strerror}); give a lensfun XML file") from error
    except (ET.ParseError, InputError) as error:
        raise InputError(f"{file}: isn't lensfun's XML ({one_line(error)}); give a file of its database") from error
    lenses = {_text(one, "model"): one for one in root.iter("lens") if one.find("calibration") is not None}
    if root.tag != "lensdatabase" or not lenses:
        raise InputError(f"{file}: holds no lens with a calibration; give a file of lensfun's database")
    if not model and len(lenses) > 1:
        raise InputError(f"{file}: holds {len(lenses)} lenses, name one by --lens: {', '.join(sorted(lenses)[:8])}")
    if model and model not in lenses:
        raise InputError(f"{file}: holds no lens {model!r}; it has {', '.join(sorted(lenses)[:8])}")
    name = model or next(iter(lenses))
    try:
        return _lens(name, lenses[name], focal_length_mm, f_number)
    except InputError as error:
        raise InputError(f"{file}: lens {name!r}: {error}") from error


def _text(element: ET.Element, tag: str) -> str:
    return next((one.text or "" for one in element.findall(tag) if "lang" not in one.attrib), "")


def _lens(name: str, element: ET.Element, focal_length_mm: float, f_number: float) -> LensfunLens:
    calibration = element.find("calibration")
    assert calibration is not None

    def nearest(tag: str) -> ET.Element | None:
        """Return the entry nearest in focal length, then in aperture, then the farthest."""
        entries = [(_value(one, "focal"), one) for one in calibration.findall(tag) if one.get("model") != "none"]
        return min(
            entries,
            key=lambda pair: (
                abs(math.log(pair[0] / focal_length_mm)),
                abs(math.log(_value(pair[1], "aperture", f_number) / f_number)),
                -_value(pair[1], "distance", FAR_M),
            ),
            default=(0.0, None),
        )[1]

    bent, tca, dark = nearest("distortion"), nearest("tca"), nearest("vignetting")
    half_mm = 0.5 * FULL_FRAME_MM / _stated(_text(element, "cropfactor") or "1", "cropfactor")
    wide, _, narrow = (_text(element, "aspect-ratio") or "3:2").partition(":")
    aspect = _stated(wide, "aspect-ratio") / _stated(narrow or "1", "aspect-ratio")
    focal = next((_value(one, "focal") for one in (bent, tca, dark) if one is not None), None)
    if focal is None:
        raise InputError("has no calibration of distortion, tca or vignetting; take another lens")
    return LensfunLens(
        model=name,
        focal_length_mm=focal,
        half_diagonal_mm=half_mm,
        half_short_mm=half_mm / math.hypot(1.0, max(aspect, 1.0 / aspect)),
        distortion=None if bent is None else _distortion(bent),
        tca=None if tca is None else _tca(tca),
        vignetting=None if dark is None else _vignetting(dark),
    )


def _value(element: ET.Element, key: str, otherwise: float | None = None) -> float:
    text = element.get(key)
    if text is None:
        if otherwise is None:
            raise InputError(f"<{element.tag}> has no {key}; add it")
        return otherwise
    return _stated(text, f"{key} of <{element.tag}>", above_0=key in ("focal", "aperture", "distance"))


def _stated(text: str, what: str, above_0: bool = True) -> float:
    try:
        found = float(text)
    except ValueError:
        found = math.nan
    if not math.isfinite(found) or (above_0 and found <= 0):
        raise InputError(f"{what} is '{text[:20]}', not a number{' above 0' if above_0 else ''}; correct it")
    return found


def _distortion(element: ET.Element) -> Callable[[FloatArray], FloatArray]:
    model = element.get("model")
    if model == "poly3":
        k1 = _value(element, "k1", 0.0)
        return lambda r: 1.0 - k1 + k1 * r**2
    if model == "poly5":
        k1, k2 = _value(element, "k1", 0.0), _value(element, "k2", 0.0)
        return lambda r: 1.0 + k1 * r**2 + k2 * r**4
    if model == "ptlens":
        a, b, c = (_value(element, key, 0.0) for key in "abc")
        return lambda r: a * r**3 + b * r**2 + c * r + 1.0 - a - b - c
    raise InputError(f"distortion of model {model!r} isn't known here; poly3, poly5 and ptlens are")


def _tca(element: ET.Element) -> tuple[float, float]:
    model = element.get("model")
    if model == "linear":
        return _value(element, "kr", 1.0), _value(element, "kb", 1.0)
    if model == "poly3":
        # v + c r + b r^2 at the corner of a frame of 3:2 (r = 1.8), the place that lateral colour is stated of
        corner = math.hypot(1.5, 1.0)
        red, blue = (
            _value(element, f"v{one}", 1.0) + _value(element, f"c{one}", 0.0) * corner
            + _value(element, f"b{one}", 0.0) * corner**2
            for one in "rb"
        )  # fmt: skip
        return red, blue
    raise InputError(f"tca of model {model!r} isn't known here; linear and poly3 are")


def _vignetting(element: ET.Element) -> tuple[float, float, float]:
    if element.get("model") != "pa":
        raise InputError(f"vignetting of model {element.get('model')!r} isn't known here; pa is")
    return _value(element, "k1", 0.0), _value(element, "k2", 0.0), _value(element, "k3", 0.0)


def with_lens(content: CameraFile, lens: LensfunLens) -> tuple[CameraFile, tuple[str, ...]]:
    """Return the camera with a lens of lensfun's before it, in place of its own distortion, lateral colour and fall-off
    of light; and remarks on what OpenCV's distortion doesn't hold. Raises InputError where the laws make no lens."""
    camera, remarks = content.camera, []
    taken: list[type[Effect]] = []
    added: list[Effect] = []
    if lens.distortion is not None:
        geometry, left_px = _brown(camera, lens.distortion, lens.half_short_mm)
        camera = camera.model_copy(update={"geometry": geometry})
        taken.append(Distortion)
        if left_px > TOLD_PX:
            remarks.append(f"distortion: k1, k2, k3 leave {left_px:.2f} px of lensfun's law at most")
    if lens.vignetting is not None:
        off_px = math.hypot(*_centre(camera)) * _half_short_px(camera)
        radius = np.linspace(0.0, 1.0 + off_px / camera.half_diagonal_px, NODES)  # to every corner
        k1, k2, k3 = lens.vignetting
        r = radius * camera.half_diagonal_um * 1e-3 / lens.half_diagonal_mm
        light = 1.0 + k1 * r**2 + k2 * r**4 + k3 * r**6
        if not light.min() > 0:
            raise InputError(f"vignetting: the light is {light.min():.3g} at least, not above 0; take another lens")
        curve = RadialIllumination(
            radius_mm=tuple((radius * camera.half_diagonal_um * 1e-3).tolist()),
            relative_illumination=tuple(light.tolist()),
        )
        camera = camera.model_copy(update={"lens": camera.lens.model_copy(update={"illumination": curve})})
        taken.append(Vignetting)
    if lens.tca is not None and camera.cfa != "MONO":
        added.append(_lateral_colour(camera, lens.tca))
        taken.append(LateralChromaticAberration)
    kept = [one for one in content.effects if not isinstance(one, tuple(taken))]
    return replace(content, camera=camera, effects=(*kept, *added)), tuple(remarks)


def _brown(
    camera: CameraModel, law: Callable[[FloatArray], FloatArray], half_short_mm: float
) -> tuple[Geometry, float]:
    """OpenCV's distortion nearest to lensfun's law over the frame, and the greatest departure (px). What is
    in proportion to the radius goes into the focal length."""
    unit_px, radius_px = half_short_mm * 1e3 / camera.pixel_pitch_um, camera.half_diagonal_px
    share = np.linspace(0.0, 1.0, 8 * NODES)[1:]  # of the half diagonal
    lands = law(share * radius_px / unit_px) * share
    design = np.stack([share, share**3, share**5, share**7], axis=1)
    found, *_ = np.linalg.lstsq(design, lands, rcond=None)
    scale = float(found[0])
    if not scale > 0:
        raise InputError(f"distortion scales the centre by {scale:.3g}, not above 0; take another lens")
    left_px = float(np.abs(lands - design @ found).max()) * radius_px
    focal = _focal_px(camera) * scale
    k = found[1:] / scale * (_focal_px(camera) / radius_px) ** np.array([2, 4, 6])
    before: NDArray[np.float64] = np.array(_geometry(camera).camera_matrix)
    matrix = ((focal, 0.0, float(before[0, 2])), (0.0, focal, float(before[1, 2])), (0.0, 0.0, 1.0))
    return Geometry(camera_matrix=matrix, distortion=(float(k[0]), float(k[1]), 0.0, 0.0, float(k[2]))), left_px


def _lateral_colour(camera: CameraModel, tca: tuple[float, float]) -> LateralChromaticAberration:
    """Return the lateral colour that gives red and blue these radii over green's."""
    moments, r_um = _moments(camera), camera.half_diagonal_um
    (r1, r2), (g1, g2), (b1, b2) = (moments[channel] for channel in "RGB")
    # (R + a r1 + b r2) = v (R + a g1 + b g2) for red, and for blue: two equations for a, b
    rows = np.array([[one - v * g1, two - v * g2] for v, one, two in ((tca[0], r1, r2), (tca[1], b1, b2))])
    slope, curvature = np.linalg.solve(rows, np.array([(v - 1.0) * r_um for v in tca]))
    try:
        return LateralChromaticAberration(slope_um=float(slope), curvature_um=float(curvature))
    except ValueError as error:
        raise InputError(f"lateral colour: {one_line(error)}; take another lens") from error
