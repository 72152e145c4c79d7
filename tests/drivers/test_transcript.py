"""Transcripts: what was written is what is read."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.transcript import Piece, TranscriptFile, parse

PIECES = st.lists(
    st.builds(Piece, st.sampled_from(["sent", "received"]), st.binary(max_size=40)), min_size=1, max_size=6
)


@given(st.lists(PIECES, max_size=4))
def test_round_trip_of_any_bytes(conversations: list[list[Piece]]) -> None:
    text = "\n\n".join("# remark\n" + "\n".join(piece.line() for piece in pieces) for pieces in conversations)
    assert list(parse(text)) == conversations


def test_lines_are_readable() -> None:
    assert Piece("sent", b"WAVE?\n").line() == r"> WAVE?\n"
    assert Piece("received", b"\x06\xff\\").line() == r"< \x06\xff\\"


@pytest.mark.parametrize("line", ["WAVE?", r"> \q", "> caf\xe9", "> \\"])
def test_what_is_no_transcript_is_refused_with_its_line(line: str) -> None:
    with pytest.raises(ValueError, match="line 2: "):
        list(parse(f"# fine\n{line}\n"))


def test_a_recorder_writes_at_once(tmp_path: Path) -> None:
    recorder = TranscriptFile(tmp_path / "wire.txt")
    recorder("sent", b"*idn?\r")
    recorder("received", b"JETI_SB1211\r")
    text = (tmp_path / "wire.txt").read_text()
    recorder.close()
    assert list(parse(text)) == [[Piece("sent", b"*idn?\r"), Piece("received", b"JETI_SB1211\r")]]
