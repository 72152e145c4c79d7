"""A bar for work that is started from Python: on a terminal and in a notebook, and nowhere else."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator

from tqdm import tqdm

FORMAT = "{desc} {percentage:3.0f}%|{bar:24}| {elapsed}"


def is_watched() -> bool:
    """Return whether somebody sees a bar on stderr: a terminal, or a notebook."""
    return sys.stderr.isatty() or "ipykernel" in sys.modules


@contextlib.contextmanager
def progress_bar(wanted: bool | None = None) -> Iterator[Callable[[str, float], None]]:
    """Show a bar for the block; yields `advance(text, share)`, with the share 0..1 of the work that is done.

    wanted : show it; None: where somebody sees it
    """
    shown = is_watched() if wanted is None else wanted
    with tqdm(total=1.0, bar_format=FORMAT, disable=not shown, leave=False, file=sys.stderr) as bar:
        said = ("", -1.0)

        def advance(text: str, share: float) -> None:
            nonlocal said
            now = text, round(min(max(share, 0.0), 1.0), 2)
            if now != said:  # a notebook keeps every line that a bar writes
                said = now
                bar.set_description_str(text, refresh=False)
                bar.n = now[1]
                bar.refresh()

        yield advance
