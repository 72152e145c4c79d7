"""Boards that aren't flat in a way that no warp follows: the geometry fit's own error is a mismatch, and noise
isn't."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from lab.diagnose import diagnose, examine
from lab.diagnose.outcome.mismatches import board_departure
from lab.diagnose.policy import DecisionPolicy
from lab.fit.geometry import fit_geometry, geometry_result
from lab.formats.importers import read_checkerboard_pairs
from lab.formats.results import CameraFit, FitResult, GeometryFit, Unexplained
from lab.observables.boards.calibration import calibrate_robustly
from tests.lab.diagnose.on_blocks import former
from tests.lab.fit.projected import SHAPE, TRUTH, poses, seen

PAIRS = Path(__file__).parents[4].parent / "shared" / "data" / "opencv_stereo"
NOISE_PX = 0.09


@cache
def fitted(bows_mm: tuple[float, ...], *, noise_is_known: bool = False, draw: int = 1) -> GeometryFit:
    """Ten views of a board that bows by `bows_mm` along its columns in each."""
    rng = np.random.default_rng(draw)
    warps = [(bow, 0.0, 0.0) for bow in bows_mm]
    views = seen(rng, poses(10), TRUTH, NOISE_PX, warps_mm=warps)
    if noise_is_known:
        views = [replace(view, std_px=np.full(len(view.index), NOISE_PX)) for view in views]
    return geometry_result(calibrate_robustly(views, SHAPE))


def departure(fit: GeometryFit) -> Unexplained | None:
    return board_departure("left", fit, SHAPE, DecisionPolicy())


@pytest.mark.parametrize("noise_is_known", [False, True])
def test_a_board_that_bows_anew_in_each_pose_is_told(noise_is_known: bool) -> None:
    """A sheet of 300 mm that bows by 1.5 mm to the one side and to the other: 0.34 px of 0.09 px noise. The warp of the
    fit is one for all poses, so that it can't follow. 1650 free numbers know 0.09 px to 0.09 / sqrt(2 x 1650) = 0.0016
    px; the parts of the fit's residuals are told apart to some 3 %.
    """
    fit = fitted(tuple(1.5 * (-1) ** k for k in range(10)), noise_is_known=noise_is_known)
    found = departure(fit)
    assert found is not None
    assert found.measurement == "boards"
    assert f"depart from the camera's geometry by {fit.corner_px_std:.2f} px" in found.shape
    assert "noise explains 0.09 px; a bent board" in found.shape
    # the most tilted boards show a bow the most
    largest = re.search(r"of 10 captures: left-2 \((0\.\d+) px\), ", found.where)
    # 0.54 px about a distortion of one term; of five terms, which held-out views don't refuse, the fit takes up 0.06 px
    assert largest is not None and 0.45 < float(largest[1]) < 0.57
    assert "in the frame at the " in found.where
    assert set(found.captures) < {view.capture for view in fit.residuals}
    assert found.significance_sigma > 50
    assert found.chi2_before > 10 * found.n


def test_only_the_poses_that_bow_are_told() -> None:
    """0.8 mm: 0.2 px in all, so that noise and the tolerance hold for the whole, and 0.28 px in the most tilted
    pose."""
    found = departure(fitted(tuple(0.8 * (-1) ** k for k in range(10))))
    assert found is not None
    assert found.captures == ("left-0", "left-2", "left-7")
    assert found.where.startswith("3 of 10 captures: left-2 (0.28 px), ")


@pytest.mark.parametrize("noise_is_known", [False, True])
@pytest.mark.parametrize("bow_mm", [0.0, 1.5])
def test_a_flat_board_and_one_that_keeps_its_bow_are_no_finding(bow_mm: float, noise_is_known: bool) -> None:
    """A bow that stays is the board's warp, which the fit takes up."""
    assert departure(fitted((bow_mm,) * 10, noise_is_known=noise_is_known)) is None


def test_noise_of_a_pixel_is_no_finding_where_the_pictures_have_it() -> None:
    views = [
        replace(v, std_px=np.full(len(v.index), 0.8)) for v in seen(np.random.default_rng(2), poses(10), TRUTH, 0.8)
    ]
    fit = geometry_result(calibrate_robustly(views, SHAPE))
    assert departure(fit) is None
    sharp = tuple(view.model_copy(update={"noise_px": 0.09}) for view in fit.residuals)
    found = departure(fit.model_copy(update={"residuals": sharp}))
    assert found is not None
    assert "noise explains 0.09 px" in found.shape


def test_a_fit_without_residuals_says_nothing() -> None:
    assert board_departure("left", None, SHAPE, DecisionPolicy()) is None
    assert departure(fitted((0.0,) * 10).model_copy(update={"residuals": ()})) is None


def test_the_verdict_is_unexplained() -> None:
    recordings = former(5, kinds=("dark",))
    bent = fitted(tuple(1.5 * (-1) ** k for k in range(10)))
    verdicts = []
    for geometry in (fitted((0.0,) * 10), bent):
        result = diagnose(recordings, FitResult(source="x", cameras={"left": CameraFit(geometry=geometry)}))
        verdicts.append(result.verdict)
    assert verdicts == ["no_mismatch", "unexplained"]
    assert [one.measurement for one in result.mismatches] == ["boards"]
    assert any("of 10 captures: left-2" in line and "a bent board" in line for line in result.summary)


@pytest.mark.skipif(not PAIRS.is_dir(), reason="the public stereo pairs aren't here")
def test_public_boards_are_no_finding() -> None:
    """They leave 0.11 px, where their pictures' noise explains 0.02 px: more than noise, and what such boards leave."""
    recordings = read_checkerboard_pairs(PAIRS, (6, 9), 25.0)
    fits = {side: fit_geometry(recordings, side) for side in recordings.sides}
    result = examine(
        recordings,
        FitResult(source="x", cameras={side: CameraFit(geometry=fit) for side, fit in fits.items()}),
        at_once=False,
    ).result
    assert result.verdict == "no_mismatch"
    for side, fit in fits.items():
        assert fit.corner_px_std > 4 * fit.residuals[0].noise_px
        assert board_departure(side, fit, (480, 640), DecisionPolicy()) is None
        strict = board_departure(side, fit, (480, 640), DecisionPolicy(corner_tolerance_px=0.05))
        assert strict is not None
        assert "by 0.11 px (standard deviation of a coordinate), noise explains 0.02 px" in strict.shape
