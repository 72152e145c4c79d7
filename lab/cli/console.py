"""What every command writes to the terminal: the consoles, warnings, a progress bar, JSON."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from pydantic import BaseModel
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from lab.errors import InputError
from lab.fit import Progress as Advance

# In a file or a pipe, a table keeps its width.
out = Console(soft_wrap=True, highlight=False, width=None if sys.stdout.isatty() else 200)
err = Console(stderr=True, soft_wrap=True, highlight=False)


def warn(lines: tuple[str, ...]) -> None:
    for line in lines:
        err.print(f"[yellow]calibench: warning:[/] {escape(line)}")


@contextlib.contextmanager
def progress_bar(what: str) -> Iterator[Advance]:
    """A progress bar on stderr where that is a terminal; yields `advance(text, share)`."""
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as progress:
        task = progress.add_task(what, total=1.0)
        yield lambda text, share: progress.update(task, description=f"{what}: {escape(text)}", completed=share)


def check_writable(file: Path | None) -> None:
    """Refuse a result's file that can't be written before the work, not after it."""
    if file is None or str(file) == "-":
        return
    if file.is_dir() or not file.parent.is_dir() or not os.access(file.parent, os.W_OK):
        raise InputError(f"{file}: can't be written; name a file in a folder that exists and is yours")


def write_json(result: BaseModel, file: Path | None) -> None:
    """The result as JSON: completely or not at all."""
    if file is None:
        return
    text = result.model_dump_json(indent=1) + "\n"
    if str(file) == "-":
        sys.stdout.write(text)
        return
    from lab.formats.raw_file import replacing

    with replacing(file) as partial:
        partial.write_text(text, encoding="utf-8")


def make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: can't be made ({error.strerror}); name a folder that is yours") from error
