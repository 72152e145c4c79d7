"""The pages that add an effect and a measurement, to the letter: their files run, with their tests."""

from __future__ import annotations

import re
import sys
from dataclasses import fields
from pathlib import Path
from types import ModuleType

import pytest

from sim.effects.base import Effect
from sim.parameters import Quantity

HOW_TO = Path(__file__).resolve().parents[1] / "docs" / "how-to"


def blocks(page: str) -> list[str]:
    """The Python files of a page, in their order."""
    return re.findall(r"```python\n(.*?)```", (HOW_TO / page).read_text(encoding="utf-8"), re.DOTALL)


def module(name: str, source: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """`source` as the module of that name, while the test runs."""
    made = ModuleType(name)
    monkeypatch.setitem(sys.modules, name, made)
    exec(compile(source, name, "exec"), vars(made))
    return made


@pytest.mark.parametrize(
    ("page", "name"),
    [
        ("add-an-effect.md", "sim.effects.notch_filter"),
        ("add-a-measurement.md", "lab.observables.darks.dark_halves"),
    ],
)
def test_the_file_and_its_tests_run_as_they_stand(page: str, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    written, tests = blocks(page)
    module(name, written, monkeypatch)
    found = {
        key: one for key, one in vars(module(f"tests.{name}", tests, monkeypatch)).items() if key.startswith("test_")
    }
    assert found
    for test in found.values():
        test()


def test_what_an_effect_declares_is_named_as_in_the_code() -> None:
    page = (HOW_TO / "add-an-effect.md").read_text(encoding="utf-8")
    of_quantity = re.findall(r"^\| `(\w+)` of a `Quantity`", page, re.MULTILINE)
    assert of_quantity
    assert set(of_quantity) <= {one.name for one in fields(Quantity)}
    table = page.split("What each part is for:")[1].split("These are all")[0]
    of_effect = re.findall(
        r"`(\w+)`", " ".join(row.split("|")[1] for row in table.splitlines() if row.startswith("| `"))
    )
    declared = {*dir(Effect), *Effect.__annotations__, *of_quantity, "Quantity"}
    assert set(of_effect) <= declared
