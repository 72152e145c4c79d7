"""The page of a comparison: every number of the result on it, the limit drawn, and the vectors where they belong."""

from __future__ import annotations

from pathlib import Path

import pytest

from lab.errors import InputError
from lab.formats.results import Change, ComparisonResult, ProjectionChange, Skipped
from lab.report.compare import projection_vectors, render_comparison, significances, write_comparison
from tests.lab.report.test_report import Page


def change(name: str, sigma: float, changed: bool, **more: object) -> Change:
    known = {"a": 1.0, "a_std": 0.1, "b": 1.5, "b_std": 0.1, "difference": 0.5, "difference_std": 0.14}
    return Change.model_validate(known | {"name": name, "significance_sigma": sigma, "changed": changed, **more})


MOVED = ProjectionChange(
    side="left",
    as_stated_px=2.0,
    implied_turn_mrad=(0.1, -1.2, 0.0),
    implied_shift_mm=(0.0, 0.1, 0.0),
    difference_px=0.05,
    expected_px=0.01,
    significance_sigma=5.0,
    changed=True,
    x_px=(0.0, 50.0, 99.0),
    y_px=(0.0, 79.0),
    vectors_px=(((0.1, 0.0), (0.1, 0.0), (0.1, 0.0)), ((0.1, 0.0), (0.1, 0.0), (0.1, 0.0))),
)
RESULT = ComparisonResult(
    a="before<b>.json",
    b="after.json",
    false_alarm_rate=0.01,
    threshold_sigma=3.9,
    changes=(
        change("noise read_noise_e", 7.25, True, side="left", title="temporal dark noise (read noise)", unit="e"),
        change("mtf edge-1 mtf", 0.4, False, side="left", n=26, where="frequency 0.25 cy/px"),
    ),
    projection=(MOVED,),
    skipped=(Skipped(step="stereo", reason="only A has it"),),
)


def test_the_page_says_what_the_result_says() -> None:
    page = Page(render_comparison(RESULT))
    text = " ".join(page.words)
    assert "2 of 3 changed" in text and "3.9 sigma" in text and "1 % of all comparisons" in text
    assert "temporal dark noise (read noise)" in text and "7.2" in text and "worst of 26" in text
    assert "0.0500 px rms difference" in text and "-1.200" in text
    assert "only A has it" in text
    assert "before<b>.json" in text  # as text, not as an element
    assert not [address for address in page.addresses if not address.startswith("data:")]
    assert len(page.figures) == 2


def test_unchanged_rows_are_folded() -> None:
    page = render_comparison(RESULT)
    before, folded = page.split("<details>")
    assert "Changed: 1 of 2" in before and "noise read_noise_e" in before
    assert "mtf edge-1 mtf" not in before.partition("<h2>Numbers")[2].partition("<script")[0].replace("charts", "")
    assert "Unchanged: 1 of 2" in folded and 'title="mtf edge-1 mtf"' in folded
    same = RESULT.model_copy(update={"changes": RESULT.changes[1:]})
    assert "<h3>Changed" not in render_comparison(same)


def test_bars_are_in_order_and_the_limit_is_where_it_is() -> None:
    figure = significances(RESULT)
    assert figure is not None
    (bars,) = figure["data"]
    assert bars["x"] == [0.4, 7.25]  # from below
    assert figure["layout"]["shapes"][0]["x0"] == 3.9
    assert significances(RESULT.model_copy(update={"changes": ()})) is None


def test_vectors_stand_on_the_grid_and_are_enlarged_as_said() -> None:
    lines, dots = projection_vectors(MOVED)["data"]
    assert dots["x"] == [0.0, 50.0, 99.0] * 2 and dots["y"] == [0.0] * 3 + [79.0] * 3
    # 0.1 px drawn as at most 2.5 % of 100 columns: 20 times is the largest round number.
    assert "20 times" in lines["name"]
    assert lines["x"][:2] == [0.0, 2.0] and lines["y"][:2] == [0.0, 0.0]


def test_nothing_in_common_still_makes_a_page_and_a_bad_place_one_line(tmp_path: Path) -> None:
    empty = RESULT.model_copy(update={"changes": (), "projection": ()})
    file = write_comparison(tmp_path / "new", empty)
    assert "No quantity is stated with an uncertainty by both" in file.read_text(encoding="utf-8")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="can't be written"):
        write_comparison(tmp_path / "file", empty)
