"""`calibench run --standards` from end to end on the mock bench, against the truth that the bench conceals."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from lab.formats.results import CameraFit, GeometryFit
from lab.standards.iso17850 import Iso17850
from lab.standards.reading import STANDARDS
from mocks.truth import hidden_truth

pytestmark = pytest.mark.extra  # a whole session of the mock bench

TRUTH = hidden_truth(1)  # the seed of a bench that is told none
SIDES = ("left", "right")


@pytest.mark.timeout(600)
def test_one_session_gives_every_standard(tmp_path: Path, subtests: pytest.Subtests) -> None:
    command = [sys.executable, "-m", "calibench", "run", "--standards", "--quick", "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=550, check=False)
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "sessions").iterdir()
    result = json.loads((folder / "standards" / "standards.json").read_text())
    for side in SIDES:
        with subtests.test("all standards", side=side):
            assert {one["standard"] for one in result["readings"] if one["side"] == side} == set(STANDARDS)
        with subtests.test("known truth", side=side):
            truths_are_recovered(result, side)
        with subtests.test("deviations", side=side):
            lens_on_the_camera_is_told(result, side)
    assert len(list((folder / "standards").glob("*.html"))) == 1 + len(STANDARDS)


def figures(result: dict[str, Any], side: str, standard: str) -> dict[str, list[dict[str, Any]]]:
    """Return the estimates of a standard by the names of its figures, one a subject."""
    found: dict[str, list[dict[str, Any]]] = {}
    for reading in result["readings"]:
        if (reading["side"], reading["standard"]) == (side, standard):
            for one in reading["figures"]:
                if one["estimate"] is not None:
                    found.setdefault(one["name"], []).append(one["estimate"])
    return found


def truths_are_recovered(result: dict[str, Any], side: str) -> None:
    """K and temporal dark noise of four planes, and the local distortion: within 4 standard uncertainties. Of nine
    normal scores one is beyond by chance in 0.06 % of all sessions."""
    truth = TRUTH.cameras[side].model
    linear = figures(result, side, "EMVA 1288 R4.0 Linear")
    for name, value in (
        ("system_gain", truth.conversion_gain_dn_per_e),
        ("temporal_dark_noise", truth.read_noise_e),
    ):
        assert len(linear[name]) == 4
        for one in linear[name]:
            # rounding to whole codes of 1 DN is subtracted as 1/12 DN^2: of a noise of 1 DN that is right to 0.1 %
            assert abs(one["value"] - value) < 4.0 * one["std"] + 1e-3 * value, (name, one, value)
    geometry = truth.geometry
    assert geometry is not None
    exact = Iso17850(
        _Side(truth.rows, truth.cols),
        GeometryFit(camera_matrix=geometry.camera_matrix, distortion=geometry.distortion, rms_px=0.0),
    )
    (one,) = figures(result, side, "ISO 17850:2015")["local_distortion_half"]
    assert abs(one["value"] - exact.local_distortion_half.value) < 4.0 * one["std"]


class _Side:
    """What a standard asks of a side that was measured."""

    def __init__(self, rows: int, cols: int) -> None:
        self.side, self.camera, self.fit = "left", self, CameraFit()
        self.rows, self.cols = rows, cols


def lens_on_the_camera_is_told(result: dict[str, Any], side: str) -> None:
    """The bench's lens shades by 8 %: no figure of EMVA 1288 is by the standard, in one line a plane."""
    own = [one for one in result["readings"] if (one["side"], one["standard"]) == (side, "EMVA 1288 R4.0 Linear")]
    for reading in own:
        lines = [one for one in reading["deviations"] if one["quantity"].startswith("nonuniformity of the light")]
        assert len(lines) == 1
        assert lines[0]["limit"] == "3 % at most"
        assert not any(one["by_the_standard"] for one in reading["figures"])
