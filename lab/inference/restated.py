"""One side searched with what is stated of it, and with what fits where its table says that a statement is wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from lab.diagnose.metadata.misstatement import Misstatement
from lab.formats.camera_file import CameraFile
from lab.formats.recording_set import RecordingSet
from lab.formats.results import FitResult
from lab.inference.recordings import SideProblem, measure_side, search_side
from lab.inference.search import Search, Table
from lab.inference.statements.found import wrong_statements
from lab.inference.statements.structure import weigh_beforehand
from sim.camera import Side
from sim.memory import return_freed_memory

#: Times that a side is measured again with other statements.
MOST_CORRECTED = 2


@dataclass(frozen=True)
class Searched:
    """A side's problem with its search and its table."""

    problem: SideProblem
    search: Search
    table: Table


@dataclass(frozen=True)
class Examined:
    """What was found of a side: the recordings with wrong statements corrected, these statements, and the last search;
    None where nothing can be measured."""

    recordings: RecordingSet
    wrong: tuple[Misstatement, ...]
    searched: Searched | None


def examine_side(
    recordings: RecordingSet,
    side: Side,
    fit: Callable[[RecordingSet], FitResult] | None,
    baseline: CameraFile | None = None,
    report: Callable[[str], None] = lambda text: None,
) -> Examined:
    """Weigh the statements that decide what can be measured, measure and search; where a statement is wrong with the
    probability of a name, measure and search once more with the value that fits.

    What is told of effects belongs to the last table. Estimates that the model is linear about, such as the dark
    current, are made anew. Arguments as of `measure_side`; `report` is called with each step in words."""
    begin = recordings
    recordings, wrong = weigh_beforehand(recordings, side)
    searched: Searched | None = None
    for again in range(MOST_CORRECTED + 1):
        problem = measure_side(recordings, side, fit, baseline)
        if problem is None:
            return Examined(recordings, wrong, None)
        problem.groups  # noqa: B018  (they need what is shared between frames)
        for one in (begin, recordings, problem.dataset.recordings):
            one.let_go()
        return_freed_memory()
        report("searching the sets of effects")
        searched = Searched(problem, *search_side(problem))
        more = wrong_statements(recordings, side, searched.search, searched.table)
        wrong = (*wrong, *more)
        if not more or again == MOST_CORRECTED:
            break
        report("summarising the recordings with what fits")
        recordings = more[-1].corrected
    return Examined(recordings, wrong, searched)
