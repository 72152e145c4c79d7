"""What recordings the comparison of engines takes."""

from __future__ import annotations

import pytest

from evaluation.engines import recordings_named
from lab.errors import InputError


@pytest.mark.parametrize(
    "name", ["own:x", "own:", "former:healthy", "former:healthy:1:2", "former:defocus:0:strong:21"]
)
def test_a_name_without_its_numbers_is_refused_with_an_example(name: str) -> None:
    with pytest.raises(InputError, match=r"give numbers, as former:defocus:0:1\.5:21"):
        recordings_named(name)


def test_an_unknown_law_is_refused_with_those_that_are_known() -> None:
    with pytest.raises(InputError, match=r"choose one of absorption_band, .*defocus"):
        recordings_named("former:nolaw:0:1.5:21")


def test_a_law_and_a_healthy_camera_are_drawn_from_the_same_seed() -> None:
    healthy, concealed = (recordings_named(name) for name in ("former:healthy:21", "former:defocus:0:1.5:21"))
    assert len(healthy.captures()) == len(concealed.captures()) > 20
