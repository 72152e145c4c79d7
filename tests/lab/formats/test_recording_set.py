"""Recording sets: written and read again bit for bit, and one line for everything that the format refuses."""

import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.errors import InputError
from lab.formats.recording_set import Manifest, RecordingError, RecordingSet, read, write
from sim.spectrum import Spectrum

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"


@pytest.fixture
def folder(small_set: Callable[..., RecordingSet], tmp_path: Path) -> Path:
    return write(small_set(), tmp_path / "set")


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    file = folder / "manifest.json"
    manifest = json.loads(file.read_text())
    change(manifest)
    file.write_text(json.dumps(manifest))


def problems(folder: Path) -> tuple[str, ...]:
    with pytest.raises(RecordingError) as caught:
        read(folder)
    assert caught.value.exit_code == 2
    assert all("\n" not in line and ";" in line for line in caught.value.problems), "one line each, with a remedy"
    return caught.value.problems


def only(folder: Path, *words: str) -> None:
    """The folder is refused with exactly one line, and that line says all of `words`."""
    lines = problems(folder)
    assert len(lines) == 1, lines
    for word in words:
        assert word in lines[0], lines[0]


# --- what is fine -------------------------------------------------------------------------------------------------------


def test_written_set_reads_back_bit_for_bit(small_set: Callable[..., RecordingSet], folder: Path) -> None:
    before, after = small_set(), read(folder)
    assert after.warnings == ()
    assert after.manifest == before.manifest
    assert after.sides == ("left", "right")
    for capture in before.captures():
        np.testing.assert_array_equal(after.frame(capture), before.frame(capture))
        assert after.frame(capture).dtype == np.uint16
    assert after.spectrum("spectra/lamp.csv") == before.spectrum("spectra/lamp.csv")
    np.testing.assert_array_equal(after.target("targets/bernoulli.npy"), before.target("targets/bernoulli.npy"))


def test_a_copy_of_a_folder_keeps_the_files_bytes_and_the_unknown_keys(folder: Path, tmp_path: Path) -> None:
    edit(folder, lambda m: m["captures"][0].update(operator="Ada", iso=None) or m.update(lab={"room": 7}))
    again = write(read(folder), tmp_path / "again")
    for file in sorted((folder / "frames").iterdir()):
        assert (again / "frames" / file.name).read_bytes() == file.read_bytes()
    manifest = json.loads((again / "manifest.json").read_text())
    assert manifest == json.loads((folder / "manifest.json").read_text())
    assert manifest["captures"][0]["operator"] == "Ada"


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    frame=hnp.arrays(np.uint16, st.tuples(st.integers(1, 9), st.integers(1, 9))),
    name=st.text(st.characters(codec="utf-8"), max_size=20),
    exposure_s=st.floats(0, 1e6),
    suffix=st.sampled_from(["npy", "tif"]),
    wavelengths=st.lists(st.floats(1, 1e4), min_size=1, max_size=8, unique=True).map(sorted),
    value=st.floats(allow_nan=False, allow_infinity=False),
)
def test_any_set_survives_writing_and_reading(
    *,
    tmp_path: Path,
    frame: np.ndarray[Any, Any],
    name: str,
    exposure_s: float,
    suffix: str,
    wavelengths: list[float],
    value: float,
) -> None:
    camera = {"rows": frame.shape[0], "cols": frame.shape[1], "cfa": "MONO", "bit_depth": 16}
    capture = {"id": name, "kind": "dark", "side": "left", "frame": f"frames/a.{suffix}", "exposure_s": exposure_s}
    lit = capture | {
        "id": name + "'",
        "kind": "narrowband",
        "frame": "frames/b.npy",
        "wavelength_nm": 500,
        "radiance": "s.csv",
    }
    manifest = Manifest.model_validate({"name": name, "cameras": {"left": camera}, "captures": [capture, lit]})
    spectrum = Spectrum.of(wavelengths, [value] * len(wavelengths))
    before = RecordingSet(manifest, {capture["frame"]: frame, "frames/b.npy": frame}, {"s.csv": spectrum})
    folder = tmp_path / "any"
    shutil.rmtree(folder, ignore_errors=True)
    after = read(write(before, folder))
    assert after.manifest.name == name
    assert after.captures("dark")[0].exposure_s == exposure_s
    np.testing.assert_array_equal(after.frame(after.captures("dark")[0]), frame)
    assert after.spectrum("s.csv") == spectrum


