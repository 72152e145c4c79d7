"""Files as an archive, made piece by piece while it is sent: unpacked, a recording set's is what `read` takes."""

from __future__ import annotations

import io
import tarfile
import zipfile
from collections.abc import Iterable, Iterator
from typing import Literal

from lab.formats.recording_set.recordings import RecordingSet
from lab.formats.recording_set.writing import contents

#: A .zip has its list of files at the end; a .tar can be unpacked while it arrives.
ArchiveForm = Literal["zip", "tar"]


class _Sent(io.RawIOBase):
    """A write-only file whose content is taken away piece by piece."""

    def __init__(self) -> None:
        self._held = bytearray()

    def writable(self) -> bool:
        return True

    def write(self, piece: object) -> int:
        written = bytes(piece)  # type: ignore[call-overload]
        self._held += written
        return len(written)

    def taken(self) -> bytes:
        """Return what came since the last call."""
        held, self._held = bytes(self._held), bytearray()
        return held


def packed(files: Iterable[tuple[str, bytes]], form: ArchiveForm = "zip") -> Iterator[bytes]:
    """Yield the pieces of an archive of files, (path, content) each: one of them in memory at a time, stored without
    compression. Where `files` raises, the archive has no end (a .zip: no list of files), so nobody takes it for a whole
    one."""
    sent = _Sent()
    if form == "tar":
        with tarfile.open(fileobj=sent, mode="w|") as tar:
            for path, content in files:
                member = tarfile.TarInfo(path)
                member.size = len(content)
                tar.addfile(member, io.BytesIO(content))
                yield sent.taken()
    else:
        # Closed after an error, too; what that writes isn't sent.
        with zipfile.ZipFile(sent, "w", zipfile.ZIP_STORED) as made:
            for path, content in files:
                made.writestr(zipfile.ZipInfo(path), content)
                yield sent.taken()
    yield sent.taken()


def archive(recordings: RecordingSet, form: ArchiveForm = "zip") -> Iterator[bytes]:
    """Yield the pieces of an archive of the set, as `packed` makes it. Raises InputError where a frame is missing or
    damaged."""
    return packed(contents(recordings), form)
