"""The result of `calibench report`: where the page is, and what it shows."""

from __future__ import annotations

from sim.parameters import Frozen


class ReportFile(Frozen):
    """A report: its path, relative to the data folder if it lies there, and the ids of the results that it shows, by
    kind."""

    path: str
    results: dict[str, str] = {}