def test_captures_by_kind_class_and_side(small_set: Callable[..., RecordingSet]) -> None:
    recordings = small_set()
    assert [c.id for c in recordings.captures("dark", "left")] == ["dark-000", "dark-006"]
    assert recordings.captures(DarkCapture, "left") == recordings.captures("dark", "left")
    assert all(isinstance(c, FlatCapture) for c in recordings.captures("flat"))
    assert len(recordings.captures()) == len(recordings.manifest.captures)
    assert recordings.capture("dark-006").side == "left"
    with pytest.raises(InputError, match="no capture 'nope'"):
        recordings.capture("nope")


def test_frames_are_read_only_and_the_cache_keeps_to_its_size(folder: Path) -> None:
    recordings = read(folder)
    first, second = recordings.captures()[:2]
    with pytest.raises(ValueError, match="read-only"):
        recordings.frame(first)[0, 0] = 1
    one = recordings.frame(first).nbytes
    small = RecordingSet(recordings.manifest, files=recordings._files, cache_bytes=one)
    kept = small.frame(first)
    assert small.frame(first) is kept
    small.frame(second)
    assert small.frame(first) is not kept
    kept = small.frame(first)
    small.let_go()
    assert small.frame(first) is not kept


def test_a_set_travels_to_another_process(folder: Path) -> None:
    recordings = read(folder)
    again = pickle.loads(pickle.dumps(recordings))
    capture = recordings.captures()[0]
    np.testing.assert_array_equal(again.frame(capture), recordings.frame(capture))


def test_unknown_kind_and_unknown_keys_are_reported_and_passed_over(folder: Path) -> None:
    edit(folder, lambda m: m["captures"].append({"id": "x", "kind": "hologram", "anything": 1}))
    edit(folder, lambda m: m["cameras"]["left"].update(shutter="rolling"))
    edit(folder, lambda m: next(c for c in m["captures"] if c["kind"] == "white")["screen"].update(nits=300))
    recordings = read(folder)
    assert len(recordings.warnings) == 3
    assert "unknown kind 'hologram'" in recordings.warnings[0]
    assert any("'shutter'" in line and "camera left" in line for line in recordings.warnings)
    assert any("'nits'" in line and "screen" in line for line in recordings.warnings)
    assert recordings.camera("left").unknown_keys() == {"shutter": "rolling"}


def test_only_unknown_kinds_leave_nothing_to_work_with(folder: Path) -> None:
    edit(folder, lambda m: m.update(captures=[{"id": "x", "kind": "hologram"}]))
    lines = problems(folder)
    assert "hologram" in lines[0]
    assert "no capture that can be used" in lines[1]


def test_byte_order_and_memory_order_of_a_frame_do_not_matter(folder: Path) -> None:
    frame = np.load(folder / "frames/dark-000.npy")
    np.save(folder / "frames/dark-000.npy", np.asfortranarray(frame.astype(">u2")))
    recordings = read(folder)
    loaded = recordings.frame(recordings.capture("dark-000"))
    np.testing.assert_array_equal(loaded, frame)
    assert loaded.dtype == np.uint16
    assert loaded.flags.c_contiguous


# --- what is refused: damaged files -------------------------------------------------------------------------------------


def test_truncated_frame(folder: Path) -> None:
    file = folder / "frames/dark-000.npy"
    file.write_bytes(file.read_bytes()[:-100])
    only(folder, "frames/dark-000.npy", "dark-000", "damaged", "recapture")


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY", b"hello", b"\x00" * 500])
def test_garbage_in_place_of_a_frame(folder: Path, content: bytes) -> None:
    (folder / "frames/dark-000.npy").write_bytes(content)
    only(folder, "frames/dark-000.npy", "damaged")


