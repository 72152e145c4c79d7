"""`calibench sequences`: the catalogue, and what a station takes of it; `--set` in place of a full session's values."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lab.cli import main
from tests.api.conftest import STATION


@pytest.fixture
def station(tmp_path: Path) -> Path:
    file = tmp_path / "fakes.toml"
    file.write_text(STATION)
    return file


def test_the_catalogue_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sequences"]) == 0
    told = capsys.readouterr().out
    for words in ("narrowband: spectral sensitivity", "step_nm", "(0.1 .. 500)", "stereo"):
        assert words in told
    assert "captures" not in told


def test_a_station_is_told_its_captures_and_time(
    station: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["sequences", "--station", str(station), "--data", str(tmp_path / "data"), "--only", "dark"]
    assert main([*asked, "--set", "dark.exposures_s=0.01,0.1", "--set", "dark.frames=3", "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["captures"] == 12 and found["sequences"][0]["parameters"] == {
        "exposures_s": [0.01, 0.1], "frames": 3, "sensor_c": None
    }  # fmt: skip
    assert main([*asked, "--quick"]) == 0
    told = capsys.readouterr().out
    assert "32 captures in 16 steps, about" in told and "0.0005, 0.5, 2, 5" in told


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--set", "dark.frames=0"], "below the lower limit 1"),
        (["--set", "dark.frames"], "give SEQUENCE.PARAMETER=VALUE"),
        (["--set", "edge.frames=2"], "parameters: edge isn't taken"),
        (["--only", "edge"], "the station lacks instruments or targets for edge"),
    ],
)
def test_what_cannot_be_taken_is_said_in_one_line(
    station: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], said: str
) -> None:
    assert main(["sequences", "--station", str(station), "--data", str(tmp_path / "data"), *options]) == 2
    told = capsys.readouterr().err
    assert said in told and told.count("\n") == 1


def test_values_go_with_a_station(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sequences", "--quick"]) == 2
    assert "give --station" in capsys.readouterr().err
