"""Geometry in others' formats: each file is read by another program's reader, or by its grammar, and projects points
where the camera file does, to 1e-9 px. The limit is the rounding of some ten operations on px of up to 1,500: 1e-12."""

from __future__ import annotations

import ast
import ctypes
import re
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from lab import cli
from lab.errors import InputError
from lab.formats.camera_file import CameraFile, default_camera, write_camera
from lab.formats.geometry_files import (
    TOLD_PX,
    Pair,
    pair_cameras,
    write_colmap,
    write_kalibr,
    write_mrcal,
    write_opencv,
    write_ros,
)
from lab.formats.result_file import write_result
from lab.formats.results.fit import FitResult, Rectification, StereoFit
from sim.camera import Geometry
from sim.effects.distortion import Distortion
from sim.effects.vignetting import Vignetting
from sim.scene.projection import Projection
from sim.spectrum import FloatArray

CLOSE_PX = 1e-9
MATRIX = ((1100.0, 0.0, 641.3), (0.0, 1104.0, 470.2), (0.0, 0.0, 1.0))
GEOMETRIES = {
    "ideal": Geometry(camera_matrix=MATRIX),
    "k1 k2 p1 p2": Geometry(camera_matrix=MATRIX, distortion=(-0.2, 0.1, 1e-3, -5e-4, 0.0)),
    "k3": Geometry(camera_matrix=MATRIX, distortion=(-0.2, 0.1, 1e-3, -5e-4, 0.02)),
    "k6": Geometry(camera_matrix=MATRIX, distortion=(-0.2, 0.1, 1e-3, -5e-4, 0.02, 0.01, 0.03, 0.02)),
    "fisheye": Geometry(camera_matrix=MATRIX, distortion=(0.01, -0.02, 0.003, -0.001), projection="equidistant"),
}
SPLINED = Geometry(
    camera_matrix=MATRIX,
    distortion=(-0.01, -0.02, 1e-4, -1e-4, -0.02, -0.03, -0.03, -0.02),
    projection="splined_stereographic",
    spline_angle_deg=60.0,
)
#: A fisheye whose frame is 186 deg wide.
WIDE = Geometry(
    camera_matrix=((380.0, 0.0, 641.3), (0.0, 380.0, 470.2), (0.0, 0.0, 1.0)),
    distortion=(0.02, -0.002, 0.0, 0.0),
    projection="equidistant",
)
#: Points before the camera (m), out to 33 deg from its axis.
POINTS = np.array([[x, y, 1.5] for x in np.linspace(-0.8, 0.8, 9) for y in np.linspace(-0.6, 0.6, 7)])
#: The right camera: turned by some degrees about all axes, 120 mm beside the left.
ROTATION = cv2.Rodrigues(np.array([0.02, -0.05, 0.01]))[0]
TRANSLATION_MM = np.array([-120.0, 1.5, 3.0])


def camera(geometry: Geometry | None, name: str = "front left") -> CameraFile:
    content = default_camera()
    return replace(content, name=name, camera=content.camera.model_copy(update={"geometry": geometry}))


def projected(geometry: Geometry, points: FloatArray = POINTS) -> FloatArray:
    projection = Projection.of(geometry)
    return projection.project(points, projection.intrinsics(geometry.camera_matrix, geometry.distortion))


def opencv(matrix: FloatArray, distortion: FloatArray, fisheye: bool, points: FloatArray = POINTS) -> FloatArray:
    """OpenCV's own projection."""
    no = np.zeros(3)
    if fisheye:
        found, _ = cv2.fisheye.projectPoints(points[:, None], no, no, np.asarray(matrix), np.asarray(distortion))
    else:
        found, _ = cv2.projectPoints(points[:, None], no, no, np.asarray(matrix), np.asarray(distortion))
    return np.asarray(found).reshape(-1, 2)