def test_header_that_announces_terabytes_is_not_allocated(folder: Path) -> None:
    with (folder / "frames/dark-000.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<u2", "fortran_order": False, "shape": (10**7, 10**7)})
    only(folder, "frames/dark-000.npy", "damaged")


def test_pickled_frame_is_not_run(folder: Path) -> None:
    np.save(folder / "frames/dark-000.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    only(folder, "frames/dark-000.npy", "damaged")


def test_archive_in_place_of_a_frame(folder: Path) -> None:
    with (folder / "frames/dark-000.npy").open("wb") as file:
        np.savez(file, a=np.zeros((24, 32), np.uint16))
    only(folder, "archive of arrays")


@pytest.mark.parametrize("dtype", [np.uint8, np.float32, np.int16, np.uint32])
def test_wrong_dtype(folder: Path, dtype: Any) -> None:
    np.save(folder / "frames/dark-000.npy", np.zeros((24, 32), dtype))
    only(folder, "frames/dark-000.npy", np.dtype(dtype).name, "uint16")


def test_wrong_size_and_wrong_dimensions(folder: Path) -> None:
    np.save(folder / "frames/dark-000.npy", np.zeros((24, 30), np.uint16))
    np.save(folder / "frames/flat-001.npy", np.zeros((24, 32, 3), np.uint16))
    size, dimensions = problems(folder)
    assert "24 x 30" in size
    assert "24 x 32" in size
    assert "3 dimensions" in dimensions


def test_tif_with_several_pages_8_bit_colours_and_damage(folder: Path) -> None:
    paths = [
        c["frame"] for c in json.loads((folder / "manifest.json").read_text())["captures"] if c["frame"].endswith("tif")
    ]
    frame = np.zeros((24, 32), np.uint16)
    tifffile.imwrite(folder / paths[0], np.stack([frame, frame]), photometric="minisblack")
    tifffile.imwrite(folder / paths[1], frame.astype(np.uint8), photometric="minisblack")
    tifffile.imwrite(folder / paths[2], np.zeros((24, 32, 3), np.uint16), photometric="rgb")
    whole = (folder / paths[3]).read_bytes()
    (folder / paths[3]).write_bytes(whole[: len(whole) // 2])
    lines = problems(folder)
    assert [word in line for word, line in zip(["2 pages", "uint8", "shape", "damaged"], lines, strict=True)] == [
        True
    ] * 4


def test_damaged_raw_and_unknown_ending(folder: Path) -> None:
    def rename(manifest: dict[str, Any]) -> None:
        manifest["captures"][0]["frame"] = "frames/a.dng"
        manifest["captures"][1]["frame"] = "frames/b.jpg"

    edit(folder, rename)
    (folder / "frames/a.dng").write_bytes(b"II*\x00 not a raw")
    (folder / "frames/b.jpg").write_bytes(b"\xff\xd8")
    damaged, ending = problems(folder)
    assert "damaged raw" in damaged
    assert "can't be .jpg" in ending


def test_dng_is_read_as_the_mosaic_it_holds(folder: Path) -> None:
    frame = np.load(folder / "frames/dark-000.npy") + np.arange(32, dtype=np.uint16)
    write_dng(folder / "frames/dark.dng", frame)
    edit(folder, lambda m: m["captures"][0].update(frame="frames/dark.dng"))
    recordings = read(folder)
    np.testing.assert_array_equal(recordings.frame(recordings.capture("dark-000")), frame)


def write_dng(file: Path, frame: np.ndarray[Any, Any]) -> None:
    """The least DNG that LibRaw takes: one CFA page, RGGB, 12 bit in 16."""
    tags: list[Any] = [
        (50706, "B", 4, (1, 4, 0, 0), True),  # DNGVersion
        (50708, "s", 0, "calibench test", True),  # UniqueCameraModel
        (33421, "H", 2, (2, 2), True),  # CFARepeatPatternDim
        (33422, "B", 4, (0, 1, 1, 2), True),  # CFAPattern
        (50714, "H", 1, 64, True),  # BlackLevel
        (50717, "H", 1, 4095, True),  # WhiteLevel
        (50721, "2i", 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),  # ColorMatrix1
        (50778, "H", 1, 21, True),  # CalibrationIlluminant1
    ]
    tifffile.imwrite(file, frame, photometric=32803, extratags=tags, metadata=None)


def test_frame_above_bit_depth_and_above_white_level(folder: Path) -> None:
    edit(folder, lambda m: m["cameras"]["right"].update(white_level_dn=4000))
    for path, value in (("frames/dark-000.npy", 5000), ("frames/dark-020.npy", 4050)):
        frame = np.load(folder / path)
        frame[3, 4] = value
        np.save(folder / path, frame)
    depth, white = problems(folder)
    assert "5000 DN" in depth
    assert "12 bits" in depth
    assert "4050 DN" in white
    assert "white_level_dn = 4000" in white


def test_missing_frame_spectrum_target_and_lens(folder: Path) -> None:
    for path in ("frames/dark-000.npy", "spectra/nb550.csv", "spectra/qe_G.csv", "targets/bernoulli.npy"):
        (folder / path).unlink()
    edit(folder, lambda m: m["cameras"]["left"].update(lens_file="lens.zmx"))
    lines = problems(folder)
    assert len(lines) == 5
    for path in ("frames/dark-000.npy", "spectra/nb550.csv", "spectra/qe_G.csv", "targets/bernoulli.npy", "lens.zmx"):
        assert sum(path in line and "no such file" in line for line in lines) == 1, path


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "first line"),
        ("nm,value\n400,1\n", "first line"),
        ("wavelength_nm,value\n", "no samples"),
        ("wavelength_nm,value\n400,1\n390,1\n", "390 nm follows 400 nm"),
        ("wavelength_nm,value\n400,1\n400,1\n", "400 nm follows 400 nm"),
        ("wavelength_nm,value\n400,nan\n", "isn't finite"),
        ("wavelength_nm,value\ninf,1\n", "isn't finite"),
        ("wavelength_nm,value\n400,1,2\n", "row 2"),
        ("wavelength_nm,value\n400,abc\n", "row 2"),
        ("wavelength_nm;value\n400;1\n", "first line"),
    ],
)
def test_spectrum_that_cannot_be_used(folder: Path, text: str, word: str) -> None:
    (folder / "spectra/nb550.csv").write_text(text)
    only(folder, "spectra/nb550.csv", "narrowband-012", word)


