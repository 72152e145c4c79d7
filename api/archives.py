"""Files as a .zip in the body of an answer, packed while it is sent."""

from __future__ import annotations

from collections.abc import Iterator

from fastapi import Response
from fastapi.responses import StreamingResponse

from lab.formats.recording_set import RecordingSet, archive


class Zip(Response):
    media_type = "application/zip"


def zipped(pieces: Iterator[bytes], name: str) -> Response:
    """The pieces of a .zip as an answer. The first is made before the answer begins, so that what has no files is refused; where a later one is
    damaged, the answer breaks off."""
    first = next(pieces)

    def every() -> Iterator[bytes]:
        yield first
        yield from pieces

    headers = {"Content-Disposition": f'attachment; filename="{name}.zip"'}
    return StreamingResponse(every(), media_type=Zip.media_type, headers=headers)


def zipped_set(recordings: RecordingSet, name: str) -> Response:
    """A recording set as an answer."""
    recordings.cache_bytes = 0
    return zipped(archive(recordings), name)