def pair(left: Geometry, right: Geometry) -> tuple[CameraFile, Pair]:
    """Two cameras whose intrinsics are those fitted with the pose, not those of the camera files."""
    stereo = StereoFit(
        rotation=tuple(map(tuple, ROTATION.tolist())),
        translation_mm=tuple(TRANSLATION_MM.tolist()),
        baseline_mm=float(np.linalg.norm(TRANSLATION_MM)),
        rms_px=0.1,
        pairs=20,
        **{
            f"{key}_{side}": value
            for side, of in (("left", left), ("right", right))
            for key, value in (
                ("camera_matrix", of.camera_matrix),
                ("distortion", of.distortion),
                ("lens_projection", of.projection),
            )
        },
    )
    return pair_cameras(camera(GEOMETRIES["ideal"]), camera(GEOMETRIES["ideal"], "front right"), stereo)


def rectified(of: Pair) -> Pair:
    """The same with OpenCV's rectification."""
    left, right = (
        (np.array(matrix), np.array(distortion))
        for matrix, distortion in (
            (of.stereo.camera_matrix_left, of.stereo.distortion_left),
            (of.stereo.camera_matrix_right, of.stereo.distortion_right),
        )
    )
    r1, r2, p1, p2, q, *_ = cv2.stereoRectify(*left, *right, (1280, 960), ROTATION, TRANSLATION_MM[:, None])
    listed = [tuple(map(tuple, np.asarray(one).tolist())) for one in (r1, r2, p1, p2, q)]
    names = ("rotation_left", "rotation_right", "projection_left", "projection_right", "disparity_to_depth")
    at = Rectification(**dict(zip(names, listed, strict=True)), row_rms_px=None)
    return Pair(of.right, of.stereo.model_copy(update={"rectification": at}))


# --- OpenCV -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", ["yaml", "xml", "json"])
@pytest.mark.parametrize("name", GEOMETRIES)
def test_opencv_reads_its_own_file(tmp_path: Path, name: str, ending: str) -> None:
    file = tmp_path / f"c.{ending}"
    assert write_opencv(file, camera(GEOMETRIES[name])) == ()
    store = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    assert (store.getNode("image_width").real(), store.getNode("image_height").real()) == (1280, 960)
    matrix, distortion = (store.getNode(key).mat() for key in ("camera_matrix", "distortion_coefficients"))
    found = opencv(matrix, distortion, bool(store.getNode("fisheye_model").real()))
    np.testing.assert_allclose(found, projected(GEOMETRIES[name]), rtol=0, atol=CLOSE_PX)


def test_opencv_reads_a_pair(tmp_path: Path) -> None:
    left, both = pair(GEOMETRIES["k3"], GEOMETRIES["k6"])
    assert write_opencv(tmp_path / "p.yml", left, rectified(both)) == ()
    store = cv2.FileStorage(str(tmp_path / "p.yml"), cv2.FILE_STORAGE_READ)
    at = {key: store.getNode(key).mat() for key in ("M1", "D1", "M2", "D2", "R", "T", "R1", "R2", "P1", "P2", "Q")}
    np.testing.assert_allclose(opencv(at["M1"], at["D1"], False), projected(GEOMETRIES["k3"]), rtol=0, atol=CLOSE_PX)
    beside = POINTS * 1e3 @ at["R"].T + at["T"].ravel()
    expected = projected(GEOMETRIES["k6"], POINTS * 1e3 @ ROTATION.T + TRANSLATION_MM)
    np.testing.assert_allclose(opencv(at["M2"], at["D2"], False, beside), expected, rtol=0, atol=CLOSE_PX)
    assert both.stereo.rectification is None and at["P2"].shape == (3, 4) and at["Q"].shape == (4, 4)


def test_another_ending_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"ends in \.yaml"):
        write_opencv(tmp_path / "c.txt", camera(GEOMETRIES["k3"]))


# --- ROS --------------------------------------------------------------------------------------------------------------


def array(entry: dict[str, Any]) -> FloatArray:
    return np.array(entry["data"], float).reshape(entry["rows"], entry["cols"])