def test_spectrum_with_byte_order_mark_and_blank_lines_is_fine(folder: Path) -> None:
    (folder / "spectra/nb550.csv").write_bytes(b"\xef\xbb\xbfwavelength_nm,value\r\n540,0\r\n\r\n550,1e-5\r\n")
    assert read(folder).spectrum("spectra/nb550.csv").wavelength_nm == (540.0, 550.0)


def test_binary_in_place_of_a_spectrum_and_quantum_efficiency_in_percent(folder: Path) -> None:
    (folder / "spectra/nb550.csv").write_bytes(b"\xff\xfe\x00\x80")
    (folder / "spectra/qe_R.csv").write_text("wavelength_nm,value\n400,20\n500,45\n")
    percent, binary = problems(folder)
    assert "20..45 isn't a quantum efficiency" in percent
    assert "UTF-8" in binary


@pytest.mark.parametrize(
    "target", [np.full((4, 4), 255, np.uint8), np.zeros((4, 4), np.float64), np.zeros(4, np.uint8)]
)
def test_target_that_is_no_pattern(folder: Path, target: np.ndarray[Any, Any]) -> None:
    np.save(folder / "targets/bernoulli.npy", target)
    only(folder, "targets/bernoulli.npy", "bernoulli-018")


# --- what is refused: paths ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path",
    [
        "../outside.npy",
        "frames/../../outside.npy",
        "/etc/hostname",
        "C:/frame.npy",
        "frames\\dark-000.npy",
        "",
        "a\0b.npy",
    ],
)
def test_path_that_leaves_the_folder(folder: Path, path: str) -> None:
    np.save(folder.parent / "outside.npy", np.zeros((24, 32), np.uint16))
    edit(folder, lambda m: m["captures"][0].update(frame=path))
    only(folder, "dark-000")


