"""Frames, spectra and targets of a recording set that can't be used: one line each, and nothing is lost."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from lab.formats.recording_set import read
from tests.lab.formats.damaged_sets import edit, only, problems

# --- what is refused: damaged files -----------------------------------------------------------------------------------


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
