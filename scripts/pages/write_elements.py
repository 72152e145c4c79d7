"""Write the types of a page's elements by their ids, and of the fields of its forms by their names, for TypeScript.

python scripts/pages/write_elements.py PAGE > elements.d.ts"""

from __future__ import annotations

import sys
from html.parser import HTMLParser
from pathlib import Path

FIELDS = ("input", "select", "textarea")


class _Reader(HTMLParser):
    """Tags by id, and the fields of each form."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: dict[str, str] = {}
        self.fields: dict[str, dict[str, str]] = {}
        self._form = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        if tag == "form":
            self._form = given.get("id", "")
        if "id" in given:
            assert given["id"] not in self.tags, f"two elements have the id {given['id']!r}: give one of them another"
            self.tags[given["id"]] = tag
        if tag in FIELDS and self._form and "name" in given:
            self.fields.setdefault(self._form, {})[given["name"]] = tag

    def handle_endtag(self, tag: str) -> None:
        if tag == "form":
            self._form = ""


def elements(page: str) -> str:
    """Declare the type `Elements` of a page: the element of each id."""
    reader = _Reader()
    reader.feed(page)
    lines = []
    for name, tag in reader.tags.items():
        kind = f'HTMLElementTagNameMap["{tag}"]'
        if tag == "form":
            fields = reader.fields.get(name, {})
            named = " ".join(f'"{field}": HTMLElementTagNameMap["{of}"];' for field, of in fields.items())
            kind = f"HTMLFormElement & {{ elements: HTMLFormControlsCollection & {{ {named} }} }}"
        lines.append(f'  "{name}": {kind};\n')
    return f"export interface Elements {{\n{''.join(lines)}}}\n"


if __name__ == "__main__":
    print(elements(Path(sys.argv[1]).read_text(encoding="utf-8")), end="")