def test_link_out_of_the_folder(folder: Path) -> None:
    outside = folder.parent / "outside.npy"
    shutil.move(folder / "frames/dark-000.npy", outside)
    (folder / "frames/dark-000.npy").symlink_to(outside)
    only(folder, "frames/dark-000.npy", "leads out of the folder", "copy the file")


def test_linked_folder_and_loop_of_links(folder: Path) -> None:
    shutil.move(folder / "spectra", folder.parent / "spectra")
    (folder / "spectra").symlink_to(folder.parent / "spectra")
    (folder / "frames/dark-000.npy").unlink()
    (folder / "frames/dark-000.npy").symlink_to("dark-000.npy")
    lines = problems(folder)
    assert sum("leads out of the folder" in line for line in lines) == 5  # five spectra are named
    assert sum("dark-000" in line for line in lines) == 1


def test_link_within_the_folder_is_fine_and_so_is_a_linked_set(folder: Path) -> None:
    shutil.move(folder / "frames/dark-000.npy", folder / "frames/first.npy")
    (folder / "frames/dark-000.npy").symlink_to("first.npy")
    (folder.parent / "link").symlink_to(folder)
    assert read(folder.parent / "link").warnings == ()


# --- what is refused: the manifest --------------------------------------------------------------------------------------


def test_folder_or_manifest_missing_or_no_json(folder: Path) -> None:
    assert "no such folder" in problems(folder.parent / "nowhere")[0]
    (folder / "manifest.json").write_text("{")
    only(folder, "manifest.json", "isn't JSON")
    (folder / "manifest.json").write_text("[]")
    only(folder, "isn't a JSON object")
    (folder / "manifest.json").unlink()
    only(folder, "manifest.json", "no such file")


def test_another_version(folder: Path) -> None:
    edit(folder, lambda m: m.update(version=2))
    only(folder, "version 2", "'calibench-recording' 1")


def test_everything_wrong_with_a_manifest_is_named_at_once(folder: Path) -> None:
    def spoil(manifest: dict[str, Any]) -> None:
        captures = manifest["captures"]
        captures[1]["exposure_s"] = -1
        del captures[2]["frame"]
        captures[3]["side"] = "top"
        captures[4]["exposure_s"] = float("nan")
        captures.append(17)
        manifest["cameras"]["left"]["rows"] = 0
        manifest["cameras"]["right"]["cfa"] = "XTRANS"

    edit(folder, spoil)
    lines = problems(folder)
    assert len(lines) == 7
    for word in ("exposure_s", "'frame' is missing", "side", "captures[40]", "left.rows", "right.cfa"):
        assert any(word in line for line in lines), word


def test_duplicate_id_and_capture_of_a_camera_that_is_not_there(folder: Path) -> None:
    edit(folder, lambda m: m["captures"][1].update(id="dark-000"))
    only(folder, "'dark-000' is used 2 times")
    edit(folder, lambda m: m["captures"][1].update(id="flat-001") or m["cameras"].pop("right"))
    lines = problems(folder)
    assert len(lines) == 20  # every capture of the right side
    assert all("no camera 'right'" in line for line in lines)


@pytest.mark.parametrize(
    ("kind", "change", "word"),
    [
        ("slanted_edge", {"region": [2, 2, 22, 33]}, "isn't inside the frame"),
        ("slanted_edge", {"region": [22, 2, 2, 30]}, "isn't inside the frame"),
        ("chart", {"corners": [[2, 2], [2, 29], [21, 40], [21, 2]]}, "outside the frame"),
        ("charuco", {"marker_mm": None}, "marker_mm"),
        ("charuco", {"marker_mm": 25.0}, "don't fit"),
        ("narrowband", {"radiance": None}, "radiance"),
        ("narrowband", {"wavelength_nm": 0}, "wavelength_nm"),
    ],
)
def test_capture_that_contradicts_itself(folder: Path, kind: str, change: dict[str, Any], word: str) -> None:
    edit(folder, lambda m: next(c for c in m["captures"] if c["kind"] == kind).update(change))
    only(folder, kind, word)


