"""A camera's geometry, or a stereo pair's, as other programs keep it: OpenCV, ROS, Kalibr, COLMAP and mrcal.

The laws are those of `sim.scene.projection`, whose coefficients have the order of OpenCV's. What differs:

    OpenCV    `cv::FileStorage`, the keys of its samples: one camera of calibration.cpp, a pair of stereo_calib.cpp
    ROS       sensor_msgs/CameraInfo as camera_calibration_parsers reads it; lengths in m
    Kalibr    camchain: radtan (k1 k2 p1 p2) and equidistant; T_cn_cnm1 in m
    COLMAP    cameras.txt; (0.5, 0.5) is the centre of the top-left pixel, in all others (0, 0)
    mrcal     .cameramodel; the pose from the reference to the camera as Rodrigues' vector and m

Coefficients that a format has no place for are fitted by those that it has, over the frame; what is left is reported,
px.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lab.errors import InputError
from lab.formats.camera_file import CameraFile
from lab.formats.raw_file import replacing
from lab.formats.results.fit import StereoFit
from sim.camera import CameraModel, Geometry, ProjectionKind
from sim.effects.distortion import Distortion
from sim.scene.projection import COUNT, Projection
from sim.spectrum import FloatArray

#: Samples a side of the grid over the frame on which a law is fitted.
NODES = 41
#: Departure of a format's law from the camera's that is told (px).
TOLD_PX = 1e-6
METRE_PER_MM = 1e-3


@dataclass(frozen=True)
class Pair:
    """A second camera beside the first, the left one: x_right = rotation x_left + translation_mm."""

    right: CameraFile
    stereo: StereoFit

    @property
    def rotation(self) -> FloatArray:
        return np.asarray(self.stereo.rotation, float)

    @property
    def translation_mm(self) -> FloatArray:
        return np.asarray(self.stereo.translation_mm, float)


def pair_cameras(left: CameraFile, right: CameraFile, stereo: StereoFit) -> tuple[CameraFile, Pair]:
    """Return two cameras with the intrinsics that were fitted jointly with their pose, where the fit states them."""
    cameras = []
    for content, matrix, distortion, kind, angle_deg in (
        (
            left,
            stereo.camera_matrix_left,
            stereo.distortion_left,
            stereo.lens_projection_left,
            stereo.spline_angle_deg_left,
        ),
        (
            right,
            stereo.camera_matrix_right,
            stereo.distortion_right,
            stereo.lens_projection_right,
            stereo.spline_angle_deg_right,
        ),
    ):
        if matrix is None:
            cameras.append(content)
            continue
        geometry = Geometry(
            camera_matrix=matrix, distortion=distortion or (), projection=kind, spline_angle_deg=angle_deg
        )
        cameras.append(replace(content, camera=content.camera.model_copy(update={"geometry": geometry})))
    return cameras[0], Pair(cameras[1], stereo)


def geometry_of(camera: CameraModel) -> Geometry:
    """Return the camera's geometry, or the pinhole that its focal length and pitch give.

    >>> from lab.formats.camera_file import default_camera
    >>> round(geometry_of(default_camera().camera).camera_matrix[0][0], 1)  # 8 mm / 3.45 um
    2318.8
    """
    if camera.geometry is not None:
        return camera.geometry
    f = camera.lens.known_focal_length_mm * 1e3 / camera.pixel_pitch_um
    return Geometry(
        camera_matrix=((f, 0.0, 0.5 * (camera.cols - 1)), (0.0, f, 0.5 * (camera.rows - 1)), (0.0, 0.0, 1.0))
    )


@dataclass(frozen=True)
class _Intrinsics:
    """A projection that a format has a law for: fx, fy, cx, cy (px), and its coefficients in OpenCV's order."""

    kind: ProjectionKind
    focal_centre_px: tuple[float, float, float, float]
    coefficients: tuple[float, ...]
    remarks: tuple[str, ...]

    @property
    def camera_matrix(self) -> FloatArray:
        fx, fy, cx, cy = self.focal_centre_px
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _intrinsics(content: CameraFile, pinhole_counts: Sequence[int]) -> _Intrinsics:
    """Return a camera's intrinsics in the laws of a format.

    `pinhole_counts`: the numbers of coefficients that its pinholes have, ascending; the first that is enough is taken,
    padded with zeros. Without any, the last is fitted. A splined projection is fitted by the equidistant one. Raises
    InputError where there is no geometry and no focal length.
    """
    camera = content.camera
    if camera.geometry is None and camera.lens.focal_length_mm is None:
        raise InputError(
            f"{content.name}: neither geometry nor lens.focal_length_mm is set; write one into the camera file"
        )
    geometry = geometry_of(camera)
    projection = Projection.of(geometry)
    intrinsics = projection.intrinsics(geometry.camera_matrix, geometry.distortion)
    place = (float(intrinsics[0]), float(intrinsics[1]), float(intrinsics[2]), float(intrinsics[3]))
    remarks = _list_losses(content)
    if camera.geometry is None:
        remarks = (
            "geometry: not set; a pinhole of lens.focal_length_mm with its centre in the frame's middle is written",
            *remarks,
        )
    given = tuple(float(value) for value in geometry.distortion)
    used = max((place for place, value in enumerate(given, start=1) if value), default=0)
    if projection.kind == "pinhole":
        enough = [count for count in pinhole_counts if count >= used]
        if enough:
            return _Intrinsics("pinhole", place, (*given, *(0.0,) * 8)[: enough[0]], remarks)
        names = projection.coefficients[pinhole_counts[-1] : used]
        fitted, left_px = _fit_coefficients(camera, geometry, Projection("pinhole"), pinhole_counts[-1])
        lost = ", ".join(names)
    elif projection.kind == "equidistant":
        return _Intrinsics("equidistant", place, (*given, *(0.0,) * 4)[:4], remarks)
    else:
        fitted, left_px = _fit_coefficients(camera, geometry, Projection("equidistant"), 4)
        lost = "the splined stereographic projection"
    remarks = (*_departure(lost, left_px), *remarks)
    kind: ProjectionKind = "pinhole" if projection.kind == "pinhole" else "equidistant"
    return _Intrinsics(kind, place, fitted, remarks)


