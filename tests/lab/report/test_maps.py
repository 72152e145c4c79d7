"""Maps of single pixels as files: they hold the fitted values, and undetermined ones are left out."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from lab.cli import main
from lab.errors import InputError
from lab.fit.noise.pixel_maps import PixelMaps
from lab.formats.recording_set import Manifest, RecordingSet, write
from lab.report.pictures import map_picture, write_maps

SHAPE = (24, 40)


def maps(**changes: object) -> PixelMaps:
    row, col = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    bad = np.zeros(SHAPE, bool)
    bad[10, 20] = True
    known = {
        "offset_dn": 64.0 + row,
        "offset_dn_std": np.full(SHAPE, 0.5),
        "dark_dn_per_s": None,
        "dark_dn_per_s_std": None,
        "gain": 1.0 + 0.001 * col,
        "gain_std": np.full(SHAPE, 0.002),
        "defective": bad,
    }
    return PixelMaps(**(known | changes))  # type: ignore[arg-type]


def test_what_is_written_is_what_was_found(tmp_path: Path) -> None:
    found = maps()
    names = write_maps(tmp_path / "new" / "left", found)
    assert set(names) == {path.name for path in (tmp_path / "new" / "left").iterdir()}
    assert not any("dark" in name for name in names)
    for name in ("offset_dn", "offset_dn_std", "gain", "gain_std"):
        stored = np.load(tmp_path / "new" / "left" / f"{name}.npy")
        assert stored.dtype == np.float32
        assert np.allclose(stored, getattr(found, name), rtol=1e-6)
    assert np.array_equal(np.load(tmp_path / "new" / "left" / "defective.npy"), found.defective)
    said = json.loads((tmp_path / "new" / "left" / "maps.json").read_text())
    assert said["defective"]["pixels"] == 1 and said["offset_dn"]["unit"] == "DN"
    dots = cv2.imread(str(tmp_path / "new" / "left" / "defective.png"), cv2.IMREAD_GRAYSCALE)
    assert dots is not None and dots.shape == SHAPE and np.count_nonzero(dots) == 9
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="can't be written"):
        write_maps(tmp_path / "file", found)


def test_pictures_go_from_dark_to_bright_over_98_percent_of_the_pixels() -> None:
    values = np.arange(1000.0).reshape(20, 50)
    picture, low, high = map_picture(values)
    assert (low, high) == pytest.approx((9.99, 989.01))
    luminance = picture.astype(int).sum(axis=2)
    assert picture.shape == (20, 50, 3) and luminance[0, 0] < luminance[-1, -1]
    assert map_picture(values, 25)[0].shape == (10, 25, 3)


def test_the_command_writes_them_and_says_where_there_are_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(1)
    captures, frames = [], {}
    for side, kinds in (("left", {0.01: "dark", 1.0: "dark"}), ("right", {0.02: "flat", 0.05: "flat"})):
        for exposure_s, kind in kinds.items():
            for _ in range(2):
                name = f"frames/{len(captures)}.npy"
                captures.append(
                    {"id": str(len(captures)), "kind": kind, "side": side, "frame": name, "exposure_s": exposure_s}
                )
                frames[name] = np.rint(100.0 + 20.0 * exposure_s + 3.0 * rng.standard_normal(SHAPE)).astype(np.uint16)
    camera = {"rows": SHAPE[0], "cols": SHAPE[1], "cfa": "MONO", "bit_depth": 12}
    manifest = Manifest.model_validate({"cameras": {"left": camera, "right": camera}, "captures": captures})
    folder = write(RecordingSet(manifest, frames), tmp_path / "set")
    assert main(["fit", str(folder), "--json", "-", "--maps", str(tmp_path / "maps")]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["format"] == "calibench-fit"
    assert "offset_dn.npy" in said.err and "maps (right): none: no darks" in " ".join(said.err.split())
    rate = np.load(tmp_path / "maps" / "left" / "dark_dn_per_s.npy")
    # 3 DN of noise, two frames at either end of 1 s: 3 DN/s a pixel, 0.1 over all; three of these.
    assert rate.mean() == pytest.approx(20.0, abs=3 * 3.0 / np.sqrt(rate.size))
    assert not (tmp_path / "maps" / "right").exists()
