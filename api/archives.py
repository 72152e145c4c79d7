"""Files as an archive in the body of an answer, packed while it is sent."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any

from fastapi import Path, Response
from fastapi.responses import StreamingResponse

from lab.formats.recording_set import ArchiveForm

MEDIA_TYPES: dict[ArchiveForm, str] = {"zip": "application/zip", "tar": "application/x-tar"}
#: The ending of an archive's path.
Form = Annotated[ArchiveForm, Path(description="a .tar can be unpacked while it arrives")]


class Packed(Response):
    media_type = MEDIA_TYPES["zip"]


#: OpenAPI's description of an answer that is an archive; `Packed` is its response class.
ARCHIVE: dict[int | str, dict[str, Any]] = {
    200: {"content": {media: {"schema": {"type": "string", "format": "binary"}} for media in MEDIA_TYPES.values()}}
}


def stream_archive(pieces: Iterator[bytes], name: str, form: ArchiveForm) -> Response:
    """Return the pieces of an archive as an answer. The first is made before the answer begins, so that what has no
    files is refused; where a later one is damaged, the answer breaks off."""
    first = next(pieces)

    def every() -> Iterator[bytes]:
        yield first
        yield from pieces

    headers = {"Content-Disposition": f'attachment; filename="{name}.{form}"'}
    return StreamingResponse(every(), media_type=MEDIA_TYPES[form], headers=headers)
