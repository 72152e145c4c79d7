"""Folders of images or raws with an index: every kind of capture, and one line for each row that can't be used."""

import shutil
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lab.errors import InputError
from lab.fit.geometry import fit_geometry
from lab.fit.stereo import fit_stereo
from lab.foreign_recordings import read_foreign
from lab.formats import recording_set as recording
from lab.formats.importers import ImportOptions
from lab.formats.importers.raw_folder import capture_of_row, read_checkerboard_pairs, read_index, read_raw_folder

DATA = Path(__file__).resolve().parents[5] / "shared" / "data" / "opencv_stereo"
HEADER = (
    "frame,kind,side,exposure_s,wavelength_nm,radiance,region,corners,chart,screen.pose,screen.cell_camera_px,target\n"
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A Bayer camera's 8- and 16-bit images with a spectrum and a target."""
    rng = np.random.default_rng(2)
    path = tmp_path / "in"
    (path / "sub").mkdir(parents=True)
    for name, dtype in (
        ("dark.png", np.uint8),
        ("nb.png", np.uint16),
        ("edge.tif", np.uint16),
        ("sub/noise.png", np.uint16),
    ):
        assert cv2.imwrite(str(path / name), rng.integers(0, 200, (12, 16)).astype(dtype))
    np.save(path / "chart.npy", rng.integers(0, 200, (12, 16), dtype=np.uint16))
    np.save(path / "target.npy", rng.integers(0, 2, (5, 5), dtype=np.uint8))
    (path / "s.csv").write_text("wavelength_nm,value\n500,0.1\n510,0.2\n")
    (path / "camera.toml").write_text('cfa = "RGGB"\nbit_depth = 12\npixel_pitch_um = 3.45\n')
    (path / "index.csv").write_text(
        HEADER
        + "dark.png,dark,,0.5,,,,,,,,\n"
        + "nb.png,narrowband,left,0.1,505,s.csv,,,,,,\n"
        + "edge.tif,slanted_edge,left,0.1,,,1 2 11 14,,,,,\n"
        + "chart.npy,chart,left,0.1,,s.csv,,1 1 1 14 10 14 10 1,ColorChecker24,,,\n"
        + "sub/noise.png,bernoulli,left,0.1,,,,,,p0,4.5,target.npy\n\n"
    )
    return path


def test_every_capture_becomes_one_of_the_recording_set(folder: Path, tmp_path: Path) -> None:
    recordings = recording.read(recording.write(read_raw_folder(folder), tmp_path / "out"))
    assert [capture.kind for capture in recordings.captures()] == [
        "dark",
        "narrowband",
        "slanted_edge",
        "chart",
        "bernoulli",
    ]
    assert recordings.captures("slanted_edge")[0].region == (1, 2, 11, 14)
    assert recordings.captures("chart")[0].corners == ((1, 1), (1, 14), (10, 14), (10, 1))
    noise = recordings.captures("bernoulli")[0]
    assert (noise.screen.pose, noise.screen.cell_camera_px, noise.id) == ("p0", 4.5, "noise")
    assert recordings.spectrum("s.csv").value == (0.1, 0.2)
    assert recordings.target("target.npy").shape == (5, 5)
    camera = recordings.camera("left")
    assert (camera.rows, camera.cols, camera.bit_depth, camera.pixel_pitch_um) == (12, 16, 12, 3.45)
    stored = cv2.imread(str(folder / "edge.tif"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(recordings.frame(recordings.captures("slanted_edge")[0]), stored)


def test_rows_that_cannot_be_used_are_all_named(folder: Path) -> None:
    with (folder / "index.csv").open("a") as file:
        file.write(
            "missing.png,dark,left,1\n../in/dark.png,dark,left,1\n,dark,left,1\nedge.tif,slanted_edge,left,1,,,1 2 x "
            "4\n"
        )
        file.write("/etc/hostname,dark,left,1\n../../x.png,dark,left,1\n")
    with pytest.raises(InputError) as caught:
        read_raw_folder(folder)
    lines = str(caught.value).splitlines()
    assert [
        word in line for word, line in zip(["row 8", "row 10", "row 11", "row 12", "row 13"], lines, strict=True)
    ] == [True] * 5


def test_manifest_rules_hold_for_rows_too(folder: Path) -> None:
    with (folder / "index.csv").open("a") as file:
        file.write("dark.png,hologram,left,1\ndark.png,dark,top,1\nnb.png,narrowband,left,,505,s.csv\n")
    with pytest.raises(InputError) as caught:
        read_raw_folder(folder)
    side, exposure = str(caught.value).splitlines()
    assert "side" in side
    assert "exposure_s" in exposure


@pytest.mark.parametrize(("stated_c", "words"), [(77.0, "a temperature in kelvin"), (60.0, ""), (-196.0, "")])
def test_temperatures_that_may_be_in_kelvin_are_asked_about(folder: Path, stated_c: float, words: str) -> None:
    """77 K is liquid nitrogen; silicon works at 60 degree C, and at -196."""
    (folder / "index.csv").write_text(f"frame,kind,side,exposure_s,temperature_c\ndark.png,dark,left,0.1,{stated_c}\n")
    recordings = read_raw_folder(folder)
    told = [line for line in recording.inspect(recordings)[1] if "temperature_c" in line]
    assert len(told) == bool(words) and all(words in line for line in told)


def test_index_or_camera_file_missing_or_useless(folder: Path) -> None:
    text = (folder / "index.csv").read_text()
    for content, word in (
        ("a,b\n1,2\n", "no columns"),
        (HEADER, "no captures"),
        ("frame,kind\na,b,c\n", "3 cells under 2"),
    ):
        (folder / "index.csv").write_text(content)
        with pytest.raises(InputError, match=word):
            read_raw_folder(folder)
    (folder / "index.csv").write_text(text)
    for content, word in (("cfa = ", "isn't TOML"), ("bit_depth = 12\n", "cfa"), ('cfa = "RGBX"\n', "cfa")):
        (folder / "camera.toml").write_text(content)
        with pytest.raises(InputError, match=word):
            read_raw_folder(folder)
    (folder / "camera.toml").unlink()
    with pytest.raises(InputError, match=r"camera\.toml: missing"):
        read_raw_folder(folder)
    (folder / "index.csv").unlink()
    with pytest.raises(InputError, match=r"index\.csv"):
        read_raw_folder(folder)


def test_columns_that_are_meant_to_be_others_are_named(folder: Path) -> None:
    text = (folder / "index.csv").read_text()
    for old, new, words in (
        ("exposure_s", "exposure_ms", "unknown column 'exposure_ms': write exposure_s, in seconds"),
        ("region", "Region", "unknown column 'Region': write region"),
        ("screen.pose", "screen_pose", "unknown column 'screen_pose': write screen.pose"),
        ("target", "kind", "the column kind stands twice"),
    ):
        (folder / "index.csv").write_text(text.replace(old, new, 1))
        with pytest.raises(InputError) as caught:
            read_raw_folder(folder)
        assert words in str(caught.value)
        assert "\n" not in str(caught.value)
    (folder / "index.csv").write_text(text.replace("target", "target,operator", 1))
    assert f"{folder}/index.csv: columns that no capture has are left out: operator" in read_raw_folder(folder).warnings


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60, deadline=None)
@given(
    header=st.lists(st.sampled_from(["frame", "kind", "exposure_s", "exposure_ms", "x", "", "Frame"])),
    cells=st.text(alphabet='a0.5,;\t"\n -', max_size=60),
)
def test_any_index_is_read_or_refused_in_one_line(tmp_path: Path, header: list[str], cells: str) -> None:
    (tmp_path / "index.csv").write_text(f"{','.join(header)}\n{cells}")
    try:
        index = read_index(tmp_path / "index.csv")
    except InputError as error:
        assert len(str(error).splitlines()) == 1
        return
    for _, row in index.rows:
        with suppress(InputError):
            capture_of_row(row)


def test_the_notes_keep_the_warnings_without_the_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "index.csv").write_text((folder / "index.csv").read_text().replace("target", "target,operator", 1))
    notes = "imported from a folder of images\nindex.csv: columns that no capture has are left out: operator"
    assert read_foreign("raw-folder", folder).manifest.notes == notes
    monkeypatch.chdir(folder)
    assert read_foreign("raw-folder", Path()).manifest.notes == notes


def test_rows_of_which_the_same_is_said_share_a_line(folder: Path) -> None:
    with (folder / "index.csv").open("a") as file:
        file.write("dark.png,dark,left,-1\nnb.png,dark,left,-1\n")
    with pytest.raises(InputError) as caught:
        read_raw_folder(folder)
    said = "row 8 (dark-2) and 1 more: exposure_s: input should be greater than or equal to 0 (it is '-1'); correct it"
    assert str(caught.value) == f"{folder}/index.csv: {said}"


def test_an_index_of_another_country_is_read_and_told(folder: Path, tmp_path: Path) -> None:
    """Semicolons, decimal commas, UTF-16; spectra likewise. The set that is written has the format's own."""
    plain = recording.write(read_raw_folder(folder), tmp_path / "plain")
    index, spectrum = (folder / "index.csv").read_text(), (folder / "s.csv").read_text()
    foreign = index.replace(",", ";").replace("0.1;", "0,1;").replace("0.5;", "0,5;").replace("4.5", "4,5")
    (folder / "index.csv").write_bytes(foreign.encode("utf-16"))
    (folder / "s.csv").write_text(spectrum.replace(",", ";").replace(".", ","))
    read = read_raw_folder(folder)
    assert f"{folder}/index.csv: read as UTF-16" in read.warnings
    for name in ("index.csv", "s.csv"):
        assert f"{folder}/{name}: read with semicolons between cells and decimal commas" in read.warnings
    written = recording.write(read, tmp_path / "out")
    assert (written / "manifest.json").read_text() == (plain / "manifest.json").read_text()
    assert (written / "s.csv").read_text().startswith("wavelength_nm,value\n500.0,0.1")


def test_a_channel_of_transparency_is_dropped_and_told(folder: Path) -> None:
    grey = cv2.imread(str(folder / "dark.png"), cv2.IMREAD_UNCHANGED)
    assert cv2.imwrite(str(folder / "dark.png"), np.dstack([grey, grey, grey, np.full_like(grey, 255)]))
    read = read_raw_folder(folder)
    np.testing.assert_array_equal(read.frame(read.captures("dark")[0]), grey)
    assert any("dark.png: has a channel of transparency, which is dropped" in line for line in read.warnings)


def test_boards_without_markers(folder: Path) -> None:
    """As a kind of its own, with markers of 0 mm, and as the pictures of a folder."""
    for name in "abc":
        cv2.imwrite(str(folder / f"{name}.png"), np.full((12, 16), 90, np.uint8))
    (folder / "index.csv").write_text(
        "frame,kind,squares,square_mm,marker_mm,dictionary,pose\na.png,checkerboard,7 10,25,,,p\nb.png,charuco,7 "
        "10,25,0,DICT_4X4_50,q\n"
        "c.png,charuco,8 10,10,0,dots,r\n"
    )
    boards = read_raw_folder(folder).captures("charuco")
    assert [(b.dictionary, b.squares, b.marker_mm, b.has_markers) for b in boards] == [
        ("none", (7, 10), None, False),
        ("none", (7, 10), None, False),
        ("dots", (8, 10), None, False),
    ]
    (folder / "index.csv").write_text("frame;wavelength_nm\nb.png;450,5\na.png;650\n")
    options = ImportOptions(checkerboard=(6, 9), square_mm=25.0)
    read = read_foreign("checkerboard", folder, options)
    assert [(b.id, b.wavelength_nm, b.squares, b.pose) for b in read.captures("charuco")] == [
        ("b", 450.5, (7, 10), "p000"),
        ("a", 650.0, (7, 10), "p001"),
    ]
    (one,) = read_foreign("checkerboard", folder / "a.png", options).captures("charuco")
    assert (one.id, one.wavelength_nm) == ("a", None)
    with pytest.raises(InputError, match="state --checkerboard ROWSxCOLS, its inner corners, and --square-mm"):
        read_foreign("checkerboard", folder)


@pytest.mark.parametrize("kind", ["raw-folder", "fits", "emva1288"])
def test_an_empty_folder(tmp_path: Path, kind: str) -> None:
    with pytest.raises(InputError) as caught:
        read_foreign(kind, tmp_path)
    assert str(caught.value) == f"{tmp_path}: is empty; give the folder of the recordings"


def test_a_file_for_a_folder_and_the_other_way(folder: Path) -> None:
    with pytest.raises(InputError, match=r"dark\.png: is a file; give the folder that it is in"):
        read_foreign("raw-folder", folder / "dark.png")
    (folder / "mine.tar.gz").write_bytes(b"")
    with pytest.raises(InputError, match=r"mine\.tar\.gz: is a file; unpack it, and give the folder"):
        read_foreign("raw-folder", folder / "mine.tar.gz")
    with pytest.raises(InputError, match="in: is a folder; give one picture"):
        read_foreign("slanted-edge", folder)


def test_real_pictures_of_a_checkerboard_by_one_camera(tmp_path: Path) -> None:
    """The left pictures alone need no kind and no dictionary."""
    if not DATA.is_dir():
        pytest.skip("the shared data are not here")
    (tmp_path / "in").mkdir()
    for file in DATA.glob("left*.jpg"):
        shutil.copy(file, tmp_path / "in")
    (tmp_path / "in" / "camera.toml").write_text('cfa = "MONO"\n')
    read = read_foreign("checkerboard", tmp_path / "in", ImportOptions(checkerboard=(6, 9), square_mm=25.0))
    assert [capture.kind for capture in read.captures()] == ["charuco"] * 13


def test_truncated_jpeg_is_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    for side in ("left", "right"):
        cv2.imwrite(str(tmp_path / f"{side}1.jpg"), rng.integers(0, 255, (40, 60), dtype=np.uint8))
    (tmp_path / "left2.jpg").write_bytes((tmp_path / "left1.jpg").read_bytes())
    (tmp_path / "right2.jpg").write_bytes((tmp_path / "right1.jpg").read_bytes()[:-500])
    (tmp_path / "left3.jpg").write_bytes((tmp_path / "left1.jpg").read_bytes())
    recordings = read_checkerboard_pairs(tmp_path, (6, 9), 25.0)
    assert recordings.warnings == (f"{tmp_path}: left3.jpg left out; the other side of the pair is missing",)
    problems, _ = recording.inspect(recordings)
    assert len(problems) == 1
    assert "right2.jpg" in problems[0]
    assert "ends too early" in problems[0]


def test_no_pairs(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no pairs"):
        read_checkerboard_pairs(tmp_path, (6, 9), 25.0)


def test_real_stereo_pairs(tmp_path: Path) -> None:
    if not DATA.is_dir():
        pytest.skip("the shared data are not here")
    recordings = recording.read(recording.write(read_checkerboard_pairs(DATA, (6, 9), 25.0), tmp_path / "out"))
    assert len(recordings.captures("charuco", "left")) == 13
    assert recordings.warnings == ()
    stereo = fit_stereo(recordings, fit_geometry(recordings, "left"), fit_geometry(recordings, "right"))
    assert stereo.rms_px <= 0.25  # the demand; OpenCV's own corners give 0.217 px
