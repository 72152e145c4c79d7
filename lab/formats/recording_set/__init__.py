"""The recording set: the folder format in which recordings come in from outside and go out again.

`read` checks a whole folder and reports all problems at once, one line each. `write` writes a folder completely or not
at all. The kinds of capture are in `lab.capture_kinds`."""

from lab.formats.recording_set.checks import clipped_share, inspect
from lab.formats.recording_set.files import RAWS, FolderFiles, Frame, RecordingFiles, Target, load_frame
from lab.formats.recording_set.folder import ArchiveForm, archive, packed, read, write, write_url
from lab.formats.recording_set.frame_codes import CELLS, CodeCounts, FrameCodes
from lab.formats.recording_set.manifest import (
    DataSheet,
    InstrumentSnapshot,
    Manifest,
    RecordingError,
    Snapshots,
    differences,
    manifest_json,
    parse_manifest,
    text_problems,
)
from lab.formats.recording_set.object_store import is_url
from lab.formats.recording_set.recordings import RecordingSet, Summaries, frame_problem

__all__ = [
    "CELLS",
    "RAWS",
    "ArchiveForm",
    "CodeCounts",
    "DataSheet",
    "FolderFiles",
    "Frame",
    "FrameCodes",
    "InstrumentSnapshot",
    "Manifest",
    "RecordingError",
    "RecordingFiles",
    "RecordingSet",
    "Snapshots",
    "Summaries",
    "Target",
    "archive",
    "clipped_share",
    "differences",
    "frame_problem",
    "inspect",
    "is_url",
    "load_frame",
    "manifest_json",
    "packed",
    "parse_manifest",
    "read",
    "text_problems",
    "write",
    "write_url",
]
