"""The recording set: the folder format in which recordings come in from outside and go out again.

`read` checks a whole folder and reports all problems at once, one line each. `write` writes a folder completely or not
at all. The kinds of capture are in `lab.capture_kinds`."""

from lab.formats.recording_set.archive import ArchiveForm, archive, packed
from lab.formats.recording_set.checks import inspect
from lab.formats.recording_set.clipping import clipped_share
from lab.formats.recording_set.files import FolderFiles, RecordingFiles
from lab.formats.recording_set.frame_files import RAWS, Frame, Target, load_frame
from lab.formats.recording_set.manifest import DataSheet, Manifest, RecordingError, manifest_json, parse_manifest
from lab.formats.recording_set.reading import read
from lab.formats.recording_set.recordings import RecordingSet
from lab.formats.recording_set.snapshot import InstrumentSnapshot, Snapshots, differences
from lab.formats.recording_set.writing import write

__all__ = [
    "RAWS",
    "ArchiveForm",
    "DataSheet",
    "FolderFiles",
    "Frame",
    "InstrumentSnapshot",
    "Manifest",
    "RecordingError",
    "RecordingFiles",
    "RecordingSet",
    "Snapshots",
    "Target",
    "archive",
    "clipped_share",
    "differences",
    "inspect",
    "load_frame",
    "manifest_json",
    "packed",
    "parse_manifest",
    "read",
    "write",
]
