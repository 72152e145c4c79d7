"""The progress bar of long commands, on stderr where that is a terminal."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from lab.cli.console import err, out, warn

if TYPE_CHECKING:
    from lab.pipeline import PipelineProgress


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
