"""Results that show themselves: in a notebook, at a prompt, as a table.

A result is data; words and pictures are made by `lab.report`, which knows results, and isn't known by them. The layer
that hands results to people (`lab.interface`) says once who presents them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import pandas as pd


class Presenter(Protocol):
    """Makes the summary and the table of a result."""

    def html(self, result: Any) -> str:
        """Return the summary with its pictures, as HTML."""

    def text(self, result: Any) -> str:
        """Return the summary as lines of text."""

    def table(self, result: Any) -> pd.DataFrame:
        """Return the result's table."""


_load: Callable[[], Presenter] | None = None


def present_with(load: Callable[[], Presenter]) -> None:
    """Set what presents results. `load` is called when the first result is shown: a presenter may import much."""
    global _load  # noqa: PLW0603  (one process has one way to show results, as it has one display hook)
    _load = load


class Displayable:
    """Base of what shows itself: IPython and Jupyter call these methods."""

    def _repr_html_(self) -> str | None:
        return None if _load is None else _load().html(self)

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        printer.text(repr(self) if _load is None or cycle else _load().text(self))


class Tabular(Displayable):
    """Base of what is a table, too."""

    def to_dataframe(self) -> pd.DataFrame:
        """Return the result as a table: a row a number, a check, a level or a point; units are in the columns' names,
        or in a column `unit`. Needs pandas (calibench's extra `notebook`).

        Raises InputError where pandas isn't installed.
        """
        if _load is None:
            raise RuntimeError("nothing presents results; import calibench, then call this again")
        return _load().table(self)
