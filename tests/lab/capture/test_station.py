"""The station file: its content, and one line for what can't be used."""

from pathlib import Path

import pytest

from lab.capture.station import Station, drivers_of, read_station
from lab.capture_kinds.charuco import BoardTarget
from lab.capture_kinds.dark import CapTarget
from lab.capture_kinds.screen import ScreenTarget
from lab.capture_kinds.slanted_edge import EdgeTarget
from lab.errors import DeviceError, InputError

TEXT = """
name = "bench 3"
[monochromator]
driver = "cornerstone260"
address = "/dev/null"
move_timeout_s = 12.0
[stage]
driver = "operator"
address = "socket://127.0.0.1:1"
[cameras.left]
driver = "u3v"
address = "usbip://127.0.0.1:1/A"
[cameras.left.datasheet]
rows = 480
cols = 640
cfa = "RGGB"
bit_depth = 12
quantum_efficiency = {R = {wavelength_nm = [400, 700], value = [0.1, 0.5]}, G = "g.csv"}
[targets.cap]
kind = "cap"
[targets.edge-1]
kind = "slanted_edge"
angle_deg = 5.0
[targets.edge-1.left]
regions = [{name = "centre", region = [0, 0, 10, 10], angle_deg = 5.0, field_mm = [0.0, 0.0]}]
[targets.charuco-01]
kind = "charuco"
dictionary = "DICT_4X4_50"
squares = [5, 7]
square_mm = 10.0
marker_mm = 7.0
pose = "p1"
"""


def written(folder: Path, text: str) -> Path:
    (folder / "g.csv").write_text("wavelength_nm,value\n400,0.2\n500,0.4\n")
    file = folder / "station.toml"
    file.write_text(text)
    return file


def test_everything_is_where_the_file_says(tmp_path: Path) -> None:
    station = read_station(written(tmp_path, TEXT))
    assert station.name == "bench 3"
    assert station.sides == ("left",)
    assert station.monochromator is not None
    assert station.monochromator.settings == {"move_timeout_s": 12.0}
    assert station.display is None
    assert station.one(CapTarget) == "cap"
    assert list(station.list_targets(BoardTarget)) == ["charuco-01"]
    assert station.list_targets(EdgeTarget)["edge-1"].right is None


def test_curves_are_taken_inline_and_from_files(tmp_path: Path) -> None:
    camera = read_station(written(tmp_path, TEXT)).cameras["left"]
    assert camera.datasheet.quantum_efficiency is None
    assert camera.quantum_efficiency["R"].value == (0.1, 0.5)
    assert camera.quantum_efficiency["G"].wavelength_nm == (400.0, 500.0)


def test_a_station_survives_the_registry(tmp_path: Path) -> None:
    station = read_station(written(tmp_path, TEXT))
    assert Station.model_validate(station.model_dump(mode="json")) == station


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("rows = 480", "rows = 0", "cameras.left.datasheet.rows"),
        ("rows = 480", "rows = 480\nrowz = 3", "rowz"),
        ('kind = "cap"', 'kind = "hat"', "targets.cap"),
        ("angle_deg = 5.0\n[", "angle_deg = 5.0\ntilt = 3\n[", "tilt"),
        ('"g.csv"', '"missing.csv"', "missing.csv"),
        ('address = "/dev/null"', "", "monochromator: address is missing"),
        ("[stage]", "[stage", "isn't TOML"),
        ("socket://127.0.0.1:1", "/dev/null", "[monochromator] and [stage] both have the address /dev/null"),
        ("[cameras.left]", "[cameras.middle]", "cameras.middle"),
    ],
)
def test_what_cannot_be_used_is_named_in_one_line(tmp_path: Path, old: str, new: str, named: str) -> None:
    assert old in TEXT
    file = written(tmp_path, TEXT.replace(old, new))
    with pytest.raises(InputError) as caught:
        read_station(file)
    assert named in str(caught.value)
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_port_by_two_names_is_one_port(tmp_path: Path) -> None:
    (tmp_path / "by-id").symlink_to("/dev/null")
    file = written(tmp_path, TEXT.replace("socket://127.0.0.1:1", str(tmp_path / "by-id")))
    with pytest.raises(InputError, match=r"toml: \[monochromator\] and \[stage\] both have the address /dev/null"):
        read_station(file)


def test_a_missing_file_says_how_to_get_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="calibench bench --station"):
        read_station(tmp_path / "none.toml")


def test_a_missing_target_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no target of kind 'screen'"):
        read_station(written(tmp_path, TEXT)).one(ScreenTarget)


def test_drivers_are_made_with_their_settings(tmp_path: Path) -> None:
    drivers = drivers_of(read_station(written(tmp_path, TEXT)))
    assert drivers.monochromator is not None
    assert drivers.monochromator.move_timeout_s == 12.0  # type: ignore[attr-defined]
    assert drivers.spectroradiometer is None
    assert list(drivers.all) == ["monochromator", "stage", "camera left"]


def test_an_unknown_driver_is_a_device_error(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match="cornerstone9"):
        drivers_of(read_station(written(tmp_path, TEXT.replace("cornerstone260", "cornerstone9"))))


def test_a_setting_that_the_driver_does_not_know_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="colour"):
        drivers_of(read_station(written(tmp_path, TEXT.replace("move_timeout_s = 12.0", 'colour = "red"'))))


def test_a_person_at_a_prompt_needs_no_address(tmp_path: Path) -> None:
    camera = (
        '[cameras.left]\ndriver = "u3v"\naddress = "usb://1"\n[cameras.left.datasheet]\nrows = 2\ncols = 2\nbit_depth '
        '= 12\ncfa = "RGGB"\n'
    )
    file = tmp_path / "station.toml"
    file.write_text(f'{camera}[stage]\ndriver = "prompt"\n')
    stage = read_station(file).stage
    assert stage is not None
    assert stage.address == ""
    file.write_text(f'{camera}[stage]\ndriver = "operator"\n')
    with pytest.raises(InputError, match="stage: address is missing; only the driver prompt"):
        read_station(file)