@pytest.mark.parametrize(
    ("name", "model"),
    [("ideal", "plumb_bob"), ("k3", "plumb_bob"), ("k6", "rational_polynomial"), ("fisheye", "equidistant")],
)
def test_camera_info_projects_as_the_camera(tmp_path: Path, name: str, model: str) -> None:
    assert write_ros(tmp_path / "c.yaml", camera(GEOMETRIES[name])) == ()
    info = yaml.safe_load((tmp_path / "c.yaml").read_text())
    assert info["distortion_model"] == model and info["camera_name"] == "front_left"
    assert (info["image_width"], info["image_height"]) == (1280, 960)
    found = opencv(array(info["camera_matrix"]), array(info["distortion_coefficients"]), model == "equidistant")
    np.testing.assert_allclose(found, projected(GEOMETRIES[name]), rtol=0, atol=CLOSE_PX)
    np.testing.assert_array_equal(array(info["rectification_matrix"]), np.eye(3))
    np.testing.assert_array_equal(array(info["projection_matrix"]), np.column_stack([MATRIX, np.zeros(3)]))


def test_camera_info_of_a_pair_rectifies_it(tmp_path: Path) -> None:
    """CameraInfo's definition: P [R X; 1] is a point of the left camera, X in m, in both rectified frames."""
    left, both = pair(GEOMETRIES["k3"], GEOMETRIES["k6"])
    assert write_ros(tmp_path / "p.yaml", left, rectified(both)) == ()
    one, other = (yaml.safe_load((tmp_path / f"p-{side}.yaml").read_text()) for side in ("left", "right"))
    in_rectified = POINTS @ array(one["rectification_matrix"]).T
    at = [
        np.column_stack([in_rectified, np.ones(len(POINTS))]) @ array(info["projection_matrix"]).T
        for info in (one, other)
    ]
    left_px, right_px = (values[:, :2] / values[:, 2:] for values in at)
    beside = (POINTS @ ROTATION.T + TRANSLATION_MM * 1e-3) @ array(other["rectification_matrix"]).T
    direct = beside @ array(other["projection_matrix"])[:, :3].T
    np.testing.assert_allclose(right_px, direct[:, :2] / direct[:, 2:], rtol=0, atol=CLOSE_PX)
    np.testing.assert_allclose(left_px[:, 1], right_px[:, 1], rtol=0, atol=CLOSE_PX)


#: ROS's own parser (camera_calibration_parsers), where the distribution puts its program.
ROS_CONVERT = Path("/usr/lib/camera_calibration_parsers/convert")