def _departure(lost: str, left_px: float) -> tuple[str, ...]:
    """Return the line on a law that a format doesn't have, with the greatest distance that is left (px)."""
    size = f"{left_px:.2f}" if left_px >= 0.01 else f"{left_px:.1e}"
    is_reported = left_px > TOLD_PX
    return (f"distortion: no place for {lost}; the fitted law leaves {size} px at most",) if is_reported else ()


def _frame(camera: CameraModel, geometry: Geometry) -> tuple[FloatArray, FloatArray]:
    """Return places over the frame that the camera sees, px (n, 2), and their rays (n, 3)."""
    projection = Projection.of(geometry)
    row, col = np.meshgrid(
        np.linspace(0.0, camera.rows - 1.0, NODES), np.linspace(0.0, camera.cols - 1.0, NODES), indexing="ij"
    )
    image = np.column_stack([col.ravel(), row.ravel()])
    rays = projection.unproject(image, projection.intrinsics(geometry.camera_matrix, geometry.distortion))
    seen = np.all(np.isfinite(rays), axis=1)
    return image[seen], rays[seen]


def _fit_coefficients(
    camera: CameraModel, geometry: Geometry, to: Projection, count: int
) -> tuple[tuple[float, ...], float]:
    """Return the first `count` coefficients of a law, fitted to a geometry over the frame by least squares in px, and
    the greatest distance that is left (px). The law is linear in them, up to the denominator's, which aren't fitted."""
    image, rays = _frame(camera, geometry)
    seen = to.sees(rays)
    image, rays = image[seen], rays[seen]
    intrinsics = Projection.of(geometry).intrinsics(geometry.camera_matrix)
    plain = np.zeros(COUNT)
    plain[:4] = intrinsics[:4]
    at, _, by_camera = to.project_with_jacobian(rays, plain)
    places = [to.names.index(name) for name in to.coefficients[:count]]
    design = by_camera[:, :, places].reshape(-1, count)
    miss = (image - at).ravel()
    scale = np.linalg.norm(design, axis=0)
    solved, *_ = np.linalg.lstsq(design / scale, miss, rcond=None)
    left = (miss - design @ (solved / scale)).reshape(-1, 2)
    return tuple(float(value) for value in solved / scale), float(np.hypot(*left.T).max())


def _list_losses(content: CameraFile) -> tuple[str, ...]:
    """Return a line on the effects of a camera file, with the size of what bends the image further."""
    named = []
    for effect in content.effects:
        moved_px = (
            abs(effect.corner_percent) / 100.0 * content.camera.half_diagonal_px
            if isinstance(effect, Distortion)
            else 0.0
        )
        named.append(f"{effect.name}: {moved_px:.2f} px in the corners" if moved_px else effect.name)
    return (f"effects: left out ({', '.join(named)})",) if named else ()


