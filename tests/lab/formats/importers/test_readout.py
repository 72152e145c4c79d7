"""Sensors of several taps with overscan: crop, black levels, and one line for each description that can't be."""

import re
from pathlib import Path

import numpy as np
import pytest

from lab.errors import InputError
from lab.formats import recording_set as recording
from lab.formats.importers import read_raw_folder

ROWS, COLS, WIDE = 40, 32, 8
BIAS = {"A": 100.25, "B": 137.75}
TAPS = f"""
[[taps]]
name = "A"
region = [0, 0, {ROWS}, {COLS}]
overscan = [0, {2 * COLS}, {ROWS}, {2 * COLS + WIDE}]
[[taps]]
name = "B"
region = [0, {COLS}, {ROWS}, {2 * COLS}]
overscan = [0, {2 * COLS + WIDE}, {ROWS}, {2 * COLS + 2 * WIDE}]
"""
LIGHT_DN = 500.0


def _folder(path: Path, camera: str = TAPS, frames: int = 6) -> Path:
    """Flats of 500 DN above each tap's bias; columns: tap A, tap B, overscan of A, overscan of B."""
    rng = np.random.default_rng(1)
    path.mkdir()
    rows = ["frame,kind,exposure_s"]
    for k in range(frames):
        lit = [BIAS[tap] + LIGHT_DN + rng.normal(0.0, 5.0, (ROWS, COLS)) for tap in "AB"]
        bias = [BIAS[tap] + rng.normal(0.0, 2.0, (ROWS, WIDE)) for tap in "AB"]
        np.save(path / f"f{k}.npy", np.rint(np.hstack([*lit, *bias])).astype(np.uint16))
        rows.append(f"f{k}.npy,flat,0.1")
    (path / "index.csv").write_text("\n".join(rows) + "\n")
    (path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 12\n' + camera)
    return path


def test_taps_are_cropped_and_brought_to_one_black_level(tmp_path: Path) -> None:
    """Overscan means: sigma sqrt(4 + 1/12) / sqrt(6 x 320) = 0.046 DN each. The difference of 37.5 DN is a whole 37 or
    38."""
    read = read_raw_folder(_folder(tmp_path / "in"))
    recordings = recording.read(recording.write(read, tmp_path / "out"))
    camera = recordings.camera("left")
    assert (camera.rows, camera.cols) == (ROWS, 2 * COLS)
    frame = np.mean([recordings.frame(c) for c in recordings.captures()], axis=0)
    left, right = frame[:, :COLS].mean(), frame[:, COLS:].mean()
    shift = round(right - BIAS["B"] - LIGHT_DN)
    assert shift in (-37, -38)
    assert camera.black_level_dn == pytest.approx(0.5 * (BIAS["A"] + BIAS["B"] + shift), abs=4 * 0.046)
    # noise of a tap's mean: 5 / sqrt(6 x 1280) = 0.057 DN
    assert left - BIAS["A"] == pytest.approx(LIGHT_DN, abs=4 * 0.057)
    assert right - BIAS["B"] - shift == pytest.approx(LIGHT_DN, abs=4 * 0.057)
    assert any("tap B: overscan of 6 frames 137.7" in text for text in read.warnings)
    assert any(re.search(r"they still differ by 0\.[45]", text) for text in read.warnings)


BETWEEN = f"""
[[taps]]
name = "A"
region = [0, {WIDE}, {ROWS}, {WIDE + COLS}]
overscan = [0, {WIDE + COLS}, {ROWS}, {2 * WIDE + COLS}]
[[taps]]
name = "B"
region = [0, {3 * WIDE + COLS}, {ROWS}, {3 * WIDE + 2 * COLS}]
overscan = [0, {2 * WIDE + COLS}, {ROWS}, {3 * WIDE + COLS}]
"""


def _between(path: Path) -> Path:
    """The frames of `_folder` with the overscan between the taps, after a margin of no use; their image is its columns,
    numbered."""
    path.mkdir()
    lit = 500 + np.tile(np.arange(2 * COLS), (ROWS, 1))
    for k in range(2):
        parts = (
            np.full((ROWS, WIDE), 7),
            lit[:, :COLS],
            np.full((ROWS, WIDE), 100),
            np.full((ROWS, WIDE), 130),
            lit[:, COLS:] + 30,
        )
        np.save(path / f"f{k}.npy", np.hstack(parts).astype(np.uint16))
    (path / "index.csv").write_text("frame,kind,exposure_s\nf0.npy,flat,0.1\nf1.npy,flat,0.1\n")
    (path / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 12\n' + BETWEEN)
    return path


def test_overscan_between_taps_is_cut_out_and_the_rest_joined(tmp_path: Path) -> None:
    read = read_raw_folder(_between(tmp_path / "in"))
    recordings = recording.read(recording.write(read, tmp_path / "out"))
    assert recordings.camera("left").black_level_dn == 100.0
    frame = recordings.frame(recordings.captures()[0])
    np.testing.assert_array_equal(frame, 500 + np.tile(np.arange(2 * COLS), (ROWS, 1)))
    assert any("cut out and the rest joined: column 40..55" in text for text in read.warnings)


def test_columns_between_taps_that_are_no_overscan_are_refused(tmp_path: Path) -> None:
    folder = _between(tmp_path / "in")
    camera = folder / "camera.toml"
    camera.write_text(
        camera.read_text().replace(f"overscan = [0, {2 * WIDE + COLS}, ", f"overscan = [0, {2 * WIDE + COLS + 1}, ")
    )
    with pytest.raises(InputError, match=r"column 40\.\.55 belongs to no region, and isn't all overscan"):
        read_raw_folder(folder)


def test_one_tap_alone_keeps_its_codes(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "in")
    recordings = read_raw_folder(folder, tap="B")
    camera = recordings.camera("left")
    assert (camera.rows, camera.cols) == (ROWS, COLS)
    assert camera.black_level_dn == pytest.approx(BIAS["B"], abs=4 * 0.046)
    first = recordings.frame(recordings.captures()[0])
    np.testing.assert_array_equal(first, np.load(folder / "f0.npy")[:, COLS : 2 * COLS])
    with pytest.raises(InputError, match=r"--tap C: .* no such tap of the left camera; it has A, B"):
        read_raw_folder(folder, tap="C")


def test_a_stated_black_level_stands_for_an_overscan(tmp_path: Path) -> None:
    stated = f'[[taps]]\nname = "A"\nregion = [0, 0, {ROWS}, {COLS}]\nblack_level_dn = 100.25\n'
    recordings = read_raw_folder(_folder(tmp_path / "in", stated))
    assert recordings.camera("left").black_level_dn == 100.25
    assert recordings.camera("left").cols == COLS


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (f"{2 * COLS + 2 * WIDE}]", f"{2 * COLS + 3 * WIDE}]", ("tap B: overscan [0, 72, 40, 88] isn't inside the "
            "frame of 40 x 80")),
        (f"region = [0, {COLS}, ", f"region = [0, {COLS + 2}, ", ("leave gaps: column 32..33 belongs to no region, and "
            "isn't all overscan")),
        (f"region = [0, {COLS}, ", f"region = [0, {COLS - 2}, ", "leave gaps or overlap"),
        (f"overscan = [0, {2 * COLS}, ", f"overscan = [0, {2 * COLS - 4}, ", "holds pixels of a tap's region"),
        ('name = "B"', 'name = "A"', "two have one name"),
        ('name = "B"\n', "", "name"),
        (f"overscan = [0, {2 * COLS}, {ROWS}, {2 * COLS + WIDE}]\n", "", "neither overscan nor black_level_dn"),
    ],
)  # fmt: skip
def test_what_cannot_be_a_readout_is_refused_in_one_line(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in TAPS
    with pytest.raises(InputError) as caught:
        read_raw_folder(_folder(tmp_path / "in", TAPS.replace(old, new, 1)))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_bias_that_moves_is_told(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "in")
    warm = np.load(folder / "f5.npy")
    np.save(folder / "f5.npy", warm + np.uint16(3))
    said = [text for text in read_raw_folder(folder).warnings if "which changes by" in text]
    assert len(said) == 2