@pytest.mark.parametrize("name", ["ideal", "k3", "k6", "fisheye", "pair"])
def test_ross_own_parser_reads_every_number(tmp_path: Path, name: str) -> None:
    """It reads the file into a CameraInfo and writes that with all its digits."""
    if not ROS_CONVERT.is_file():
        pytest.skip("ROS's parser isn't installed (the distribution's camera-calibration-parsers-tools)")
    if name == "pair":
        left, both = pair(GEOMETRIES["k3"], GEOMETRIES["k6"])
        write_ros(tmp_path / "c.yaml", left, rectified(both))
    else:
        write_ros(tmp_path / "c.yaml", camera(GEOMETRIES[name]))
    files = sorted(tmp_path.glob("c*.yaml"))
    assert len(files) == (2 if name == "pair" else 1)
    for file in files:
        back = tmp_path / f"back-{file.name}"
        done = subprocess.run([ROS_CONVERT, file, back], capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0 and back.is_file(), done.stdout + done.stderr
        assert yaml.safe_load(back.read_text()) == yaml.safe_load(file.read_text())


def test_a_pair_without_rectification_is_told(tmp_path: Path) -> None:
    remarks = write_ros(tmp_path / "p.yaml", *pair(GEOMETRIES["k3"], GEOMETRIES["k3"]))
    assert remarks == ("pose: left out, the fit has no rectification (baseline 120.047 mm)",)


# --- Kalibr -----------------------------------------------------------------------------------------------------------


def kalibr(entry: dict[str, Any], points: FloatArray) -> FloatArray:
    """Kalibr's models, by its page of supported models: radtan (k1 k2 r1 r2), equidistant (k1 k2 k3 k4)."""
    fu, fv, pu, pv = entry["intrinsics"]
    a, b, c, d = entry["distortion_coeffs"]
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x**2 + y**2
    if entry["distortion_model"] == "radtan":
        u = x * (1 + a * r2 + b * r2**2) + 2 * c * x * y + d * (r2 + 2 * x**2)
        v = y * (1 + a * r2 + b * r2**2) + c * (r2 + 2 * y**2) + 2 * d * x * y
    else:
        angle = np.arctan(np.sqrt(r2))
        scale = angle * (1 + a * angle**2 + b * angle**4 + c * angle**6 + d * angle**8)
        with np.errstate(invalid="ignore"):
            scale = np.where(r2 > 0, scale / np.sqrt(r2), 1.0)
        u, v = x * scale, y * scale
    return np.column_stack([fu * u + pu, fv * v + pv])


@pytest.mark.parametrize("name", ["ideal", "k1 k2 p1 p2", "fisheye"])
def test_kalibr_projects_as_the_camera(tmp_path: Path, name: str) -> None:
    assert write_kalibr(tmp_path / "c.yaml", camera(GEOMETRIES[name])) == ()
    (entry,) = yaml.safe_load((tmp_path / "c.yaml").read_text()).values()
    assert entry["camera_model"] == "pinhole" and entry["resolution"] == [1280, 960]
    np.testing.assert_allclose(kalibr(entry, POINTS), projected(GEOMETRIES[name]), rtol=0, atol=CLOSE_PX)


def test_kalibr_has_a_pairs_pose(tmp_path: Path) -> None:
    assert write_kalibr(tmp_path / "c.yaml", *pair(GEOMETRIES["k1 k2 p1 p2"], GEOMETRIES["fisheye"])) == ()
    chain = yaml.safe_load((tmp_path / "c.yaml").read_text())
    assert list(chain) == ["cam0", "cam1"] and "T_cn_cnm1" not in chain["cam0"]
    pose = np.array(chain["cam1"]["T_cn_cnm1"])
    beside = (np.column_stack([POINTS, np.ones(len(POINTS))]) @ pose.T)[:, :3]
    expected = projected(GEOMETRIES["fisheye"], POINTS @ ROTATION.T + TRANSLATION_MM * 1e-3)
    np.testing.assert_allclose(kalibr(chain["cam1"], beside), expected, rtol=0, atol=CLOSE_PX)


@pytest.mark.parametrize(("name", "lost"), [("k3", "k3"), ("k6", "k3, k4, k5, k6")])
def test_what_is_lost_is_told_with_its_size(tmp_path: Path, name: str, lost: str) -> None:
    """The warning's size is the greatest distance over the frame, and no less than anywhere else in it."""
    (remark,) = write_kalibr(tmp_path / "c.yaml", camera(GEOMETRIES[name]))
    told = re.fullmatch(rf"distortion: no place for {lost}; the fitted law leaves (\S+) px at most", remark)
    assert told is not None
    (entry,) = yaml.safe_load((tmp_path / "c.yaml").read_text()).values()
    inside = projected(GEOMETRIES[name])
    seen = np.all((inside >= 0) & (inside <= (1279, 959)), axis=1)
    left_px = np.hypot(*(kalibr(entry, POINTS) - inside)[seen].T).max()
    # a grid of 41 nodes a side misses the greatest distance, at a corner or an edge, by nothing: the corners are nodes
    assert 0 < left_px <= float(told[1]) * 1.1 and float(told[1]) < 1.0


def test_a_splined_projection_is_fitted(tmp_path: Path) -> None:
    for write, name in (
        (write_opencv, "c.yaml"),
        (write_ros, "r.yaml"),
        (write_kalibr, "k.yaml"),
        (write_colmap, "c.txt"),
    ):
        (remark,) = write(tmp_path / name, camera(SPLINED))
        told = re.fullmatch(r"distortion: no place for the splined .*; the fitted law leaves (\S+) px at most", remark)
        assert told is not None and float(told[1]) < 1.0
    (entry,) = yaml.safe_load((tmp_path / "k.yaml").read_text()).values()
    left_px = np.hypot(*(kalibr(entry, POINTS) - projected(SPLINED)).T).max()
    assert left_px < 1.1 * float(told[1])


# --- COLMAP -----------------------------------------------------------------------------------------------------------


def colmap_cameras(file: Path) -> dict[int, tuple[str, int, int, list[float]]]:
    rows = [line.split() for line in file.read_text().splitlines() if line and not line.startswith("#")]
    return {int(row[0]): (row[1], int(row[2]), int(row[3]), [float(word) for word in row[4:]]) for row in rows}


@pytest.mark.parametrize(
    ("name", "model"),
    [
        ("ideal", "PINHOLE"),
        ("k1 k2 p1 p2", "OPENCV"),
        ("k3", "FULL_OPENCV"),
        ("k6", "FULL_OPENCV"),
        ("fisheye", "OPENCV_FISHEYE"),
    ],
)
def test_colmap_projects_as_the_camera(tmp_path: Path, name: str, model: str) -> None:
    """Half a pixel further: COLMAP's image begins at 0, not its first pixel's centre."""
    assert write_colmap(tmp_path / "cameras.txt", camera(GEOMETRIES[name])) == ()
    ((found, width, height, numbers),) = colmap_cameras(tmp_path / "cameras.txt").values()
    assert (found, width, height) == (model, 1280, 960)
    fx, fy, cx, cy, *rest = numbers
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    at = opencv(matrix, np.array(rest or [0.0] * 4), model == "OPENCV_FISHEYE")
    np.testing.assert_allclose(at - 0.5, projected(GEOMETRIES[name]), rtol=0, atol=CLOSE_PX)


@pytest.mark.parametrize("name", GEOMETRIES)
def test_colmap_itself_agrees(tmp_path: Path, name: str) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap isn't installed; its laws are compared by OpenCV above")
    write_colmap(tmp_path / "cameras.txt", camera(GEOMETRIES[name]))
    for empty in ("images.txt", "points3D.txt"):
        (tmp_path / empty).write_text("")
    scene = pycolmap.Reconstruction()
    scene.read_text(str(tmp_path))
    found = np.array(scene.cameras[1].img_from_cam(POINTS))
    np.testing.assert_allclose(found - 0.5, projected(GEOMETRIES[name]), rtol=0, atol=CLOSE_PX)


def test_colmaps_pair_loses_its_pose(tmp_path: Path) -> None:
    remarks = write_colmap(tmp_path / "cameras.txt", *pair(GEOMETRIES["k3"], GEOMETRIES["fisheye"]))
    assert remarks == ("pose: left out, cameras.txt has none (baseline 120.047 mm)",)
    assert [row[0] for row in colmap_cameras(tmp_path / "cameras.txt").values()] == ["FULL_OPENCV", "OPENCV_FISHEYE"]


# --- mrcal ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "model"),
    [("ideal", "PINHOLE"), ("k1 k2 p1 p2", "OPENCV4"), ("k3", "OPENCV5"), ("k6", "OPENCV8")],
)
def test_a_cameramodel_is_a_dict_that_projects_as_the_camera(tmp_path: Path, name: str, model: str) -> None:
    """mrcal documents the format as a Python dict, in which `lensmodel` stands before `intrinsics`."""
    assert write_mrcal(tmp_path / "c.cameramodel", camera(GEOMETRIES[name])) == ()
    found = ast.literal_eval((tmp_path / "c.cameramodel").read_text())
    assert list(found) == ["lensmodel", "intrinsics", "extrinsics", "imagersize"]
    assert found["lensmodel"] == f"LENSMODEL_{model}" and found["imagersize"] == [1280, 960]
    assert found["extrinsics"] == [0.0] * 6
    fx, fy, cx, cy, *rest = found["intrinsics"]
    at = opencv(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(rest or [0.0] * 4), False)
    np.testing.assert_allclose(at, projected(GEOMETRIES[name]), rtol=0, atol=CLOSE_PX)


