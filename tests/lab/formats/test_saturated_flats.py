"""Flats that are saturated where their ladder says less, and those at its wanted end."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from lab.formats.recording_set import read
from tests.lab.formats.damaged_sets import edit, only, problems

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
