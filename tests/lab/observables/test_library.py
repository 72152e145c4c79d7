"""Measurements are found where they are declared, once each, in the order of the report."""

from __future__ import annotations

import pytest

from lab.observables.darks import level as dark_level
from lab.observables.observable import measurement_title, measurements
from tests.lab.diagnose.on_blocks import declared


def test_every_declaration_is_complete_and_has_a_place_of_its_own() -> None:
    found = measurements()
    assert [one.order for one in found] == sorted({one.order for one in found})
    assert len({one.title for one in found}) == len(found)
    assert all(one.name.isidentifier() and one.title and one.axis and one.unit for one in found)
    assert found[0].name == "dark"
    assert found[-1].name == "stereo_time"


def test_a_measurement_that_is_gone_is_titled_by_its_name() -> None:
    assert measurement_title("slanted_edge") == "transfer function of slanted edges"
    assert measurement_title("no_longer_there") == "no longer there"


def test_two_of_one_name_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dark_level, "TWIN", declared("slanted_edge", "field", "1"), raising=False)
    with pytest.raises(ValueError, match="two measurements are named 'slanted_edge'"):
        measurements.__wrapped__()
