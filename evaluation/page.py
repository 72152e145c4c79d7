"""Pages of the evaluation: sections between marks, and the list of seeds that were scored."""

from __future__ import annotations

import re
from pathlib import Path

from lab.errors import InputError


def placed(text: str, name: str, section: str) -> str:
    """Return a page's text with the section `name` between its marks replaced, or added at the end."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    if begin not in text:
        return f"{text.rstrip()}\n\n## Results, {name}\n\n{begin}\n{section}\n{end}\n"
    head, rest = text.split(begin, 1)
    return f"{head}{begin}\n{section}\n{end}{rest.split(end, 1)[1]}"


def with_seed(text: str, row: str) -> str:
    """Return a page's text with a row in its list of seeds."""
    end = "<!-- seeds:end -->"
    if row in text:
        return text
    if end not in text:
        text += f"\n## Seeds\n\n| for | seed | cases | frames | seals |\n| --- | --- | --- | --- | --- |\n{end}\n"
    return text.replace(end, f"{row}\n{end}")


def refuse_scored(seed: int, page: Path) -> None:
    """Raise InputError where the page lists this proof seed as scored: a scored seed is never used again."""
    if page.is_file() and re.search(rf"^\| proof \| {seed} \|", page.read_text(encoding="utf-8"), re.MULTILINE):
        raise InputError(f"seed {seed}: was scored already, see {page}; leave --seed out for a fresh one")