def test_a_narrowband_light_that_lies_off_its_name_is_remarked_on(folder: Path) -> None:
    def call_it(wavelength_nm: float) -> None:
        def change(manifest: dict[str, Any]) -> None:
            for capture in manifest["captures"]:
                if capture["kind"] == "narrowband":
                    capture["wavelength_nm"] = wavelength_nm

        edit(folder, change)

    assert not any("narrowband" in line for line in read(folder).warnings)
    call_it(554.0)  # within 3 nm and a quarter of the 10 nm
    assert not any("narrowband" in line for line in read(folder).warnings)
    call_it(556.0)
    assert [line for line in read(folder).warnings if "1 narrowband lights are centred elsewhere" in line]


def test_levels_that_contradict_each_other(folder: Path) -> None:
    edit(
        folder, lambda m: m["cameras"]["left"].update(black_level_dn=4095) or m["cameras"]["right"].update(bit_depth=11)
    )
    lines = problems(folder)
    assert any("black_level_dn = 4095" in line for line in lines)
    assert any("white_level_dn = 4095 is above what 11 bits hold" in line for line in lines)


def test_channel_that_the_sensor_has_not(folder: Path) -> None:
    edit(folder, lambda m: m["cameras"]["left"]["quantum_efficiency"].update(Y="spectra/qe_R.csv"))
    only(folder, "channel 'Y'", "RGGB")


# --- saturated flats ----------------------------------------------------------------------------------------------------


def flats_of(folder: Path, side: str) -> list[dict[str, Any]]:
    captures = json.loads((folder / "manifest.json").read_text())["captures"]
    return [c for c in captures if c["kind"] == "flat" and c["side"] == side]


@pytest.mark.parametrize("number", range(10))
def test_a_flat_that_is_saturated_alone_is_refused_wherever_it_stands(folder: Path, number: int) -> None:
    flat = flats_of(folder, "left")[number]
    file = folder / flat["frame"]
    frame = np.full((24, 32), 4095, np.uint16)
    np.save(file, frame) if file.suffix == ".npy" else tifffile.imwrite(
        file, frame, photometric="minisblack", metadata=None
    )
    only(folder, flat["id"], "saturated flat, 100 %")


def saturate(folder: Path, flats: list[dict[str, Any]], exposure_s: float, dn: int = 4095) -> None:
    def change(manifest: dict[str, Any]) -> None:
        for number, flat in enumerate(flats):
            path = f"frames/top-{number}.npy"
            np.save(folder / path, np.full((24, 32), dn, np.uint16))
            manifest["captures"].append(flat | {"id": f"top-{number}", "frame": path, "exposure_s": exposure_s})

    edit(folder, change)


def test_the_saturated_end_of_an_exposure_ladder_is_wanted(folder: Path) -> None:
    saturate(folder, flats_of(folder, "left")[:2], exposure_s=0.0125)
    assert read(folder).warnings == ()


def test_full_well_short_of_the_white_level_is_the_end_of_a_ladder_too(folder: Path) -> None:
    saturate(folder, flats_of(folder, "left")[:2], exposure_s=0.0125, dn=3700)
    assert read(folder).warnings == ()


def test_saturated_where_the_ladder_predicts_less(folder: Path) -> None:
    saturate(folder, flats_of(folder, "left")[:2], exposure_s=0.009)
    lines = problems(folder)
    assert len(lines) == 2
    assert all("saturated flat" in line for line in lines)


