"""Darks that are brighter than flats, and frames that are moved against their rows."""

import numpy as np
import pytest

from lab.errors import InputError
from lab.formats import recording_set as recording
from lab.formats.recording_set import Manifest, RecordingSet, inspect

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
    recording.write(_set(IN_ORDER[1:]), f"{tmp_path}/out", told=told.extend)
    assert any("moved by one row" in line for line in told)
    assert any("moved by one row" in line for line in recording.read(f"{tmp_path}/out").warnings)