def splines_departure_px(remarks: tuple[str, ...]) -> float:
    """What the warning says; below the limit of what is told there is none."""
    return float(re.findall(r"leaves (\S+) px", remarks[0])[0]) if remarks else TOLD_PX


class LensModel(ctypes.Structure):
    """mrcal_lensmodel_t of mrcal 2.2."""

    _fields_ = (("type", ctypes.c_int), ("configuration", ctypes.c_double))


class CameraModelFile(ctypes.Structure):
    """mrcal_cameramodel_t of mrcal 2.2, with the place of its intrinsics."""

    _fields_ = (
        ("pose", ctypes.c_double * 6),
        ("size", ctypes.c_uint * 2),
        ("lens", LensModel),
        ("intrinsics", ctypes.c_double * 0),
    )


def test_mrcal_itself_agrees(tmp_path: Path) -> None:
    try:
        mrcal = ctypes.CDLL("libmrcal.so.2")
    except OSError:
        pytest.skip("libmrcal 2.2 isn't installed (the distribution's libmrcal2); its text is compared above")
    mrcal.mrcal_read_cameramodel_file.restype = ctypes.POINTER(CameraModelFile)
    for names in (("ideal", "k1 k2 p1 p2"), ("k3", "k6"), ("fisheye", "wide")):
        left, right = ((GEOMETRIES | {"wide": WIDE})[name] for name in names)
        remarks = write_mrcal(tmp_path / "p.cameramodel", *pair(left, right))
        assert len(remarks) == ("wide" in names)
        for side, geometry in (("left", left), ("right", right)):
            model = mrcal.mrcal_read_cameramodel_file(str(tmp_path / f"p-{side}.cameramodel").encode())
            assert model and tuple(model.contents.size) == (1280, 960)
            pose = np.array(model.contents.pose)
            turned = ROTATION if side == "right" else np.eye(3)
            moved = TRANSLATION_MM * 1e-3 if side == "right" else np.zeros(3)
            points = np.ascontiguousarray(POINTS @ cv2.Rodrigues(pose[:3])[0].T + pose[3:])
            found = np.empty((len(points), 2))
            done = mrcal.mrcal_project(
                found.ctypes.data_as(ctypes.c_void_p), None, None, points.ctypes.data_as(ctypes.c_void_p), len(points),
                ctypes.byref(model.contents.lens), ctypes.byref(model.contents.intrinsics),
            )  # fmt: skip
            assert done
            expected = projected(geometry, POINTS @ turned.T + moved)
            left_px = CLOSE_PX if geometry.projection == "pinhole" else 1.5 * splines_departure_px(remarks)
            np.testing.assert_allclose(found, expected, rtol=0, atol=left_px)


