"""Text without control characters: checked where it comes in, escaped where it goes to a terminal or into a log.

A control character in a name could write on the terminal of whoever lists it (ESC), end a line of a log (newline),
or show a text in another order than it has (the overrides of writing direction). A line has none. Notes may have
several lines: newlines, tabs, and the carriage return before a newline.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from lab.errors import InputError

#: C0, DEL, C1, the separators of lines and paragraphs, embeddings, overrides and isolates of the writing direction, and
#: halves of surrogate pairs, which no encoding can write.
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
_LINE_END = re.compile(r"\r?\n|\t")


def _escape(found: re.Match[str]) -> str:
    return repr(found[0])[1:-1]


def escaped(text: str, several_lines: bool = False) -> str:
    """Return a text with its control characters as Python writes them, such as \\x1b; with `several_lines`, newlines
    and tabs stay.

    >>> print(escaped("left\\x1b[2J"))
    left\\x1b[2J
    """
    if not several_lines:
        return _CONTROL.sub(_escape, text)
    parts = re.split(r"(\n|\t)", text.replace("\r\n", "\n"))
    return "".join(part if part in ("\n", "\t") else _CONTROL.sub(_escape, part) for part in parts)


def escaped_json(text: str) -> str:
    """Return a JSON text with the control characters of its strings as JSON writes them, such as \\u009b."""
    return _CONTROL.sub(lambda found: found[0] if found[0] in "\n\t" else f"\\u{ord(found[0]):04x}", text)


def complaint_of(text: str, several_lines: bool = False) -> str | None:
    """Return what is wrong with a text that comes in, and the remedy; None for one without control characters."""
    found = _CONTROL.search(_LINE_END.sub(" ", text) if several_lines else text)
    if found is None:
        return None
    allowed = "newlines and tabs alone are allowed" if several_lines else "write one line of plain text"
    return f"'{escaped(text)[:60]}' has the control character U+{ord(found[0]):04X}; {allowed}"


def complaints_of(document: Any, several_lines: Sequence[str] = (), where: str = "") -> Iterator[str]:
    """Yield a line for each text with a control character in a JSON document, keys included. `several_lines`: names
    of its own fields that may have several."""
    if isinstance(document, str):
        if (complaint := complaint_of(document)) is not None:
            yield f"{where}: {complaint}" if where else complaint
    elif isinstance(document, Mapping):
        for name, value in document.items():
            key = escaped(str(name))[:60]
            at = f"{where}.{key}" if where else key
            if isinstance(name, str) and (complaint := complaint_of(name)) is not None:
                yield f"{where or 'the body'}: the name {complaint}"
            elif isinstance(value, str) and not where and name in several_lines:
                if (complaint := complaint_of(value, True)) is not None:
                    yield f"{at}: {complaint}"
            else:
                yield from complaints_of(value, (), at)
    elif isinstance(document, list | tuple):
        for number, value in enumerate(document):
            yield from complaints_of(value, (), f"{where}[{number}]")


def check_line(what: str, text: str, several_lines: bool = False) -> None:
    """Raise InputError for a text with control characters."""
    if (complaint := complaint_of(text, several_lines)) is not None:
        raise InputError(f"{what}: {complaint}")
