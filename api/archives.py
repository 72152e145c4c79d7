"""Recording sets as a .zip in the body of an answer, packed while it is sent."""

from __future__ import annotations

from collections.abc import Iterator

from fastapi import Response
from fastapi.responses import StreamingResponse

from lab.formats.recording_set import RecordingSet, archive


class Zip(Response):
    media_type = "application/zip"


def zipped(recordings: RecordingSet, name: str) -> Response:
    """The set as an answer. Its first file is read before the answer begins, so that a set without files is refused; where a later one is
    damaged, the answer breaks off."""
    recordings.cache_bytes = 0
    pieces = archive(recordings)
    first = next(pieces)

    def every() -> Iterator[bytes]:
        yield first
        yield from pieces

    headers = {"Content-Disposition": f'attachment; filename="{name}.zip"'}
    return StreamingResponse(every(), media_type=Zip.media_type, headers=headers)
