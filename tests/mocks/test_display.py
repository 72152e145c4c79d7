"""The mock page's grammar."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocks.display import Page
from mocks.lamp import Lamp

SHOW = {"type": "show", "id": 5, "rows": 2, "cols": 3, "cell_px": 4}


class Screen:
    def __init__(self) -> None:
        self.pattern: np.ndarray | None = None
        self.cell_px = 0

    def show(self, pattern: np.ndarray | None, cell_px: int = 1) -> None:
        self.pattern, self.cell_px = pattern, cell_px


def test_a_request_and_its_cells_are_shown_and_confirmed() -> None:
    screen = Screen()
    page = Page(screen, rows=100, cols=200, device_pixel_ratio=2)
    geometry = {"device_pixel_ratio": 2, "canvas_px": [100, 200], "screen_px": [100, 200]}
    assert [json.loads(said) for said in page.opened()] == [
        {"type": "page", "user_agent": "calibench mock display", **geometry}
    ]
    assert page.receive(json.dumps(SHOW)) == []
    assert [json.loads(said) for said in page.receive(bytes([0, 1, 0, 1, 0, 1]))] == [
        {"type": "shown", "id": 5, "cell_px": 4, **geometry}
    ]
    assert screen.pattern is not None
    np.testing.assert_array_equal(screen.pattern, [[0, 1, 0], [1, 0, 1]])
    assert screen.cell_px == 4


@pytest.mark.parametrize("size", [{"rows": 26}, {"cols": 51}, {"cell_px": 51}])
def test_what_does_not_fit_is_refused(size: dict[str, int]) -> None:
    page = Page(Lamp(), rows=100, cols=200)
    page.receive(json.dumps(SHOW | size))
    (said,) = page.receive(b"\1" * 6)
    assert json.loads(said)["type"] == "refused"


MESSAGES = st.one_of(
    st.text(max_size=30),
    st.binary(max_size=30),
    st.dictionaries(st.sampled_from(list(SHOW)), st.one_of(st.integers(-3, 300), st.none(), st.text(max_size=4))).map(
        json.dumps
    ),
    st.just(json.dumps(SHOW)),
)


@given(st.lists(MESSAGES, max_size=10))
def test_no_message_upsets_the_page(messages: list[str | bytes]) -> None:
    page = Page(Lamp())
    page.opened()
    for message in messages:
        page.receive(message)
    page.receive(json.dumps(SHOW))
    assert json.loads(page.receive(b"\0" * 6)[0])["type"] == "shown"
