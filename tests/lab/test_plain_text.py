"""Control characters are refused in the texts of files, and escaped where they are shown."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.markup import escape
from rich.table import Table

from lab.capture.store import Store
from lab.cli.console import PlainConsole
from lab.errors import InputError
from lab.formats.recording_set import RecordingSet, read, write
from lab.plain_text import complaint_of, escaped, escaped_json
from tests.lab import fake_bench

CONTROLS = st.sampled_from("\x00\x07\x08\r\x1b\x7f\x85\x9b\u2028\u202a\u202e\u2066\u2069\ud800")


@given(st.text(max_size=8), CONTROLS, st.text(max_size=8))
def test_whatever_stands_around_it_a_control_character_is_found_and_escaped(a: str, control: str, b: str) -> None:
    text = a + control + b
    for several_lines in (False, True):
        complaint = complaint_of(text, several_lines)
        if not (several_lines and control == "\r" and b.startswith("\n")):
            assert complaint is not None and complaint_of(complaint) is None
        assert control not in escaped(text, several_lines) and complaint_of(escaped(text, several_lines), True) is None
    assert control not in escaped_json(text)


@given(st.text(st.characters(exclude_categories=("Cc", "Cs", "Cf", "Zl", "Zp"))))
def test_other_text_stays_as_it_is(text: str) -> None:
    assert complaint_of(text) is None and escaped(text) == text
    assert complaint_of(f"{text}\n\t{text}", True) is None and escaped(f"{text}\n\t", True) == f"{text}\n\t"


def test_escaped_json_is_the_same_document() -> None:
    document = {"a\x9b": ["\u202e", "ü", "\x1b"]}
    text = escaped_json(json.dumps(document, indent=1, ensure_ascii=False))
    assert json.loads(text) == document and "\x9b" not in text and "ü" in text


def test_a_console_keeps_its_own_colours_alone() -> None:
    file = io.StringIO()
    console = PlainConsole(file=file, width=100, force_terminal=True, color_system="standard", highlight=False)
    console.print("[red]calibench:[/] " + escape("a\x1b]0;title\x07b\x9b\u202e"))
    table = Table("name")
    table.add_row(escape("c\x1b[2J"))
    console.print(table)
    shown = file.getvalue()
    assert "\x1b[31mcalibench:\x1b[0m a\\x1b]0;title\\x07b\\x9b\\u202e" in shown and "c\\x1b[2J" in shown
    assert "\x1b]" not in shown and "\x1b[2J" not in shown


@pytest.mark.parametrize(
    ("place", "text"),
    [("name", "a\x1b[2J"), ("notes", "a\r b"), ("id", "dark\n7"), ("pose", "p\u202e1"), ("cfa", "\x00")],
)
def test_a_manifest_with_one_is_refused_in_one_line(
    place: str, text: str, small_set: Callable[..., RecordingSet], tmp_path: Path
) -> None:
    folder = write(small_set(), tmp_path / "set")
    manifest = json.loads((folder / "manifest.json").read_text())
    charuco = manifest["captures"][-1]
    {"id": charuco, "pose": charuco, "cfa": manifest["cameras"]["left"]}.get(place, manifest)[place] = text
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(InputError) as caught:
        read(folder)
    assert place in str(caught.value) and "control character U+" in str(caught.value)
    assert not any(ord(one) < 32 or one == "\u202e" for one in str(caught.value).replace("\n", ""))


def test_what_an_instrument_reported_is_no_reason_to_refuse_a_set(
    small_set: Callable[..., RecordingSet], tmp_path: Path
) -> None:
    folder = write(small_set(), tmp_path / "set")
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest |= {"instruments": {"camera left": {"serial_number": "12\x00"}}, "notes": "cold\r\n\tday 1\n"}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    assert read(folder).manifest.notes == "cold\r\n\tday 1\n"


def test_a_session_takes_none_either(store: Store) -> None:
    with pytest.raises(InputError, match=r"name: 'a\\x1b' has the control character U\+001B"):
        store.create_session(fake_bench.station(), (), name="a\x1b")
    session = store.create_session(fake_bench.station(), (), name="a", notes="b\nc")
    with pytest.raises(InputError, match="newlines and tabs alone"):
        store.describe_session(session, notes="b\x07")
