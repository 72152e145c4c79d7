"""A small recording set in a folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from lab.formats.recording_set import RecordingSet, write


@pytest.fixture
def folder(small_set: Callable[..., RecordingSet], tmp_path: Path) -> Path:
    return write(small_set(), tmp_path / "set")
