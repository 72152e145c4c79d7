"""The examples of docstrings run; those of the public interface run in tests/calibench/test_examples.py."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("api", "drivers", "lab", "mocks", "sim")
#: Modules whose examples need recordings, or a process of their own.
INTERFACE = (
    "api.client",
    "api.local_service",
    "lab.formats.recording_set.folder",
    "lab.interface",
    "lab.report.plots",
)


def modules_with_examples() -> list[str]:
    """Return the names of the modules with an example, in order."""
    files = (file for package in PACKAGES for file in (ROOT / package).rglob("*.py"))
    paths = (file.relative_to(ROOT).with_suffix("") for file in files if "    >>> " in file.read_text(encoding="utf-8"))
    return sorted({".".join(path.parts).removesuffix(".__init__") for path in paths} - set(INTERFACE))


@pytest.mark.parametrize("name", modules_with_examples())
def test_the_examples_of_a_module_run(name: str) -> None:
    outcome = doctest.testmod(importlib.import_module(name))
    assert outcome.attempted > 0
    assert outcome.failed == 0
