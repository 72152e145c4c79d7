"""The named scenes: their placement before the camera, contrast, size and documentation."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sim import frame as sim_frame
from sim import uniform
from sim.camera import CameraModel, Geometry, Lens, StereoRig
from sim.frame import Exposure
from sim.scene import KnifeEdge, PlanarTarget, ReflectanceChart, ScreenPattern, SpectralImage
from sim.scene.catalogue import SCENES, Cube, PictureOnScreen, View, charuco_texture, scene_by_name
from sim.scene.light import luminance_cd_m2
from sim.scene.render import Grid, draw
from sim.spectrum import Spectrum

WHITE = Spectrum.of([400.0, 700.0], [0.01, 0.01])


@pytest.fixture
def camera(mono_camera: CameraModel) -> CameraModel:
    return mono_camera.model_copy(update={"rows": 60, "cols": 90})


def test_a_view_obeys_the_lens_equation() -> None:
    view = View(rows=480, cols=640, pixel_pitch_um=3.0, focal_length_mm=8.0, distance_mm=500.0)
    image_mm = 8.0 * (1 + view.magnification)
    assert 1 / 500.0 + 1 / image_mm == pytest.approx(1 / 8.0, rel=1e-14)
    assert view.magnification == pytest.approx(image_mm / 500.0, rel=1e-14)
    # The frame's width in the scene, by its angle at the lens and by the scale.
    assert 500.0 * 640 * 3e-3 / image_mm == pytest.approx(640 / view.px_per_mm, rel=1e-14)
    with pytest.raises(ValueError, match=r"distance 8\.0 mm is not above the limit of the focal length"):
        View(rows=480, cols=640, pixel_pitch_um=3.0, focal_length_mm=8.0, distance_mm=8.0)


def test_a_pattern_and_a_target_of_one_size_lie_on_each_other() -> None:
    view = View(rows=480, cols=640, pixel_pitch_um=3.0, focal_length_mm=8.0, distance_mm=500.0)
    flat = view.centre_pattern(6, 8, 31.0)
    target = PlanarTarget(
        np.zeros((6, 8)),
        31.0 / view.px_per_mm,
        ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        view.corner_mm(6, 8, 31.0),
        view.geometry,
        WHITE,
        WHITE,
    )
    u, v = np.meshgrid(np.arange(9.0), np.arange(7.0))
    np.testing.assert_allclose(target.warp().to_camera(u, v), flat.to_camera(u, v), atol=1e-9)
    # centred: as far from the upper left of the first pixel as from the lower right of the last
    row, col = flat.to_camera([0.0, 8.0], [0.0, 6.0])
    assert row[0] + 0.5 == pytest.approx(479.5 - row[1])
    assert col[0] + 0.5 == pytest.approx(639.5 - col[1])


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_makes_a_frame(camera: CameraModel, name: str) -> None:
    scene = scene_by_name(name, camera, WHITE)
    electrons = sim_frame.expected_electrons(camera, Exposure(scene, 0.01), oversample=2, margin_px=8)
    white = uniform.electron_rate(camera, "Y", WHITE) * 0.01 + sim_frame.dark_electrons(camera, Exposure(scene, 0.01))
    assert electrons.shape == (60, 90)
    # No more than white, but for what a sharp picture's transform overshoots by on 2 x 2 samples a pixel.
    assert electrons.min() >= 0
    assert electrons.max() < 1.02 * white
    if name != "uniform":
        assert electrons.std() > 0.002 * white
    declared = SCENES[name]
    assert declared.name == name
    assert set(declared.quantities()) == set(declared.model_fields)
    assert all(quantity.unit and quantity.meaning for quantity in declared.quantities().values())


def test_contrast_is_michelsons(camera: CameraModel) -> None:
    edge = scene_by_name("slanted-edge", camera, WHITE, parameters={"contrast": 0.6, "angle_deg": 95})
    assert isinstance(edge, KnifeEdge)
    assert edge.light_radiance == WHITE
    np.testing.assert_allclose(np.array(edge.dark_radiance.value) / WHITE.value, 0.25, rtol=1e-12)
    assert edge.regions[0].angle_deg == 95.0


def test_patterns_cover_the_frame_and_its_margin(camera: CameraModel) -> None:
    for name in ("checkerboard", "bernoulli"):
        scene = scene_by_name(name, camera, WHITE, parameters={"cell_px": "7"})
        assert isinstance(scene, ScreenPattern)
        u, v = scene.to_camera.to_pattern([-32.5, 60 + 31.5], [-32.5, 90 + 31.5])
        assert u.min() >= 0
        assert v.min() >= 0
        assert u.max() <= scene.pattern.shape[1]
        assert v.max() <= scene.pattern.shape[0]
    again = scene_by_name("bernoulli", camera, WHITE, parameters={"cell_px": "7"})
    other = scene_by_name("bernoulli", camera, WHITE, parameters={"cell_px": "7", "pattern_seed": 2})
    assert isinstance(again, ScreenPattern)
    assert isinstance(other, ScreenPattern)
    np.testing.assert_array_equal(again.pattern, scene.pattern)
    assert not np.array_equal(other.pattern, scene.pattern)


@pytest.mark.parametrize("name", ["colorchecker24", "colorchecker-sg"])
def test_a_chart_fills_its_share(camera: CameraModel, name: str) -> None:
    chart = scene_by_name(name, camera, WHITE, parameters={"fill": 0.8, "gap": 0.2})
    assert isinstance(chart, ReflectanceChart)
    corners = np.array(chart.corners)
    size = np.ptp(corners, axis=0)
    assert np.max(size / [60, 90]) == pytest.approx(0.8)
    np.testing.assert_allclose(corners.mean(axis=0), [29.5, 44.5])
    layers = draw(chart, Grid(60, 90, 2, 0)).layers
    rows, cols = {"colorchecker24": (4, 6), "colorchecker-sg": (10, 14)}[name]
    assert len(layers) == rows * cols
    patch = size[0] / (rows - 0.2) * 0.8
    for layer in layers:
        assert layer.coverage.sum() / 4 == pytest.approx(patch**2, rel=1e-9)


def test_what_is_not_a_scene_is_refused(camera: CameraModel) -> None:
    for name, parameters, says in (
        ("moon", {}, "name one of uniform, colorchecker24"),
        ("uniform", {"cell_px": 1}, "no parameter 'cell_px': it has none"),
        ("zone-plate", {"highest": 1}, "it has highest_cy_per_px, fill, contrast"),
        ("slanted-edge", {"contrast": 1.5}, "1.5 is above the upper limit 1.0"),
        ("slanted-edge", {"angle_deg": float("nan")}, "finite"),
    ):
        with pytest.raises(ValueError, match=says) as error:
            scene_by_name(name, camera, WHITE, parameters=parameters)
        assert "\n" not in str(error.value)


def test_a_picture_fits_the_frame_and_keeps_its_light(camera: CameraModel) -> None:
    view = View.of(camera, 400.0)
    codes = np.full((30, 30, 3), 255, np.uint8)
    shown = PictureOnScreen.choose({"fill": 0.5}).show(codes, view, WHITE)
    row, col = shown.warp().to_camera([0.0, 30.0], [0.0, 30.0])
    np.testing.assert_allclose(row, [14.5, 44.5], atol=1e-9)
    np.testing.assert_allclose(col, [29.5, 59.5], atol=1e-9)
    assert luminance_cd_m2(shown.screen.white_radiance) == pytest.approx(luminance_cd_m2(WHITE), rel=1e-9)


def test_a_cube_of_the_frames_shape_lies_sample_on_pixel(camera: CameraModel) -> None:
    view = View.of(camera, 400.0)
    cube = SpectralImage((500.0, 600.0), np.ones((60, 90, 2)))
    assert Cube().show(cube, view).to_camera is None
    half = Cube(fill=0.5).show(cube, view)
    np.testing.assert_allclose(half.warp().to_camera(45.0, 30.0), (29.5, 44.5), atol=1e-12)
    drawn = draw(half, Grid(60, 90, 2, 4))
    assert drawn.layers[0].coverage.sum() / 4 == pytest.approx(30 * 45, rel=1e-12)


# --- stereo
# ------------------------------------------------------------------------------------------------------------


def rotation_of(turn: tuple[float, float, float]) -> tuple[tuple[float, float, float], ...]:
    a, b, c = ((float(x), float(y), float(z)) for x, y, z in cv2.Rodrigues(np.array(turn))[0])
    return a, b, c


def test_both_cameras_of_a_rig_see_one_plane_where_it_stands(mono_camera: CameraModel) -> None:
    """Corners found in both frames triangulate to the board's corners at its pose: a board of 8 x 6 squares of 10 mm,
    200 mm away, before two cameras of 560 px and 60 mm apart that look 0.28 rad inwards, both lenses distorting.
    """
    lens = Lens(f_number=4.0, focal_length_mm=1.68)
    geometries = [
        Geometry(
            camera_matrix=((560.0, 0.0, 161.0), (0.0, 562.0, 118.0), (0.0, 0.0, 1.0)),
            distortion=(-0.12, 0.03, 0.0005, -0.0003),
        ),
        Geometry(
            camera_matrix=((564.0, 0.0, 157.0), (0.0, 563.0, 122.0), (0.0, 0.0, 1.0)),
            distortion=(-0.09, 0.01, -0.0002, 0.0004),
        ),
    ]
    left, right = (
        mono_camera.model_copy(update={"rows": 240, "cols": 320, "lens": lens, "geometry": geometry})
        for geometry in geometries
    )
    turn = np.array(rotation_of((0.0, 0.28, 0.0)))
    x, y, z = (-turn @ [58.0, 1.0, 8.0]).tolist()
    rig = StereoRig(left=left, right=right, rotation=rotation_of((0.0, 0.28, 0.0)), translation_mm=(x, y, z))
    texture = charuco_texture((6, 8))
    texel_mm = 10.0 / 56
    pose = rotation_of((0.25, -0.2, 0.1))
    board = PlanarTarget(texture, texel_mm, pose, (-36.0, -30.0, 200.0), geometries[0], WHITE.scale(0.05), WHITE, 1.0)
    views = board.pose_for_rig(rig)

    detector = cv2.aruco.CharucoDetector(
        cv2.aruco.CharucoBoard((8, 6), 1.0, 0.75, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_1000))
    )
    found = []
    for camera, view in zip((left, right), views, strict=True):
        frame = sim_frame.predict_frame(camera, Exposure(view, 0.002), oversample=2, margin_px=8)
        grey = np.clip((frame - frame.min()) / np.ptp(frame) * 255, 0, 255).astype(np.uint8)
        corners, ids, _, _ = detector.detectBoard(grey)
        refined = cv2.cornerSubPix(
            grey, corners, (3, 3), (-1, -1), (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
        )
        geometry = view.geometry
        straight = cv2.undistortPoints(refined, np.array(geometry.camera_matrix), np.array(geometry.distortion))
        found.append(dict(zip(ids.ravel().tolist(), straight[:, 0].astype(float), strict=True)))
    shared = sorted(set(found[0]) & set(found[1]))
    assert len(shared) >= 30
    rays = [np.array([side[i] for i in shared]).T for side in found]
    projections = [np.eye(3, 4), np.column_stack([rig.rotation, rig.translation_mm])]
    points = cv2.triangulatePoints(*projections, *rays)
    points = (points[:3] / points[3]).T
    # Inner corner i of the board is (i % 7 + 1, i // 7 + 1) squares from its own.
    squares = np.array([(i % 7 + 1, i // 7 + 1, 0) for i in shared]) * 10.0
    wanted = squares @ np.array(pose).T + [-36.0, -30.0, 200.0]
    # cornerSubPix is good to 0.06 px on 8-bit greys of corners this small (a marker's begins 5 px away):
    # 200 / 560 x 0.06 = 0.0214 mm across, and 200^2 / (560 x 58.6) x sqrt(2) x 0.06 = 0.103 mm along the axis.
    away = points - wanted
    spread = np.array([0.0214, 0.0214, 0.103])
    assert np.all(np.sqrt(np.mean(away**2, axis=0)) < spread)
    assert np.all(np.abs(away.mean(axis=0)) < 3 * spread / np.sqrt(len(shared)))


def test_a_rig_without_geometry_is_refused(mono_camera: CameraModel) -> None:
    pose = rotation_of((0.0, 0.0, 0.0))
    target = PlanarTarget(
        np.zeros((2, 2)), 1.0, pose, (0.0, 0.0, 100.0), View.of(mono_camera, 100.0).geometry, WHITE, WHITE
    )
    rig = StereoRig(left=mono_camera, right=mono_camera, rotation=pose, translation_mm=(-60.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="left camera has no geometry"):
        target.pose_for_rig(rig)


def test_the_documentation_lists_every_scene_and_parameter() -> None:
    text = (Path(__file__).parents[3] / "docs" / "reference" / "scene-parameters.md").read_text(encoding="utf-8")
    for item in (*SCENES.values(), PictureOnScreen, Cube):
        section = text.split(f"**`{item.name}`**: {item.shows}.")[1].split("**`")[0]
        for field, quantity in item.quantities().items():
            assert f"| `{field}` | {quantity.unit} | {item.model_fields[field].default:g} |" in section
            assert section.count(f"`{field}`") == 1
