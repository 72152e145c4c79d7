"""Importers: other formats as recording sets. Each turns a path into a `RecordingSet` whose frames are decoded when asked for;
`lab.formats.recording_set.write` checks it and puts it on disk, completely or not at all. The set's `warnings` and `notes` say what an
importer left out, assumed or didn't find. What can't be known is asked for: on the command line (`ImportOptions`), or in a descriptor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lab.errors import InputError
from lab.formats.importers.emva1288 import read_emva1288
from lab.formats.importers.fits_folder import read_fits_folder
from lab.formats.importers.import_options import ImportOptions
from lab.formats.importers.raw_folder import read_checkerboard_pairs, read_dot_grids, read_raw_folder
from lab.formats.importers.single_picture import read_colour_chart, read_slanted_edge
from lab.formats.recording_set import RecordingSet

__all__ = [
    "KINDS",
    "ImportOptions",
    "read_checkerboard_pairs",
    "read_colour_chart",
    "read_dot_grids",
    "read_emva1288",
    "read_fits_folder",
    "read_foreign",
    "read_raw_folder",
    "read_slanted_edge",
]


@dataclass(frozen=True)
class Importer:
    """A format: how it is read, which options it takes, and whether it is one file, not a folder."""

    read: Callable[[Path, ImportOptions], RecordingSet]
    takes: frozenset[str] = frozenset()
    of_a_file: bool = False


def _raw_folder(path: Path, options: ImportOptions) -> RecordingSet:
    if options.checkerboard is None:
        return read_raw_folder(path, options.tap or "")
    if not options.square_mm:
        raise InputError("--checkerboard: state --square-mm, the side of its squares")
    return read_checkerboard_pairs(path, options.checkerboard, options.square_mm)


def _dot_grids(path: Path, options: ImportOptions) -> RecordingSet:
    if options.dots is None or not options.square_mm:
        raise InputError(
            "--from dot-grid: state --dots ROWSxCOLS and --square-mm, the spacing of the dots, as in 9x12 and 10"
        )
    return read_dot_grids(path, options.dots, options.square_mm)


_PICTURE = frozenset({"--camera", "--exposure-s", "--transfer"})
#: `--from KIND` -> its importer.
KINDS: dict[str, Importer] = {
    "emva1288": Importer(lambda path, _: read_emva1288(path)),
    "raw-folder": Importer(_raw_folder, frozenset({"--checkerboard", "--square-mm", "--tap"})),
    "fits": Importer(lambda path, options: read_fits_folder(path, options.tap or ""), frozenset({"--tap"})),
    "slanted-edge": Importer(read_slanted_edge, _PICTURE | {"--channel"}, of_a_file=True),
    "colorchecker": Importer(read_colour_chart, _PICTURE | {"--corners", "--light", "--white-patch"}, of_a_file=True),
    "dot-grid": Importer(_dot_grids, frozenset({"--dots", "--square-mm"})),
}


def read_foreign(kind: str, path: Path, options: ImportOptions | None = None) -> RecordingSet:
    """The recordings at `path`, which are of `kind`; InputError where there is no such kind, it doesn't take one of the options, or the
    recordings can't be used."""
    options = options or ImportOptions()
    if kind not in KINDS:
        raise InputError(f"--from {kind}: no such format; choose {', '.join(KINDS)}")
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; give that of the recordings")
    alien = [name for name in options.stated() if name not in KINDS[kind].takes]
    if alien:
        takes = ", ".join(sorted(KINDS[kind].takes)) or "none"
        raise InputError(f"--from {kind} doesn't take {', '.join(alien)}; it takes {takes}")
    return KINDS[kind].read(path, options)
