"""Corners of boards, and the lateral colour of boards."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.special import erf

from evaluation.draw import recordings_of, recordings_of_pair
from evaluation.independent_simulator import ConcealedCamera, Law, Plan
from evaluation.independent_simulator import laws as concealed
from lab.diagnose.inference.decide import Verdict, decide
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.policy import DecisionPolicy
from lab.errors import NotDetermined
from lab.formats.camera_model import camera_model
from lab.formats.importers import read_dot_grids
from lab.formats.recording_set import RecordingSet
from lab.observables.boards.calibration import calibration_of
from lab.observables.boards.lateral_colour import measure_board_colour
from lab.observables.boards.pair_gain import measure_stereo_gain
from lab.observables.boards.pair_time import measure_stereo_time
from lab.observables.boards.residuals import measure_boards
from lab.observables.dataset import Dataset
from sim.camera import Geometry, Side
from tests.lab.diagnose import on_blocks

PLAN = Plan(kinds=("dark", "charuco"))


def recorded(*laws: Law, noise_draw: int = 0) -> RecordingSet:
    return recordings_of(ConcealedCamera(41, laws, cfa="RGGB", rows=192, cols=256, noise_draw=noise_draw), PLAN)


def dataset_of(recordings: RecordingSet, side: Side = "left") -> Dataset:
    return Dataset(recordings, side, camera_model(recordings, side, None, maker_curves=True))


def judged(dataset: Dataset, known: Geometry | None) -> Verdict:
    """The boards are found once in a dataset."""
    dataset.camera = dataset.camera.model_copy(update={"geometry": known})
    return decide(
        MeasurementModel((measure_boards(dataset),), dataset.camera), np.random.default_rng(3), DecisionPolicy()
    )


@cache
def calibrated() -> Geometry:
    found = calibration_of(recorded(), "left").camera
    a, b, c = (tuple(float(v) for v in row) for row in found.matrix)
    return Geometry(camera_matrix=(a, b, c), distortion=tuple(float(v) for v in found.distortion))  # type: ignore[arg-type]


def test_distortion_is_named_beside_an_earlier_calibration_and_never_by_itself() -> None:
    """2 % of the corner's distance is 3 px there, half a pixel where the boards are; a cell's mean has a standard
    deviation of 0.006 px."""
    bent = dataset_of(recorded(concealed.LensDistortionLaw(2.0, 0, 7), noise_draw=1))
    alone = judged(bent, None)
    assert not alone.named
    assert not alone.before
    known = judged(bent, calibrated())
    assert [c.effect.name for c in known.named] == ["distortion"]


@pytest.mark.slow
def test_the_same_lens_is_no_finding_and_one_that_slipped_is_decentred() -> None:
    known = calibrated()
    assert not judged(dataset_of(recorded(noise_draw=1)), known).named
    slipped = judged(dataset_of(recorded(concealed.LensDecentreLaw(12.0, 0, 7), noise_draw=1)), known)
    assert [c.effect.name for c in slipped.named] == ["decentre"]


@pytest.mark.slow
@pytest.mark.parametrize(("gain", "glare"), [(0.0, 0.0), (0.0, 3.0), (8.0, 0.0), (8.0, 3.0)])
def test_a_gain_that_only_scenes_show_is_named(gain: float, glare: float) -> None:
    """`glare` (%) brightens the left camera's boards; the dark squares of its screens show it too."""
    plan = Plan(kinds=("dark", "flat", "charuco", "screen"))
    laws = [concealed.StereoGainLaw(gain, 0, 7)] if gain else []
    veil = [concealed.VeilingGlareLaw(glare, 0, 7)] if glare else []
    left = ConcealedCamera(51, veil, cfa="RGGB", rows=192, cols=256, pair_middle_mm=5.0)
    right = ConcealedCamera(52, laws, cfa="RGGB", rows=192, cols=256, side="right", offset_mm=10.0, pair_middle_mm=5.0)
    dataset = dataset_of(recordings_of_pair(left, right, plan), "right")
    verdict = decide(
        MeasurementModel((measure_stereo_gain(dataset),), dataset.camera), np.random.default_rng(3), DecisionPolicy()
    )
    assert [c.effect.name for c in verdict.named] == (["stereo_gain_mismatch"] if gain else [])
    if gain:
        found = verdict.named[0]
        std = found.std["gain_percent"]
        assert std is not None
        assert abs(found.effect.gain_percent - laws[0].signed_strength) < 3 * std  # type: ignore[attr-defined]
    with pytest.raises(NotDetermined, match="less than 1 s apart"):
        measure_stereo_time(dataset)