@pytest.mark.parametrize("name", ["fisheye", "wide fisheye", "splined"])
def test_a_fisheye_becomes_mrcals_splined_projection(tmp_path: Path, name: str) -> None:
    """By mrcal's formulas: the four weights of a uniform cubic B-spline in each direction."""
    geometry = {"fisheye": GEOMETRIES["fisheye"], "wide fisheye": WIDE, "splined": SPLINED}[name]
    remarks = write_mrcal(tmp_path / "c.cameramodel", camera(geometry))
    left_px = splines_departure_px(remarks)
    assert left_px < 0.01 and (name == "fisheye") == (not remarks)
    found = ast.literal_eval((tmp_path / "c.cameramodel").read_text())
    nx, ny, degrees = map(int, re.findall(r"=(\d+)", found["lensmodel"].partition("order=3")[2]))
    values = np.array(found["intrinsics"][4:]).reshape(ny, nx, 2)
    fx, fy, cx, cy = found["intrinsics"][:4]
    per_u = (nx - 3) / (4.0 * np.tan(np.deg2rad(degrees) / 4.0))

    def weights(t: float) -> FloatArray:
        return np.array([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]) / 6.0

    nearer = POINTS * (1.0, 1.0, 0.2 if name == "wide fisheye" else 1.0)  # out to 73 deg
    points, at = nearer[np.all(np.abs(projected(geometry, nearer) - (640, 480)) < (639, 479), axis=1)], []
    assert len(points) > 20
    for x, y, z in points:
        scale = 2.0 / (np.sqrt(x * x + y * y + z * z) + z)
        px, py = x * scale * per_u + 0.5 * (nx - 1), y * scale * per_u + 0.5 * (ny - 1)
        column, row = int(px), int(py)
        part = values[row - 1 : row + 3, column - 1 : column + 3]
        du, dv = np.einsum("i,ijk,j->k", weights(py - row), part, weights(px - column))
        at.append(((x * scale + du) * fx + cx, (y * scale + dv) * fy + cy))
    assert np.hypot(*(np.array(at) - projected(geometry, points)).T).max() < 1.5 * left_px