def test_saturated_with_too_few_levels_below(folder: Path) -> None:
    saturate(folder, flats_of(folder, "left")[:1], exposure_s=0.0125)
    edit(
        folder,
        lambda m: m.update(
            captures=[c for c in m["captures"] if c["kind"] != "flat" or c["exposure_s"] in (0.002, 0.004, 0.0125)]
        ),
    )
    only(folder, "top-0", "3 unsaturated levels")


def test_saturated_flats_without_any_ladder(folder: Path) -> None:
    edit(
        folder, lambda m: m.update(captures=[c for c in m["captures"] if c["kind"] != "flat" or c["id"] == "flat-001"])
    )
    np.save(folder / "frames/flat-001.npy", np.full((24, 32), 4095, np.uint16))
    only(folder, "flat-001", "saturated flat", "expose shorter")


def test_clipped_channel_of_another_kind_is_only_remarked(folder: Path) -> None:
    frame = np.load(folder / "frames/narrowband-012.npy")
    frame[0::2, 0::2] = 4095
    np.save(folder / "frames/narrowband-012.npy", frame)
    (line,) = read(folder).warnings
    assert "1 narrowband captures of the left camera have a channel clipped" in line


# --- writing ------------------------------------------------------------------------------------------------------------


def test_a_refused_set_is_not_written(small_set: Callable[..., RecordingSet], tmp_path: Path) -> None:
    recordings = small_set()
    recordings._files.spectra.pop("spectra/lamp.csv")
    with pytest.raises(RecordingError, match=r"lamp\.csv"):
        write(recordings, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_a_failure_while_writing_leaves_nothing(
    small_set: Callable[..., RecordingSet], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> str:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("lab.formats.recording_set.writing.manifest_json", full)
    with pytest.raises(InputError, match="No space left"):
        write(small_set(), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_not_touched(small_set: Callable[..., RecordingSet], tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    write(small_set(), out)  # an empty one is taken
    with pytest.raises(InputError, match="already exists"):
        write(small_set(), out)


def test_a_set_whose_paths_leave_the_folder_is_not_written(tmp_path: Path) -> None:
    camera = {"rows": 2, "cols": 2, "cfa": "MONO", "bit_depth": 8}
    capture = {"id": "a", "kind": "dark", "side": "left", "frame": "../a.npy", "exposure_s": 0.1}
    manifest = Manifest.model_validate({"cameras": {"left": camera}, "captures": [capture]})
    with pytest.raises(InputError, match="leaves the folder"):
        write(RecordingSet(manifest, {"../a.npy": np.zeros((2, 2), np.uint16)}), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


# --- sets that others made ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["foreign_healthy", "foreign_two_effects"])
def test_foreign_sets_are_read_and_survive_a_copy(name: str, tmp_path: Path) -> None:
    if not (DATA / name).is_dir():
        pytest.skip("the shared data are not here")
    before = read(DATA / name)
    after = read(write(before, tmp_path / "copy"))
    assert after.manifest == before.manifest
    for capture in before.captures():
        np.testing.assert_array_equal(after.frame(capture), before.frame(capture))


def test_joined_sets_keep_apart_what_they_name_alike(small_set: Callable[..., RecordingSet]) -> None:
    """A set joined to itself with other frames: the later ids, paths and poses begin with the folder."""
    first = small_set()
    later = first.with_frames({c.frame: np.full_like(first.frame(c), 7) for c in first.captures()})
    both = first.joined(later, "resolve")
    n = len(first.captures())
    assert [c.id for c in both.captures()] == [c.id for c in first.captures()] + [
        f"resolve/{c.id}" for c in first.captures()
    ]
    for old, new in zip(first.captures(), both.captures()[n:], strict=True):
        np.testing.assert_array_equal(both.frame(both.capture(old.id)), first.frame(old))
        assert np.all(both.frame(new) == 7)
        told = old.model_dump(exclude_unset=True)
        for key in ("radiance", "light_radiance"):
            if told.get(key) is not None:
                assert both.spectrum(getattr(new, key)) == first.spectrum(told[key])
        if "screen" in told:
            assert new.screen.pose == f"resolve/{old.screen.pose}"
