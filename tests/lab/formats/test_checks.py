"""Sets that contradict themselves: order of levels, saturated flats, damaged files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from lab.errors import InputError
from lab.formats import recording_set as recording
from lab.formats.recording_set import Manifest, RecordingSet, inspect, read
from tests.lab.formats.damaged_sets import edit, only, problems

SHAPE, BLACK_DN, DN_PER_S, READ_DN = (16, 24), 64.0, 4.0e4, 2.0
FLATS_S = (0.01, 0.015, 0.02, 0.03, 0.04, 0.06)


def _set(
    order: list[int], *, darks_s: tuple[float, ...] = (0.01, 0.01), swap: tuple[str, str] | None = None
) -> RecordingSet:
    """Two darks and two flats of each exposure. `order`: the frame of each row, by the place at which it was taken.
    `swap`: kinds to exchange."""
    rng = np.random.default_rng(5)
    rows = [("dark", exposure_s) for exposure_s in darks_s] + [("flat", s) for s in FLATS_S for _ in range(2)]
    levels = [BLACK_DN + (DN_PER_S * exposure_s if kind == "flat" else 0.0) for kind, exposure_s in rows]
    taken = [np.rint(rng.normal(level, READ_DN, SHAPE)).astype(np.uint16) for level in levels]
    names = dict([swap, swap[::-1]]) if swap is not None else {}
    captures = [
        {
            "id": f"c{k}",
            "kind": names.get(kind, kind),
            "side": "left",
            "frame": f"frames/{k}.npy",
            "exposure_s": exposure_s,
        }
        for k, (kind, exposure_s) in enumerate(rows)
    ][: len(order)]
    camera = {"rows": SHAPE[0], "cols": SHAPE[1], "cfa": "MONO", "bit_depth": 12, "black_level_dn": BLACK_DN}
    manifest = Manifest.model_validate({"cameras": {"left": camera}, "captures": captures})
    return RecordingSet(manifest, {f"frames/{k}.npy": taken[at] for k, at in enumerate(order)})


ROWS = 2 + 2 * len(FLATS_S)
IN_ORDER = list(range(ROWS))


def _told(recordings: RecordingSet) -> tuple[list[str], list[str]]:
    problems, warnings = inspect(recordings)
    return problems, [line for line in warnings if "row" in line or "dark" in line]


def test_nothing_is_told_of_a_set_in_order() -> None:
    assert _told(_set(IN_ORDER)) == ([], [])
    assert _told(_set(IN_ORDER, darks_s=(5.0, 100.0))) == ([], [])  # longer than the flats: they may be anything


def test_exchanged_kinds_are_refused(tmp_path: object) -> None:
    problems, _ = _told(_set(IN_ORDER, swap=("dark", "flat")))
    (line,) = problems
    assert "darks and flats are exchanged; correct their kinds" in line
    assert (
        "as 4 of 4 pairs do" in line
    )  # flats of 0.01 s are the frames of two darks; darks of 0.01 s those of two flats
    with pytest.raises(InputError, match="darks and flats are exchanged"):
        recording.write(_set(IN_ORDER, swap=("dark", "flat")), f"{tmp_path}/out")


def test_light_in_a_dark_is_told() -> None:
    """The second dark is a flat of 0.06 s: 2464 DN, more than any other. 13 of 26 pairs contradict at most, of its own
    all."""
    problems, (line,) = _told(_set([0, ROWS - 1, *IN_ORDER[2:]]))
    assert problems == []
    assert "light in 1 of 2 darks (c1); correct their kind or take them out" in line


@pytest.mark.parametrize(
    ("order", "row", "where"),
    [
        (IN_ORDER[1:], "capture c0", "below"),
        ([0, *IN_ORDER[:-1]], "capture c1", "above"),
        ([*IN_ORDER[:6], *IN_ORDER[7:]], "capture c7", "below"),
    ],
)
def test_frames_moved_by_one_row_are_told(order: list[int], row: str, where: str) -> None:
    """By all rows, and from one row on: a frame was lost. Rows whose neighbour has the same light don't tell where it
    begins."""
    problems, (line,) = _told(_set(order))
    assert problems == []
    assert f"({row})" in line
    assert f"frames have the levels of the rows {where} theirs" in line


def test_one_frame_in_a_wrong_place_is_no_move() -> None:
    order = IN_ORDER.copy()
    order[4], order[8] = order[8], order[4]
    assert _told(_set(order)) == ([], [])


def test_the_checks_are_told_by_writing(tmp_path: object) -> None:
    told: list[str] = []
    recording.write(_set(IN_ORDER[1:]), f"{tmp_path}/out", report_warnings=told.extend)
    assert any("moved by one row" in line for line in told)
    assert any("moved by one row" in line for line in recording.read(f"{tmp_path}/out").warnings)


# --- Flats that are saturated where their ladder says less, and those at its wanted end -------------------------------


# --- saturated flats --------------------------------------------------------------------------------------------------


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
    """A series of exposures is meant to end in saturation: nothing is reported."""
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


# --- full well below the converter's range, whose read noise spreads the pixels over codes ----------------------------


def ladder(
    folder: Path, exposures_s: tuple[float, ...], full_well_dn: float, stated: dict[float, float] | None = None
) -> None:
    """Replaces the left camera's flats by three repeats of each exposure: 200 DN a ms, photon noise, a full well, 2 DN
    of read noise.

    Red has twice the light of the others. The lamp's radiance is read anew, within 0.03 %, with each repeat.
    `stated`: exposure that the manifest states for one of the exposures.
    """
    rng = np.random.default_rng(4)
    lamp = (folder / "spectra/lamp.csv").read_text().splitlines()

    def change(manifest: dict[str, Any]) -> None:
        first = next(c for c in manifest["captures"] if c["kind"] == "flat" and c["side"] == "left")
        manifest["captures"] = [c for c in manifest["captures"] if (c["kind"], c["side"]) != ("flat", "left")]
        for level, exposure_s in enumerate(exposures_s):
            for repeat in range(3):
                signal = np.full((24, 32), 200e3 * exposure_s / 2)
                signal[0::2, 0::2] *= 2
                signal = np.minimum(rng.normal(signal, np.sqrt(0.3 * signal)), full_well_dn)
                name = f"ladder-{level}-{repeat}"
                np.save(
                    folder / f"frames/{name}.npy",
                    np.clip(rng.normal(64 + signal, 2.0), 0, 4095).round().astype(np.uint16),
                )
                rows = [f"{x},{float(y) * (1 + 3e-4 * repeat)}" for x, y in (row.split(",") for row in lamp[1:])]
                (folder / f"spectra/lamp-{repeat}.csv").write_text("\n".join([lamp[0], *rows]))
                manifest["captures"].append(
                    first
                    | {"id": name, "frame": f"frames/{name}.npy", "radiance": f"spectra/lamp-{repeat}.csv"}
                    | {"exposure_s": (stated or {}).get(exposure_s, exposure_s)}
                )

    edit(folder, change)


MS = (1e-3, 2e-3, 4e-3, 6e-3, 8e-3, 10e-3, 12e-3, 14e-3)


def test_a_level_at_the_full_well_contradicts_no_stated_light(folder: Path) -> None:
    # Red reaches 3000 DN at 15 ms: at 24 ms it has two thirds of what its light says
    ladder(folder, (*MS, 24e-3), full_well_dn=3000.0)
    assert read(folder).warnings == ()


def test_a_stated_light_that_the_full_well_does_not_explain_is_one_line(folder: Path) -> None:
    ladder(folder, MS, full_well_dn=3500.0, stated={14e-3: 28e-3})
    (line,) = read(folder).warnings
    assert "capture ladder-7-0" in line
    assert "3 flats of a stated light" in line


def test_the_full_well_with_too_little_light_stated(folder: Path) -> None:
    ladder(folder, (*MS, 24e-3), full_well_dn=3000.0, stated={24e-3: 3e-3})
    (line,) = read(folder).warnings
    assert "capture ladder-8-0" in line


# --- Frames, spectra and targets of a recording set that can't be used: one line each, and nothing is lost ------------


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
