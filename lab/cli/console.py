"""What every command writes: the two consoles, warnings, results as JSON."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.segment import Segment
from rich.text import Text

from lab.errors import InputError
from lab.plain_text import escaped, escaped_json

if TYPE_CHECKING:
    from pydantic import BaseModel

    from lab.pipeline import PipelineProgress


#: Exit codes; `InputError` (2) and `DeviceError` (3) carry theirs.
EXIT_INTERNAL, EXIT_INPUT, EXIT_CHECK, EXIT_INTERRUPTED = 1, 2, 4, 130


class PlainConsole(Console):
    """A console that escapes control characters of what it shows: stored names, files' texts and instruments' answers
    can't write on the terminal. Its own colours stay."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Turn markup into a text, escaped before its width is measured."""
        return super().render_str(escaped(text, several_lines=True), **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """Render as rich's console does, each text escaped."""
        for segment in super().render(renderable, options):
            if segment.control:
                yield segment
            else:
                yield Segment(escaped(segment.text, several_lines=True), segment.style)


# In a file or a pipe, a table keeps its width.
out = PlainConsole(soft_wrap=True, highlight=False, emoji=False, width=None if sys.stdout.isatty() else 200)
err = PlainConsole(stderr=True, soft_wrap=True, highlight=False, emoji=False)


def warn(lines: tuple[str, ...]) -> None:
    """Print warnings on stderr, one a line."""
    for line in lines:
        err.print(f"[yellow]calibench: warning:[/] {escape(line)}")


def check_writable(file: Path | None) -> None:
    """Refuse a result's file that can't be written, before the work. Raises InputError, or CannotWrite where the disk
    or its permissions are why."""
    if file is None or str(file) == "-":
        return
    if file.is_dir() or not file.parent.is_dir():
        raise InputError(f"{file}: can't be written; name a file in a folder that exists")
    _check_takes_files(file.parent, file)


def check_folder(folder: Path | None) -> None:
    """Refuse a folder of results that can't be made or written into, before the work. Raises as `check_writable`."""
    if folder is not None:
        _check_takes_files(folder, folder)


def check_output(path: Path) -> None:
    """Refuse a file or folder of results that can't be made with the folders above it, before the work. Raises as
    `check_writable`."""
    _check_takes_files(path if path.is_dir() else path.absolute().parent, path)


def _check_takes_files(folder: Path, wanted: Path) -> None:
    """Raise where what is wanted can't be written: nothing can be into its folder, or the nearest one above it that
    exists."""
    from lab.capture.room import why_unwritable

    existing = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
    if not existing.is_dir():
        raise InputError(f"{wanted}: can't be written into a folder, {existing} is none; name another place")
    if (why := why_unwritable(existing)) is not None:
        raise why


def write_json(result: BaseModel, file: Path | None) -> None:
    """Write a result as JSON, completely or not at all: to a file, to stdout ("-"), or nowhere (None)."""
    if file is None:
        return
    from lab.formats.result_file import result_json, write_result

    if str(file) == "-":
        sys.stdout.write(escaped_json(result_json(result)))
    else:
        write_result(result, file)


def make_folder(folder: Path) -> None:
    """Make a folder with its parents. Raises InputError where that isn't possible."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: can't be made ({error.strerror}); name another folder") from error


@contextlib.contextmanager
def progress_bar(what: str) -> Iterator[Callable[[str, float], None]]:
    """A bar for one piece of work; yields `advance(text, share)`."""
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as progress:
        task = progress.add_task(what, total=1.0)
        yield lambda text, share: progress.update(task, description=f"{what}: {escape(text)}", completed=share)


@contextlib.contextmanager
def pipeline_bar() -> Iterator[Callable[[PipelineProgress], None]]:
    """A bar for the step of a pipeline that is under way; yields what the pipeline calls. Remarks are printed as they
    come.

    Where stderr is no terminal, each sequence of a capture is a line on stdout, for a log.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[standing]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as progress:
        task = progress.add_task("", total=1.0, standing="")
        begun: set[tuple[str, str]] = set()

        def tell(now: PipelineProgress) -> None:
            standing = ""
            if (capture := now.capture) is not None:
                left = "" if capture.left_s is None else f", about {capture.left_s:.0f} s left"
                standing = f"{capture.done} of {capture.total}{left}"
                sequence = (capture.session, capture.sequence)
                if not err.is_terminal and capture.sequence and sequence not in begun:
                    begun.add(sequence)
                    out.print(f"{capture.sequence}: from step {capture.done + 1} of {capture.total}")
            description = ": ".join(part for part in (now.step, escape(now.what)) if part)
            progress.update(task, description=description, completed=now.share_of_step, standing=standing)
            if now.remark is not None:
                warning = now.remark.removeprefix("warning: ")
                if warning != now.remark:
                    warn((warning,))
                else:
                    err.print(f"calibench: {escape(now.remark)}")

        yield tell