def test_one_camera_has_no_pair_to_judge() -> None:
    dataset = dataset_of(recordings_of(ConcealedCamera(41, cfa="MONO", rows=32, cols=40), Plan(kinds=("dark", "flat"))))
    for make in (measure_stereo_gain, measure_stereo_time):
        with pytest.raises(NotDetermined, match="pair of cameras"):
            make(dataset)
    with pytest.raises(NotDetermined, match="no charuco captures"):
        measure_boards(dataset)


# --- Lateral colour between pictures of one pose, each in light of one wavelength -------------------------------------


ROWS, COLS, SPACING_PX, RADIUS_PX = 7, 9, 44.0, 9.0
SHAPE = (360, 480)
WAVELENGTHS_NM = (450, 550, 650)


def study_of_colours(folder: Path, percent: float, *, one_pose: bool = True) -> Dataset:
    """A mono camera's pictures of dots, which are imaged larger by `percent` a 100 nm beyond 550 nm."""
    rng = np.random.default_rng(3)
    row, col = np.indices(SHAPE)
    middle = 0.5 * (np.array(SHAPE) - 1.0)
    lines = ["frame,wavelength_nm,pose"]
    for wavelength_nm in WAVELENGTHS_NM:
        scale = 1.0 + 0.01 * percent * (wavelength_nm - 550) / 100
        picture = np.full(SHAPE, 0.9)
        for i, k in np.ndindex(ROWS, COLS):
            y = middle[0] + scale * SPACING_PX * (i - 0.5 * (ROWS - 1))
            x = middle[1] + scale * SPACING_PX * (k - 0.5 * (COLS - 1))
            picture -= 0.4 * (1.0 - erf((np.hypot(row - y, col - x) - RADIUS_PX) / np.sqrt(2.0) / 0.8))
        picture += 0.01 * rng.standard_normal(SHAPE)
        name = f"{wavelength_nm}.png"
        assert cv2.imwrite(str(folder / name), np.rint(4000 * picture).clip(0, 4095).astype(np.uint16))
        lines.append(f"{name},{wavelength_nm},{'one' if one_pose else name}")
    (folder / "index.csv").write_text("\n".join(lines) + "\n")
    (folder / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 12\n')
    return on_blocks.dataset(read_dot_grids(folder, (ROWS, COLS), 10.0))


@pytest.mark.parametrize("percent", [0.0, 0.38])
def test_scales_of_wavelengths_are_compared_within_a_pose(tmp_path: Path, percent: float) -> None:
    """A ring has the floor of 0.012 px, its dots, and that displacements grow within it; 3.5 standard deviations of the
    widest ring."""
    dataset = study_of_colours(tmp_path, percent)
    block = measure_board_colour(dataset)
    assert {label.condition for label in block.labels} == {
        "light of 450 nm against 550 nm",
        "light of 650 nm against 550 nm",
    }
    sign = np.array([-1.0 if "450" in label.condition else 1.0 for label in block.labels])
    truth = 0.01 * percent * sign * block.position * dataset.camera.half_diagonal_px
    std = np.sqrt(np.diag(block.covariance))
    assert np.all(std < 0.025)
    np.testing.assert_allclose(block.value, truth, atol=3.5 * std.max())
    found = decide(MeasurementModel((block,), dataset.camera), np.random.default_rng(3), DecisionPolicy())
    if not percent:
        assert not found.named
        assert not found.before
        return
    assert [c.effect.name for c in found.named] == ["lateral_chromatic_aberration"]
    effect, of = found.named[0].effect, found.named[0].std["slope_um"]
    assert of is not None
    slope_um = 0.01 * percent * dataset.camera.half_diagonal_um
    assert abs(effect.slope_um - slope_um) < 3 * of  # type: ignore[attr-defined]


def test_pictures_of_other_poses_are_not_compared(tmp_path: Path) -> None:
    with pytest.raises(NotDetermined, match="light of 3 wavelengths, but no pose in two of them"):
        measure_board_colour(study_of_colours(tmp_path, 0.38, one_pose=False))
