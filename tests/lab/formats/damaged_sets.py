"""A recording set on disk, to be damaged, and what is then said of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lab.formats.recording_set import RecordingError, read


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    file = folder / "manifest.json"
    manifest = json.loads(file.read_text())
    change(manifest)
    file.write_text(json.dumps(manifest))


def problems(folder: Path) -> tuple[str, ...]:
    with pytest.raises(RecordingError) as caught:
        read(folder)
    assert caught.value.exit_code == 2
    assert all("\n" not in line and ";" in line for line in caught.value.problems), "one line each, with a remedy"
    return caught.value.problems


def only(folder: Path, *words: str) -> None:
    """The folder is refused with exactly one line, and that line says all of `words`."""
    lines = problems(folder)
    assert len(lines) == 1, lines
    for word in words:
        assert word in lines[0], lines[0]
