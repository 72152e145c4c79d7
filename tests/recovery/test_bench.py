"""The main job from end to end on the mock bench, over its wires, against the truth that the bench conceals."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mocks.truth import hidden_truth
from sim.detection import responsivity

pytestmark = pytest.mark.extra  # a whole session of the mock bench

TRUTH = hidden_truth(1)  # the seed of a bench that is told none
SIDES = ("left", "right")


def _result(folder: Path, kind: str) -> dict[str, Any]:
    return json.loads((folder / f"{kind}.json").read_text())


@pytest.mark.timeout(900)
def test_the_main_job_recovers_what_the_bench_conceals(tmp_path: Path, subtests: pytest.Subtests) -> None:
    command = [sys.executable, "-m", "calibench", "run", "--quick", "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=850, check=False)
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "sessions").iterdir()
    for side in SIDES:
        with subtests.test("noise", side=side):
            noise_is_recovered(folder, side)
        for channel in "RGB":
            with subtests.test("quantum efficiency", side=side, channel=channel):
                quantum_efficiency_is_recovered(folder, side, channel)
    for check in (
        baseline_is_recovered,
        the_left_cameras_two_filters_are_named_and_nothing_else,
        the_right_camera_is_predicted_and_the_left_ones_edges_are_not,
        the_report_is_one_page_that_needs_nothing_else,
    ):
        with subtests.test(check.__name__):
            check(folder)


def noise_is_recovered(folder: Path, side: str) -> None:
    """Wanted: gain within 1 %, read noise within 3 %."""
    noise = _result(folder, "fit")["cameras"][side]["noise"]
    truth = TRUTH.cameras[side].model
    assert noise["conversion_gain_dn_per_e"] == pytest.approx(truth.conversion_gain_dn_per_e, rel=0.01)
    assert noise["read_noise_e"] == pytest.approx(truth.read_noise_e, rel=0.03)
    assert noise["full_well_e"] == pytest.approx(truth.full_well_e, rel=0.02)
    assert abs(noise["black_level_dn"] - truth.black_level_dn) < 0.05


def quantum_efficiency_is_recovered(folder: Path, side: str, channel: str) -> None:
    """Wanted: within 2 % rms of the peak. The sweep of the left camera includes its concealed filter."""
    spectral = _result(folder, "fit")["cameras"][side]["spectral"]
    body = TRUTH.cameras[side]
    wavelength_nm = np.array(spectral["wavelength_nm"])
    truth = responsivity(body.model, channel, wavelength_nm, body.effects) / body.model.lens.transmittance
    error = (np.array(spectral["quantum_efficiency"][channel]) - truth) / truth.max()
    assert np.sqrt(np.mean(error**2)) < 0.02


def baseline_is_recovered(folder: Path) -> None:
    """Wanted: within 0.5 %."""
    _, translation = TRUTH.stereo()
    assert _result(folder, "fit")["stereo"]["baseline_mm"] == pytest.approx(np.linalg.norm(translation), rel=0.005)


def the_left_cameras_two_filters_are_named_and_nothing_else(folder: Path) -> None:
    """Wanted: displacement within 5 %, cut within 3 nm. Beside the filters, only what both sensors have: columns hold a
    fiftieth of the DSNU's variance (see `mocks.truth`)."""
    found = _result(folder, "diagnose")
    named = {effect["name"]: effect for effect in found["effects"]}
    assert set(named) - {"column_noise"} == {"optical_low_pass_filter", "infrared_cut_filter"}
    assert all(effect["sides"] == ["left"] for name, effect in named.items() if name != "column_noise")
    if "column_noise" in named:
        columns = named["column_noise"]["parameters"]["offset_e"]
        drawn_e = np.sqrt(0.02) * TRUTH.cameras["left"].model.dsnu_e
        # some hundred columns were drawn: their standard deviation is known to 1 / sqrt(2 x 320) = 4 %
        assert columns["value"] == pytest.approx(drawn_e, abs=3.0 * np.hypot(columns["std"], 0.04 * drawn_e))
    assert found["verdict"] == "explained"
    truth = {effect.name: effect for effect in TRUTH.cameras["left"].effects}
    split, cut = truth["optical_low_pass_filter"], truth["infrared_cut_filter"]
    for axis in ("displacement_x_um", "displacement_y_um"):
        value = named["optical_low_pass_filter"]["parameters"][axis]["value"]
        assert value == pytest.approx(getattr(split, axis), rel=0.05)
    assert named["infrared_cut_filter"]["parameters"]["cut_wavelength_nm"]["value"] == pytest.approx(
        cut.cut_wavelength_nm, abs=3.0
    )
    held_out = found["held_out"]
    assert held_out["chi2_after"] < 0.05 * held_out["chi2_before"]
    assert held_out["chi2_after"] < 1.3 * held_out["n"]


def the_right_camera_is_predicted_and_the_left_ones_edges_are_not(folder: Path) -> None:
    checks = _result(folder, "validate")["checks"]
    passed = {(c["side"], c["name"]): True for c in checks}
    for check in checks:
        passed[check["side"], check["name"]] &= check["passed"]
    assert passed["right", "colorchecker"] and passed["right", "mtf"] and passed["right", "psf"]
    assert passed["left", "colorchecker"] and not passed["left", "mtf"]


def the_report_is_one_page_that_needs_nothing_else(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    assert "optical_low_pass_filter" in page or "anti-alias" in page
    assert 'src="http' not in page and "@import" not in page
