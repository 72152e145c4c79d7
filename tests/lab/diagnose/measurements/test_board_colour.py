"""Lateral colour between pictures of one pose, each in light of one wavelength."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.special import erf

from lab.diagnose.inference.decide import decide
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.measurements.boards import board_colour_block
from lab.diagnose.policy import DecisionPolicy
from lab.errors import NotDetermined
from lab.formats.importers import read_dot_grids
from lab.measure.study import Study
from tests.lab.diagnose import on_blocks

ROWS, COLS, SPACING_PX, RADIUS_PX = 7, 9, 44.0, 9.0
SHAPE = (360, 480)
WAVELENGTHS_NM = (450, 550, 650)


def study_of(folder: Path, percent: float, *, one_pose: bool = True) -> Study:
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
    return on_blocks.study(read_dot_grids(folder, (ROWS, COLS), 10.0))


@pytest.mark.parametrize("percent", [0.0, 0.38])
def test_scales_of_wavelengths_are_compared_within_a_pose(tmp_path: Path, percent: float) -> None:
    """A ring has the floor of 0.012 px, its dots, and that displacements grow within it; 3.5 standard deviations of the
    widest ring."""
    study = study_of(tmp_path, percent)
    block = board_colour_block(study)
    assert {label.condition for label in block.labels} == {
        "light of 450 nm against 550 nm",
        "light of 650 nm against 550 nm",
    }
    sign = np.array([-1.0 if "450" in label.condition else 1.0 for label in block.labels])
    truth = 0.01 * percent * sign * block.position * study.camera.half_diagonal_px
    std = np.sqrt(np.diag(block.covariance))
    assert np.all(std < 0.025)
    np.testing.assert_allclose(block.value, truth, atol=3.5 * std.max())
    found = decide(MeasurementModel((block,), study.camera), np.random.default_rng(3), DecisionPolicy())
    if not percent:
        assert not found.named
        assert not found.before
        return
    assert [c.effect.name for c in found.named] == ["lateral_chromatic_aberration"]
    effect, of = found.named[0].effect, found.named[0].std["slope_um"]
    assert of is not None
    slope_um = 0.01 * percent * study.camera.half_diagonal_um
    assert abs(effect.slope_um - slope_um) < 3 * of  # type: ignore[attr-defined]


def test_pictures_of_other_poses_are_not_compared(tmp_path: Path) -> None:
    with pytest.raises(NotDetermined, match="light of 3 wavelengths, but no pose in two of them"):
        board_colour_block(study_of(tmp_path, 0.38, one_pose=False))
