"""Distortion and chromatic displacement: closed forms, OpenCV, and intervals over draws of the intrinsics."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from lab.errors import NotDetermined
from lab.formats.results import ChannelGeometry, GeometryFit
from lab.standards.iso17850 import Iso17850
from lab.standards.iso19084 import Iso19084

ROWS, COLS, FOCAL = 481, 641, 800.0
CAMERA = SimpleNamespace(rows=ROWS, cols=COLS)
SIDE = SimpleNamespace(side="left", camera=CAMERA)
MATRIX = ((FOCAL, 0.0, 320.0), (0.0, FOCAL, 240.0), (0.0, 0.0, 1.0))


def geometry(distortion: tuple[float, ...], covariance: np.ndarray | None = None) -> GeometryFit:
    return GeometryFit(
        camera_matrix=MATRIX,
        distortion=distortion,
        rms_px=0.1,
        views=10,
        parameters=() if covariance is None else ("fx", "fy", "cx", "cy", "k1", "k2"),
        covariance=None if covariance is None else tuple(map(tuple, covariance.tolist())),
    )


def test_no_distortion_is_none() -> None:
    found = Iso17850(SIDE, geometry((0.0,) * 5))
    for name in ("local_distortion_half", "local_distortion_edge", "largest_local_distortion"):
        assert getattr(found, name).value == pytest.approx(0.0, abs=1e-9)
    assert found.horizontal_line_distortion.value == pytest.approx(0.0, abs=1e-9)
    assert found.horizontal_line_distortion.std is None


def test_radial_term_is_the_local_distortion() -> None:
    """r' = r (1 + k1 r^2): the local distortion is k1 r^2 of the ideal radius r."""
    k1 = -0.1
    found = Iso17850(SIDE, geometry((k1, 0.0, 0.0, 0.0, 0.0)))
    recorded = 0.5 * np.hypot(320.0, 240.0) / FOCAL
    r = recorded
    for _ in range(50):
        r = recorded / (1.0 + k1 * r * r)
    # Newton's steps of the projection end 1e-9 of the radius from it
    assert found.local_distortion_half.value == pytest.approx(100.0 * k1 * r * r, rel=1e-6)


def test_barrel_bends_lines_outwards() -> None:
    """Lines of a barrel bulge: their middle is farther out than their ends; of a pincushion the other way."""
    for k1, sign in ((-0.1, 1.0), (0.1, -1.0)):
        found = Iso17850(SIDE, geometry((k1, 0.0, 0.0, 0.0, 0.0)))
        assert np.sign(found.horizontal_line_distortion.value) == sign
        assert np.sign(found.vertical_line_distortion.value) == sign


def test_agrees_with_opencv() -> None:
    """Recorded places of ideal points, as OpenCV projects them."""
    distortion = (-0.2, 0.05, 1e-3, -5e-4, 0.01)
    found = Iso17850(SIDE, geometry(distortion))
    plane = np.random.default_rng(0).uniform((-0.35, -0.25), (0.35, 0.25), (40, 2))
    points = np.column_stack([plane, np.ones(40)])
    recorded = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.array(MATRIX), np.array(distortion))[0][:, 0]
    expected = np.linalg.norm(recorded - [320.0, 240.0], axis=1) / np.linalg.norm(FOCAL * plane, axis=1) - 1.0
    # Newton's steps of the inverse end 1e-9 from it
    np.testing.assert_allclose(found.local(recorded, found.intrinsics), 100.0 * expected, atol=1e-5)


@pytest.mark.parametrize("name", ["local_distortion_edge", "horizontal_line_distortion"])
def test_intervals_hold(name: str) -> None:
    rng = np.random.default_rng(12)
    std = np.array([0.5, 0.5, 0.4, 0.4, 2e-3, 4e-3])
    factor = np.diag(std)
    factor[5, 4] = -3e-3
    covariance = factor @ factor.T
    exact = Iso17850(SIDE, geometry((-0.1, 0.02, 0.0, 0.0, 0.0), covariance))
    truth, held = getattr(exact, name).value, 0
    for _ in range(100):
        moved = factor @ rng.standard_normal(6)
        matrix = np.array(MATRIX)
        matrix[0, 0] += moved[0]
        matrix[1, 1] += moved[1]
        matrix[:2, 2] += moved[2:4]
        drawn = geometry((-0.1 + moved[4], 0.02 + moved[5], 0.0, 0.0, 0.0), covariance).model_copy(
            update={"camera_matrix": tuple(map(tuple, matrix.tolist()))}
        )
        one = getattr(Iso17850(SIDE, drawn), name)
        held += abs(one.value - truth) < 1.96 * one.std
    assert 90 <= held <= 99, held


def channel(shift: np.ndarray, centre: tuple[float, float] = (0.3, 0.4), std: float = 0.02) -> ChannelGeometry:
    return ChannelGeometry(
        channel="R",
        camera_matrix=MATRIX,
        distortion=(),
        centre_shift_px=centre,
        centre_shift_px_std=(std, std),
        radius_px=(100.0, 200.0, 400.0),
        radial_shift_px=tuple(shift.tolist()),
        radial_shift_px_std=(std, std, std),
        rms_px=0.1,
        corners=100,
    )


def test_chromatic_displacement() -> None:
    found = Iso19084(SIDE, channel(np.array([0.1, -0.2, -0.8]), std=1e-6))
    assert found.largest_radial_displacement.value == -0.8
    assert found.relative_radial_displacement.value == pytest.approx(-80.0 / (0.5 * np.hypot(ROWS, COLS)), rel=1e-12)
    assert found.centre_displacement.value == pytest.approx(0.5, rel=1e-9)


def test_intervals_of_the_centre_hold() -> None:
    rng, held = np.random.default_rng(13), 0
    for _ in range(100):
        centre = tuple((np.array([0.3, 0.4]) + 0.02 * rng.standard_normal(2)).tolist())
        one = Iso19084(SIDE, channel(np.array([0.1, 0.2, 0.8]), centre)).centre_displacement
        held += abs(one.value - 0.5) < 1.96 * (one.std or 0.0)
    assert 90 <= held <= 99, held


def test_camera_without_a_board_is_refused() -> None:
    from lab.standards import iso17850, iso19084

    without = SimpleNamespace(fit=SimpleNamespace(geometry=None))
    for read in (iso17850.read, iso19084.read):
        with pytest.raises(NotDetermined, match="capture"):
            list(read(without))
