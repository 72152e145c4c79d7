"""Drivers are found by family and name, built in or installed."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from drivers import registry
from drivers.errors import InstrumentError
from drivers.instrument import Instrument
from drivers.monochromator.cornerstone260 import Cornerstone260


def test_every_built_in_driver_can_be_loaded() -> None:
    for family in ("monochromator", "spectroradiometer", "display", "stage", "camera"):
        assert registry.names(family)
        for name in registry.names(family):
            assert issubclass(registry.driver(family, name), Instrument)  # type: ignore[arg-type]
    assert registry.driver("monochromator", "cornerstone260") is Cornerstone260


def test_an_unknown_driver_is_refused_with_what_there_is() -> None:
    with pytest.raises(InstrumentError, match=r"no driver 'cs999'; installed are .*cornerstone260"):
        registry.driver("monochromator", "cs999")


def test_an_installed_driver_is_found_and_a_broken_one_named(monkeypatch: pytest.MonkeyPatch) -> None:
    ours = EntryPoint("stage.carousel", "drivers.stage.prompt:PromptStage", registry.GROUP)
    broken = EntryPoint("stage.lost", "no_such_package:Stage", registry.GROUP)
    monkeypatch.setattr(registry, "entry_points", lambda group: [ours, broken])
    assert registry.driver("stage", "carousel").__name__ == "PromptStage"
    with pytest.raises(InstrumentError, match="can't be loaded: No module named 'no_such_package'"):
        registry.driver("stage", "lost")


def test_every_family_has_an_extra_with_those_of_its_drivers() -> None:
    """`pip install calibench[FAMILY]` brings what a driver's message may ask for."""
    root = Path(__file__).parents[2]
    extras = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    for family in {family for family, _ in registry.drivers()}:
        text = "\n".join(file.read_text(encoding="utf-8") for file in (root / "drivers" / family).glob("*.py"))
        asked = set(re.findall(r"calibench with its extra (\w+)", text))
        brought = {name for line in extras[family] for name in re.findall(r"[\w]+", line.partition("[")[2])}
        assert asked <= brought, family
