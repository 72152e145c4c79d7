"""Transcripts: what went over a wire, one piece a line, readable by people and by tests.

    > WAVE?\\n            what the host sent
    < WAVE?\\n500\\r\\n     what the instrument sent
    # ...                a remark; an empty line ends a conversation

Bytes outside printable ASCII, and backslashes, are escaped as in Python.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Direction = Literal["sent", "received"]
_MARKS: dict[str, Direction] = {">": "sent", "<": "received"}
_ESCAPES = {b"\\\\": b"\\", b"\\r": b"\r", b"\\n": b"\n", b"\\t": b"\t"}


@dataclass(frozen=True)
class Piece:
    """Bytes that went one way."""

    direction: Direction
    data: bytes

    def line(self) -> str:
        """Return the piece as a line of a transcript, without its end."""
        mark = next(mark for mark, direction in _MARKS.items() if direction == self.direction)
        return f"{mark} {self.data.decode('latin-1').encode('unicode_escape').decode('ascii')}"


def parse(text: str) -> Iterator[list[Piece]]:
    r"""Yield the conversations of a transcript, blank lines between.

    text : lines that begin with `> ` (sent), `< ` (received) or `#`

    Raises `ValueError` with the line's number for another line.

    >>> [len(conversation) for conversation in parse("> ?ID\n< CS260\n\n> STOP\n")]
    [2, 1]
    """
    conversation: list[Piece] = []
    for number, line in enumerate([*text.splitlines(), ""], 1):
        if not line.strip():
            if conversation:
                yield conversation
            conversation = []
        elif line[:2] in {"> ", "< "}:
            conversation.append(Piece(_MARKS[line[0]], _unescape(line[2:], number)))
        elif not line.startswith("#"):
            raise ValueError(
                f"line {number}: {line[:40]!r} is no piece of a transcript; begin it with '> ', '< ' or '#'"
            )


class TranscriptFile:
    """A recorder that appends every piece to a file at once; one file for each instrument."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("a", encoding="ascii")
        self._lock = threading.Lock()

    def __call__(self, direction: Direction, data: bytes) -> None:
        with self._lock:
            self._file.write(Piece(direction, data).line() + "\n")
            self._file.flush()

    def close(self) -> None:
        """End the file."""
        with self._lock:
            self._file.close()


def _unescape(text: str, number: int) -> bytes:
    def unescape(match: re.Match[bytes]) -> bytes:
        escape = match[0]
        if escape.startswith(b"\\x") and len(escape) == 4:
            return bytes((int(escape[2:], 16),))
        if escape not in _ESCAPES:
            raise ValueError(f"line {number}: {escape.decode()!r} is no escape; write \\\\, \\r, \\n, \\t or \\xHH")
        return _ESCAPES[escape]

    try:
        return re.sub(rb"\\(x[0-9a-fA-F]{2}|.|$)", unescape, text.encode("ascii"))
    except UnicodeEncodeError:
        raise ValueError(f"line {number}: not ASCII; escape it as \\xHH") from None
