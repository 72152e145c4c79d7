"""Recording sets by the name that `docs/reference/results.md` promises to scripts: `lab.recording.read`,
`lab.recording.write`."""

from lab.formats.recording_set import RecordingSet, read, write

__all__ = ["RecordingSet", "read", "write"]
