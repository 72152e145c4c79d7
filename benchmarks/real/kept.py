"""The results that are kept: JSON in the repository, which the next run is compared with."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from benchmarks.real.judge import SetResult
from evaluation.truth import load
from sim.parameters import Frozen


class Kept(Frozen):
    """The results of all sets, by name."""

    format: Literal["calibench-real"] = "calibench-real"
    version: Literal[1] = 1
    sets: dict[str, SetResult] = {}


def kept_in(file: Path) -> Kept:
    """What `file` holds; nothing where it isn't there."""
    return load(Kept, file) if file.is_file() else Kept()