# --- all of them ------------------------------------------------------------------------------------------------------

WRITERS = {
    "opencv": (write_opencv, "c.yaml"),
    "ros": (write_ros, "c.yaml"),
    "kalibr": (write_kalibr, "c.yaml"),
    "colmap": (write_colmap, "cameras.txt"),
    "mrcal": (write_mrcal, "c.cameramodel"),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_what_no_geometry_holds_is_told(tmp_path: Path, kind: str) -> None:
    """5 % of half a diagonal of 800 px is 40 px."""
    write, name = WRITERS[kind]
    content = replace(
        camera(GEOMETRIES["k1 k2 p1 p2"]),
        effects=(Distortion(corner_percent=5.0), Vignetting(corner_loss_percent=20.0)),
    )
    assert write(tmp_path / name, content) == ("effects: left out (distortion: 40.00 px in the corners, vignetting)",)
    (remark,) = write(tmp_path / name, camera(None))
    assert remark.startswith("geometry: not set")
    bare = camera(None)
    lens = bare.camera.lens.model_copy(update={"focal_length_mm": None})
    with pytest.raises(InputError, match=r"neither geometry nor lens\.focal_length_mm"):
        write(tmp_path / name, replace(bare, camera=bare.camera.model_copy(update={"lens": lens})))


@pytest.mark.parametrize("kind", WRITERS)
def test_the_command_writes_a_camera_and_a_pair(tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str) -> None:
    def said(*words: object, code: int = 0) -> str:
        assert cli.main(["export", *(str(word) for word in words)]) == code
        return capsys.readouterr().err

    geometry, name = GEOMETRIES["k1 k2 p1 p2"], WRITERS[kind][1]
    left, both = pair(geometry, geometry)
    for side, content in (("left", left), ("right", both.right)):
        write_camera(tmp_path / f"{side}.toml", content)
    fit = FitResult(source="a set", cameras={}, stereo=rectified(both).stereo)
    write_result(fit, tmp_path / "fit.json")
    write_result(fit.model_copy(update={"stereo": None}), tmp_path / "alone.json")
    told = said(tmp_path / "left.toml", "--as", kind, "--to", tmp_path / name)
    assert told == "" and (tmp_path / name).exists()
    of_pair = ("--right", tmp_path / "right.toml", "--fit", tmp_path / "fit.json")
    (tmp_path / "pair").mkdir()
    told = said(tmp_path / "left.toml", "--as", kind, *of_pair, "--to", tmp_path / "pair" / name)
    assert ("pose: left out" in told) == (kind == "colmap")
    assert len(list((tmp_path / "pair").iterdir())) == (2 if kind in ("ros", "mrcal") else 1)
    for words, wrong in (
        (of_pair[:2], "needs both --right"),
        (of_pair[2:], "needs both --right"),
        ((*of_pair[:3], tmp_path / "alone.json"), "has no pose of a stereo pair"),
    ):
        assert wrong in said(tmp_path / "left.toml", "--as", kind, *words, "--to", tmp_path / "x.yaml", code=2)
    assert "is of one camera" in said(tmp_path / "left.toml", "--as", "icc", *of_pair, "--to", tmp_path / "x", code=2)
