"""The first screen's charts as static SVG: in place, in range, well-formed."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree

import pytest

from lab.report import charts
from lab.report.answers import proofs
from lab.report.stills import LEFT, RIGHT, WIDTH, still


def numbers(path: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?[0-9.]+", path)]


def drawn(figure: charts.Figure) -> ElementTree.Element:
    return ElementTree.fromstring(str(still(figure, 0)).replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1))


def texts(svg: ElementTree.Element) -> list[str]:
    return [found.text or "" for found in svg.iter() if found.tag.endswith("text")]


def simple(**more: Any) -> charts.Figure:
    trace = {
        "mode": "lines",
        "name": "a < b",
        "x": [0.0, 5.0, None, 10.0],
        "y": [0.0, 1.0, 2.0, -2.0],
        "line": {"color": "@fg", "width": 1},
    }
    layout = charts.layout(
        330, xaxis=charts.axis("x", range=[0.0, 10.0]), yaxis=charts.axis("y<br>z", range=[-4.0, 4.0])
    )
    return {"data": [trace | more], "layout": layout}


def test_values_stand_where_the_axes_say() -> None:
    svg = drawn(simple())
    (line,) = (one for one in svg.iter() if "clip-path" in one.attrib for one in one)
    x0, y0, x1, y1, x2, y2 = numbers(line.attrib["d"])
    # written with one decimal: within 0.05
    assert (x0, x2) == pytest.approx((LEFT, WIDTH - RIGHT), abs=0.06)
    assert x1 == pytest.approx((x0 + x2) / 2, abs=0.11)
    assert y0 - y1 == pytest.approx((y2 - y0) / 2, abs=0.16)  # 1 up, 2 down
    assert {"a < b", "x", "y", "z", "0", "10", "\N{MINUS SIGN}2"} <= set(texts(svg))


def test_error_bars_open_markers_and_names_of_points() -> None:
    figure = simple(
        mode="markers",
        marker={"color": "#123456", "size": 6, "symbol": "circle-open"},
        error_y={"array": [1.0, None, 1.0, 2.0]},
    )
    figure["layout"]["xaxis"] |= {"tickvals": [0.0, 10.0], "ticktext": ["dark skin", "white & grey"]}
    svg = drawn(figure)
    bars, rings = (one.attrib["d"] for group in svg.iter() if "clip-path" in group.attrib for one in group)
    assert bars.count("M") == 2 and rings.count("M") == 3
    (x, low, high, *_) = numbers(bars)
    assert x == pytest.approx(LEFT, abs=0.06) and low > high  # upwards is less
    assert {"dark skin", "white & grey"} <= set(texts(svg))


@pytest.mark.parametrize("diagnosed", [True, False])
def test_every_chart_of_the_first_screen_has_one(made_up: Callable[..., Any], diagnosed: bool) -> None:
    fit, _, diagnosis = made_up()
    shown = proofs(fit, diagnosis if diagnosed else None)
    assert shown
    for proof in shown:
        svg = drawn(proof.figure)
        named = {trace["name"] for trace in proof.figure["data"] if trace.get("showlegend", True)}
        assert named <= set(texts(svg)) and len(still(proof.figure, 0)) < 40_000
        assert "nan" not in still(proof.figure, 0) and "inf" not in still(proof.figure, 0)


@pytest.mark.parametrize("stated", [[1.0, 1.0], [float("nan"), float("nan")], None])
@pytest.mark.parametrize("values", [[3.0] * 4, [0.0] * 4, [float("nan")] * 4, [None] * 4, [1e-30, 2e-30, 0.0, 1e-30]])
def test_values_without_a_range_are_drawn_all_the_same(stated: list[float] | None, values: list[float]) -> None:
    figure = simple(mode="markers", y=values, marker={"color": "@fg", "size": 4}, error_y={"array": [float("nan")] * 4})
    figure["layout"]["yaxis"] = charts.axis("y") | ({"range": stated} if stated is not None else {})
    assert "nan" not in (text := still(figure, 0)) and "inf" not in text
