"""Importers: other formats as recording sets. Each turns a path into a `RecordingSet` whose frames are decoded when
asked for; `lab.formats.recording_set.write` checks it and puts it on disk, completely or not at all. The set's
`warnings` say what an importer left out, assumed or didn't find; the manifest's `notes` keep them. What can't be known
is asked for: on the command line (`ImportOptions`), or in a descriptor. `lab.foreign_recordings` lists them by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lab.formats.importers.emva1288 import read_emva1288
from lab.formats.importers.fits_folder import read_fits_folder
from lab.formats.importers.raw_folder import (
    read_boards,
    read_checkerboard_pairs,
    read_dot_grids,
    read_raw_folder,
)
from lab.formats.importers.single_picture import ImportOptions, read_colour_chart
from lab.formats.recording_set import RecordingSet

__all__ = [
    "ImportOptions",
    "Importer",
    "read_boards",
    "read_checkerboard_pairs",
    "read_colour_chart",
    "read_dot_grids",
    "read_emva1288",
    "read_fits_folder",
    "read_raw_folder",
]


@dataclass(frozen=True)
class Importer:
    """A format: how it is read, which options it takes, and whether it is one file, or a folder and nothing else."""

    read: Callable[[Path, ImportOptions], RecordingSet]
    takes: frozenset[str] = frozenset()
    of_a_file: bool = False
    of_a_folder: bool = False
