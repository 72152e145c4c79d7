"""Grids of dots: centres to their stated uncertainty, and a camera's geometry from pictures of one in several poses."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.special import erf

from lab.errors import InputError, NotDetermined
from lab.fit.geometry import fit_geometry
from lab.foreign_recordings import read_foreign
from lab.formats import recording_set as recording
from lab.formats.importers import ImportOptions, read_dot_grids
from lab.observables.boards.dots import dot_centres, dot_grid

ROWS, COLS, SPACING_MM, RADIUS_MM = 7, 9, 10.0, 2.5
SHAPE = (360, 480)
FOCAL_PX, K1 = 600.0, -0.12
MATRIX = np.array([[FOCAL_PX, 0.0, 239.5], [0.0, FOCAL_PX, 179.5], [0.0, 0.0, 1.0]])
DISTORTION = np.array([K1, 0.0, 0.0, 0.0, 0.0])
BLUR_PX, NOISE = 0.8, 0.01


def _board() -> np.ndarray:
    row, col = np.indices((ROWS, COLS))
    return np.column_stack([(col.ravel() + 1) * SPACING_MM, (row.ravel() + 1) * SPACING_MM, np.zeros(ROWS * COLS)])


def _picture(
    rotation: np.ndarray, shift: np.ndarray, rng: np.random.Generator, distortion: np.ndarray = DISTORTION
) -> tuple[np.ndarray, np.ndarray]:
    """A picture, 0..1, of dark dots, and the true images of their centres (n, 2). Each dot's border is blurred by an
    error function of the distance in the board's plane, over the local scale."""
    centres = cv2.projectPoints(_board(), rotation, shift, MATRIX, distortion)[0][:, 0]
    picture = np.full(SHAPE, 0.9)
    turn = cv2.Rodrigues(rotation)[0]
    for k, (x0, y0) in enumerate(centres):
        size = 24
        x, y = np.meshgrid(
            np.arange(round(x0) - size, round(x0) + size + 1), np.arange(round(y0) - size, round(y0) + size + 1)
        )
        ray = cv2.undistortPoints(np.column_stack([x.ravel(), y.ravel()]).astype(float)[:, None], MATRIX, distortion)[
            :, 0
        ]
        ray = np.column_stack([ray, np.ones(len(ray))])
        depth = float(turn[:, 2] @ shift) / (ray @ turn[:, 2])
        board = (depth[:, None] * ray - shift) @ turn
        away_mm = np.hypot(*(board[:, :2] - _board()[k, :2]).T)
        scale = FOCAL_PX / float((turn @ _board()[k] + shift)[2])
        share = 0.5 * (1.0 - erf((away_mm - RADIUS_MM) * scale / np.sqrt(2.0) / BLUR_PX))
        inside = (x >= 0) & (x < SHAPE[1]) & (y >= 0) & (y < SHAPE[0])
        picture[y[inside], x[inside]] -= 0.8 * share.reshape(x.shape)[inside]
    return picture + NOISE * rng.standard_normal(SHAPE), centres


POSES = [
    (np.array([0.0, 0.0, 0.0]), np.array([-50.0, -40.0, 170.0])),
    (np.array([0.35, 0.0, 0.05]), np.array([-50.0, -42.0, 175.0])),
    (np.array([-0.3, 0.25, 0.0]), np.array([-46.0, -36.0, 180.0])),
    (np.array([0.1, -0.4, -0.1]), np.array([-54.0, -36.0, 180.0])),
    (np.array([0.25, 0.3, 0.15]), np.array([-42.0, -46.0, 185.0])),
]


def test_centres_scatter_as_stated() -> None:
    """Facing the grid through a lens without distortion, so that nothing moves a centroid. 63 dots in 8 pictures: the
    mean square of pulls is 1 within 3 sqrt(2 / 1008) = 0.13 for normal errors; the pixels at a dot's rim and the
    threshold take it to 0.6 .. 1.6."""
    rng = np.random.default_rng(11)
    pulls = []
    for k in range(8):
        picture, truth = _picture(np.zeros(3), np.array([-50.0 + 0.11 * k, -40.0 + 0.07 * k, 170.0]), rng, np.zeros(5))
        grid = dot_grid(np.rint(255 * picture.clip(0, 1)).astype(np.uint8), ROWS, COLS)
        grid = grid[:, ::-1] if grid[0, 0, 0] > grid[0, -1, 0] else grid
        grid = grid[::-1] if grid[0, 0, 1] > grid[-1, 0, 1] else grid
        found = dot_centres(picture, grid.reshape(-1, 2), ROWS, COLS)
        assert found.trusted.all()
        assert np.all(found.std_px < 0.01)
        pulls.append((found.points - truth) / found.std_px[:, None])
    assert 0.6 < float(np.mean(np.square(pulls))) < 1.6


def _folder(path: Path) -> Path:
    rng = np.random.default_rng(5)
    path.mkdir()
    for k, (rotation, shift) in enumerate(POSES):
        picture, _ = _picture(rotation, shift, rng)
        assert cv2.imwrite(str(path / f"pose{k}.png"), np.rint(4000 * picture).clip(0, 4095).astype(np.uint16))
    (path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 12\n')
    return path


def test_a_cameras_geometry_comes_from_its_dots(tmp_path: Path) -> None:
    """Centroids of ellipses are off by f (a / z)^2 / 2 x sin 2 tilt, 0.05 px at most here: 3e-3 of the focal length,
    beside the stated uncertainty."""
    read = read_dot_grids(_folder(tmp_path / "in"), (ROWS, COLS), SPACING_MM)
    recordings = recording.read(recording.write(read, tmp_path / "out"))
    assert [c.pose for c in recordings.captures("charuco")] == [f"p{k:03d}" for k in range(5)]
    geometry = fit_geometry(recordings, "left")
    focal = geometry.camera_matrix[0][0]
    assert focal == pytest.approx(FOCAL_PX, rel=5e-3)
    assert geometry.distortion[0] == pytest.approx(K1, abs=0.02)


def test_dots_that_are_not_there_are_told(tmp_path: Path) -> None:
    with pytest.raises(NotDetermined, match="no grid of 7 x 9 dots found"):
        dot_grid(np.full(SHAPE, 120, np.uint8), ROWS, COLS)
    with pytest.raises(InputError, match="no images"):
        read_dot_grids(tmp_path, (ROWS, COLS), SPACING_MM)
    with pytest.raises(InputError, match="is empty; give the folder of the recordings"):
        read_foreign("dot-grid", tmp_path, ImportOptions(dots=(ROWS, COLS), square_mm=SPACING_MM))
    (tmp_path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 12\n')
    with pytest.raises(InputError, match="state --dots ROWSxCOLS and --square-mm"):
        read_foreign("dot-grid", tmp_path, ImportOptions(dots=(ROWS, COLS)))
    with pytest.raises(InputError, match=r"--from fits doesn't take --dots; it takes --ignore, --only, --tap"):
        read_foreign("fits", tmp_path, ImportOptions(dots=(ROWS, COLS)))