def _sides(content: CameraFile, pair: Pair | None) -> dict[str, CameraFile]:
    return {"": content} if pair is None else {"left": content, "right": pair.right}


def _name_side(side: str, remarks: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{side}: {remark}" if side else remark for remark in remarks)


def _beside(file: Path, side: str) -> Path:
    """Return the file of one camera of a pair, where a format has one for each: NAME-left.yaml."""
    return file.with_name(f"{file.stem}-{side}{file.suffix}") if side else file


def _write(file: Path, text: str) -> None:
    with replacing(file) as partial:
        partial.write_text(text, encoding="utf-8")


def _yaml(document: Mapping[str, Any]) -> str:
    return yaml.safe_dump(dict(document), sort_keys=False, default_flow_style=None, width=10_000)


def write_opencv(file: Path, content: CameraFile, pair: Pair | None = None) -> tuple[str, ...]:
    """Write OpenCV's FileStorage: YAML, XML or JSON by the ending.

    file : to be written
    content : the camera, of a pair the left one
    pair : the right camera and the pose; then the keys are M1, D1, M2, D2, R, T (mm), and R1, R2, P1, P2, Q where the
        fit has a rectification

    Returns what the format has no place for. Raises InputError for another ending.

    >>> from tempfile import TemporaryDirectory
    >>> from lab.formats.camera_file import default_camera
    >>> with TemporaryDirectory() as folder:
    ...     _ = write_opencv(Path(folder) / "left.json", default_camera())
    ...     "camera_matrix" in (Path(folder) / "left.json").read_text()
    True
    """
    import cv2

    if file.suffix.lower() not in (".yaml", ".yml", ".xml", ".json"):
        raise InputError(f"--to {file}: name a file that ends in .yaml, .yml, .xml or .json")
    cameras = _sides(content, pair)
    intrinsics_of_side = {side: _intrinsics(camera, (5, 8)) for side, camera in cameras.items()}
    store = cv2.FileStorage(file.suffix.lower(), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    remarks: tuple[str, ...] = ()
    for number, (side, intrinsics) in enumerate(intrinsics_of_side.items(), start=1):
        camera, end = cameras[side].camera, f"_{side}" if side else ""
        store.write(f"image_width{end}", camera.cols)
        store.write(f"image_height{end}", camera.rows)
        store.write(f"fisheye_model{end}", int(intrinsics.kind == "equidistant"))
        store.write(f"M{number}" if side else "camera_matrix", intrinsics.camera_matrix)
        store.write(
            f"D{number}" if side else "distortion_coefficients", np.array(intrinsics.coefficients).reshape(-1, 1)
        )
        remarks += _name_side(side, intrinsics.remarks)
    if pair is not None:
        store.write("R", pair.rotation)
        store.write("T", pair.translation_mm.reshape(3, 1))
        if pair.stereo.rectification is not None:
            at = pair.stereo.rectification
            for name, value in (
                ("R1", at.rotation_left),
                ("R2", at.rotation_right),
                ("P1", at.projection_left),
                ("P2", at.projection_right),
                ("Q", at.disparity_to_depth),
            ):
                store.write(name, np.asarray(value, float))
    _write(file, store.releaseAndGetString())
    return remarks


_ROS_MODELS = {5: "plumb_bob", 8: "rational_polynomial", 4: "equidistant"}


def write_ros(file: Path, content: CameraFile, pair: Pair | None = None) -> tuple[str, ...]:
    """Write ROS's camera_info, of a pair NAME-left and NAME-right. Returns what it has no place for; raises InputError.

    R and P of a pair are the fit's rectification; without one, and of one camera, R is the identity and P the camera
    matrix.
    """
    remarks: tuple[str, ...] = ()
    at = pair.stereo.rectification if pair is not None else None
    for side, side_content in _sides(content, pair).items():
        intrinsics = _intrinsics(side_content, (5, 8))
        rotation, projection = np.eye(3), np.column_stack([intrinsics.camera_matrix, np.zeros(3)])
        if at is not None:
            rotation = np.asarray(at.rotation_left if side == "left" else at.rotation_right, float)
            projection = np.array(at.projection_left if side == "left" else at.projection_right, float)
            projection[:, 3] *= METRE_PER_MM
        document = {
            "image_width": side_content.camera.cols,
            "image_height": side_content.camera.rows,
            "camera_name": re.sub(r"\W+", "_", side_content.name) or "camera",
            "camera_matrix": _matrix(intrinsics.camera_matrix),
            "distortion_model": _ROS_MODELS[len(intrinsics.coefficients)],
            "distortion_coefficients": _matrix(np.array([intrinsics.coefficients])),
            "rectification_matrix": _matrix(rotation),
            "projection_matrix": _matrix(projection),
        }
        _write(_beside(file, side), _yaml(document))
        remarks += _name_side(side, intrinsics.remarks)
    if pair is not None and at is None:
        remarks += (f"pose: left out, the fit has no rectification (baseline {pair.stereo.baseline_mm:g} mm)",)
    return remarks


def _matrix(values: FloatArray) -> dict[str, Any]:
    return {"rows": values.shape[0], "cols": values.shape[1], "data": values.ravel().tolist()}


def write_kalibr(file: Path, content: CameraFile, pair: Pair | None = None) -> tuple[str, ...]:
    """Write Kalibr's camchain: cam0, and of a pair cam1 with its pose. Returns what it has no place for; raises
    InputError.
    """
    document: dict[str, Any] = {}
    remarks: tuple[str, ...] = ()
    for number, (side, side_content) in enumerate(_sides(content, pair).items()):
        intrinsics = _intrinsics(side_content, (4,))
        entry: dict[str, Any] = {}
        if pair is not None:
            entry["cam_overlaps"] = [1 - number]
        if pair is not None and number == 1:
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = pair.rotation, pair.translation_mm * METRE_PER_MM
            entry["T_cn_cnm1"] = pose.tolist()
        document[f"cam{number}"] = entry | {
            "camera_model": "pinhole",
            "intrinsics": list(intrinsics.focal_centre_px),
            "distortion_model": "radtan" if intrinsics.kind == "pinhole" else "equidistant",
            "distortion_coeffs": list(intrinsics.coefficients),
            "resolution": [side_content.camera.cols, side_content.camera.rows],
            "rostopic": f"/cam{number}/image_raw",
        }
        remarks += _name_side(side, intrinsics.remarks)
    _write(file, _yaml(document))
    return remarks


_COLMAP_MODELS = {0: "PINHOLE", 4: "OPENCV", 8: "FULL_OPENCV"}


def write_colmap(file: Path, content: CameraFile, pair: Pair | None = None) -> tuple[str, ...]:
    """Write COLMAP's cameras.txt, of a pair with cameras 1 and 2. Returns what it has no place for; raises
    InputError.
    """
    lines = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    remarks: tuple[str, ...] = ()
    for number, (side, side_content) in enumerate(_sides(content, pair).items(), start=1):
        intrinsics = _intrinsics(side_content, (0, 4, 8))
        model = "OPENCV_FISHEYE" if intrinsics.kind == "equidistant" else _COLMAP_MODELS[len(intrinsics.coefficients)]
        fx, fy, cx, cy = intrinsics.focal_centre_px
        numbers = " ".join(repr(value) for value in (fx, fy, cx + 0.5, cy + 0.5, *intrinsics.coefficients))
        lines.append(f"{number} {model} {side_content.camera.cols} {side_content.camera.rows} {numbers}")
        remarks += _name_side(side, intrinsics.remarks)
    _write(file, "\n".join(lines) + "\n")
    if pair is not None:
        remarks += (f"pose: left out, cameras.txt has none (baseline {pair.stereo.baseline_mm:g} mm)",)
    return remarks


_MRCAL_MODELS = {0: "LENSMODEL_PINHOLE", 4: "LENSMODEL_OPENCV4", 5: "LENSMODEL_OPENCV5", 8: "LENSMODEL_OPENCV8"}


def write_mrcal(file: Path, content: CameraFile, pair: Pair | None = None) -> tuple[str, ...]:
    """Write mrcal's .cameramodel, of a pair NAME-left and NAME-right with the left camera as the reference. Returns
    what it has no place for; raises InputError. A fisheye becomes its splined stereographic projection.
    """
    import cv2

    remarks: tuple[str, ...] = ()
    for side, side_content in _sides(content, pair).items():
        pose = np.zeros(6)
        if pair is not None and side == "right":
            pose[:3] = cv2.Rodrigues(pair.rotation)[0].ravel()
            pose[3:] = pair.translation_mm * METRE_PER_MM
        if side_content.camera.geometry is not None and side_content.camera.geometry.projection != "pinhole":
            model, numbers, losses = _convert_to_splines(side_content, side_content.camera.geometry)
        else:
            intrinsics = _intrinsics(side_content, (0, 4, 5, 8))
            model, losses = _MRCAL_MODELS[len(intrinsics.coefficients)], intrinsics.remarks
            numbers = (*intrinsics.focal_centre_px, *intrinsics.coefficients)
        text = (
            f"# {' '.join(side_content.name.split())}, by calibench\n"
            "{\n"
            f"    'lensmodel':  '{model}',\n\n"
            f"    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....\n"
            f"    'intrinsics': {_format_list(numbers)},\n\n"
            f"    # the transformation from the reference to the camera: Rodrigues' vector, and m\n"
            f"    'extrinsics': {_format_list(pose)},\n\n"
            f"    'imagersize': [ {side_content.camera.cols}, {side_content.camera.rows}, ]\n"
            "}\n"
        )
        _write(_beside(file, side), text)
        remarks += _name_side(side, losses)
    return remarks


#: Control points across the frame's width of the surfaces that mrcal splines, samples an interval when they are fitted,
#: and intervals of a cubic surface that its outermost control points don't span (mrcal.c).
_ACROSS, _SAMPLES, _MARGIN = 40, 6, 2


def _convert_to_splines(content: CameraFile, geometry: Geometry) -> tuple[str, tuple[float, ...], tuple[str, ...]]:
    """Return mrcal's LENSMODEL_SPLINED_STEREOGRAPHIC of a fisheye: its name, its intrinsics, and what is left.

    u = 2 tan(theta / 2) in the direction of the ray; q = f (u + d(u)) + c, with d two surfaces of cubic B-splines over
    a grid of control points, the middle of which is u = 0 (mrcal's documentation, `LENSMODEL_SPLINED_STEREOGRAPHIC`).
    """
    from scipy.interpolate import BSpline  # here: the library takes a while to load

    fitted, stereographic = Projection.of(geometry), Projection("splined_stereographic", 90.0)
    intrinsics = fitted.intrinsics(geometry.camera_matrix, geometry.distortion)
    focal, centre = intrinsics[:2], intrinsics[2:4]
    image, rays = _frame(content.camera, geometry)
    u = np.column_stack(stereographic.plane(rays))
    reach = np.abs(u).max(axis=0)
    # a whole number of degrees, and one more, so that the frame's edge is inside
    degrees = int(np.ceil(np.rad2deg(4.0 * np.arctan(reach[0] / 2.0)))) + 1
    per_u = (_ACROSS - 1 - _MARGIN) / (4.0 * np.tan(np.deg2rad(degrees) / 4.0))
    counts = (_ACROSS, int(np.ceil(2.0 * reach[1] * per_u)) + 2 + _MARGIN)

    def basis(at_u: FloatArray, count: int) -> FloatArray:
        """B-splines (n, count) at places of one axis; control point k is at k, the middle of all at u = 0."""
        place = at_u * per_u + 0.5 * (count - 1)
        return np.asarray(BSpline.design_matrix(place, np.arange(-2.0, count + 2.0), 3).toarray())

    axes = [
        np.linspace(-half, half, _SAMPLES * count)
        for count in counts
        for half in [(0.5 * (count - 1) - 1.0 - 1e-9) / per_u]
    ]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)  # rows: y
    shift = (fitted.project(stereographic.rays(*grid.T), intrinsics) - centre) / focal - grid
    across, down = (np.linalg.pinv(basis(axis, count)) for axis, count in zip(axes, counts, strict=True))
    surfaces = shift.reshape(len(axes[1]), len(axes[0]), 2)
    control = np.einsum("ia,abk,jb->ijk", down, surfaces, across, optimize=True)
    bent = np.einsum("ni,ijk,nj->nk", basis(u[:, 1], counts[1]), control, basis(u[:, 0], counts[0]), optimize=True)
    left_px = float(np.hypot(*((u + bent) * focal + centre - image).T).max())
    model = f"LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx={counts[0]}_Ny={counts[1]}_fov_x_deg={degrees}"
    numbers = (*intrinsics[:4].tolist(), *control.ravel().tolist())
    return model, numbers, (*_departure(f"the {fitted.kind} projection", left_px), *_list_losses(content))


def _format_list(values: Sequence[float] | FloatArray) -> str:
    return f"[ {' '.join(f'{float(value)!r},' for value in values)} ]"
