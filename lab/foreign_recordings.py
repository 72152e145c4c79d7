"""Recordings of other formats: the importers by name (`importers`), and a path read by one of them (`read_foreign`).

The importers stand in `lab.formats.importers`. The picture of a slanted edge is read here: whether it shows an edge is
measured (`lab.observables.edges`), which formats know nothing of.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

from lab.errors import InputError, NotDetermined
from lab.formats.importers import (
    Importer,
    ImportOptions,
    read_boards,
    read_checkerboard_pairs,
    read_colour_chart,
    read_dot_grids,
    read_emva1288,
    read_fits_folder,
    read_raw_folder,
)
from lab.formats.importers.frame_settings import HeaderChoice, parse_choice
from lab.formats.importers.single_picture import build_recording_set, read_picture_and_camera, take_channel
from lab.formats.pictures import IMAGES, picture_facts
from lab.formats.recording_set import Manifest, RecordingSet, text_problems
from lab.plain_text import escaped
from sim.extensions import extensions, refuse

#: Endings of archives, which are unpacked before an import.
ARCHIVES = (".zip", ".tar", ".tar.gz", ".tgz", ".tar.xz", ".7z", ".rar")


def _choice(options: ImportOptions) -> HeaderChoice:
    return parse_choice(options.only or "", options.ignore or "")


def _raw_folder(path: Path, options: ImportOptions) -> RecordingSet:
    if options.checkerboard is None:
        return read_raw_folder(path, options.tap or "", _choice(options))
    if not options.square_mm:
        raise InputError("--checkerboard: state --square-mm, the side of its squares")
    return read_checkerboard_pairs(path, options.checkerboard, options.square_mm)


def _dot_grids(path: Path, options: ImportOptions) -> RecordingSet:
    if options.dots is None or not options.square_mm:
        raise InputError(
            "--from dot-grid: state --dots ROWSxCOLS and --square-mm, the spacing of the dots, as in 9x12 and 10"
        )
    return read_dot_grids(path, options.dots, options.square_mm)


def _checkerboards(path: Path, options: ImportOptions) -> RecordingSet:
    if options.checkerboard is None or not options.square_mm:
        raise InputError(
            "--from checkerboard: state --checkerboard ROWSxCOLS, its inner corners, and --square-mm, the side of its "
            "squares, as in 6x9 and 25"
        )
    return read_boards(path, "none", options.checkerboard, options.square_mm)


def read_slanted_edge(path: Path, options: ImportOptions) -> RecordingSet:
    """Return a picture with slanted edges as a recording set of one capture, whose edges are looked for.

    Raises InputError with all that isn't stated, in one line, or where no edge is found in the picture.
    """
    from lab.observables.edges.region import find_edges

    frame, camera, notes = read_picture_and_camera(path, options, lambda image: take_channel(image, options), ())
    try:
        found = find_edges(frame, camera.cfa, camera.saturation_dn)
    except NotDetermined as refused:
        is_lossy = path.suffix.lower() in IMAGES and picture_facts(path).is_lossy
        remedy = "a JPEG changes edges and noise: give the raw or a PNG" if is_lossy else "give a picture of one"
        raise InputError(f"{path}: no slanted edge: {refused.reason}; {remedy}") from refused
    capture = {"id": "edge", "kind": "slanted_edge"}
    usable = [edge for edge in found if not edge.refused]
    angles = ", ".join(f"{edge.angle_deg:.1f}" for edge in usable)
    notes = (*notes, f"{path}: {len(usable)} edges, at {angles} degrees from the vertical")
    return build_recording_set(path, frame, camera, options, capture, notes, {})


_HEADERS = frozenset({"--only", "--ignore"})
_PICTURE = frozenset({"--camera", "--exposure-s", "--transfer"})
#: `--from KIND` -> its importer, of this package.
KINDS: dict[str, Importer] = {
    "emva1288": Importer(lambda path, _: read_emva1288(path)),
    "raw-folder": Importer(_raw_folder, _HEADERS | {"--checkerboard", "--square-mm", "--tap"}, of_a_folder=True),
    "fits": Importer(
        lambda path, options: read_fits_folder(path, options.tap or "", _choice(options)),
        _HEADERS | {"--tap"},
        of_a_folder=True,
    ),
    "slanted-edge": Importer(read_slanted_edge, _PICTURE | {"--channel"}, of_a_file=True),
    "colorchecker": Importer(read_colour_chart, _PICTURE | {"--corners", "--light", "--white-patch"}, of_a_file=True),
    "dot-grid": Importer(_dot_grids, frozenset({"--dots", "--square-mm"})),
    "checkerboard": Importer(_checkerboards, frozenset({"--checkerboard", "--square-mm"})),
}


@cache
def importers() -> dict[str, Importer]:
    """Return all importers by their KIND: those above, and entry points of `calibench.importers` in other packages."""
    found = dict(KINDS)
    for name, added in extensions("importers"):
        if not isinstance(added, Importer):
            refuse("importers", name, f"{added!r} is no lab.formats.importers.Importer")
        elif name in KINDS:
            refuse("importers", name, f"there is an importer {name!r} already")
        else:
            found[name] = added
    return found


def read_foreign(kind: str, path: Path, options: ImportOptions | None = None) -> RecordingSet:
    """Return the recordings at `path`, which are of `kind`; InputError where there is no such kind, it doesn't take one
    of the options, or the recordings can't be used."""
    options = options or ImportOptions()
    known = importers()
    if kind not in known:
        raise InputError(f"--from {kind}: no such format; choose {', '.join(known)}")
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; give that of the recordings")
    importer = known[kind]
    if path.is_dir() and importer.of_a_file:
        raise InputError(f"{path}: is a folder; give one picture")
    if path.is_file() and importer.of_a_folder:
        is_archive = path.name.lower().endswith(ARCHIVES)
        remedy = "unpack it, and give the folder" if is_archive else "give the folder that it is in"
        raise InputError(f"{path}: is a file; {remedy}")
    alien = [name for name in options.stated() if name not in importer.takes]
    if alien:
        takes = ", ".join(sorted(importer.takes)) or "none"
        raise InputError(f"--from {kind} doesn't take {', '.join(alien)}; it takes {takes}")
    if path.is_dir() and not any(path.iterdir()):
        raise InputError(f"{path}: is empty; give the folder of the recordings")
    recordings = importer.read(path, options)
    manifest = _with_notes(recordings, path)
    if problems := list(text_problems(manifest.model_dump(exclude_unset=True))):
        raise InputError("\n".join(f"{path}: {line}" for line in problems))
    return recordings.under(manifest)


def _with_notes(recordings: RecordingSet, path: Path) -> Manifest:
    """Return the manifest with the warnings in its notes, one a line, without the folder in which the recordings
    were."""
    folder = path if path.is_dir() else path.parent
    lines = [line.removeprefix(f"{folder}: ") for line in recordings.warnings]
    if folder != Path():
        lines = [line.replace(f"{folder}/", "") for line in lines]
    notes = escaped("\n".join([recordings.manifest.notes, *lines]), several_lines=True)
    return recordings.manifest.model_copy(update={"notes": notes})
