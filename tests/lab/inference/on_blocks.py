"""The table of sets of a few measurements only: quick enough for the everyday suite."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lab.diagnose.evidence.places import PLACE_RATE, examine_places
from lab.diagnose.evidence.side_table import SideTable
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.formats.recording_set import RecordingSet
from lab.inference.posterior import LIKELIER, Size, read_table, sizes_of
from lab.inference.recordings import SideProblem, search_side
from lab.inference.search import FittedSet, Row
from lab.observables.dataset import Dataset
from lab.observables.gaussian import Gaussian
from lab.observables.observable import Observable
from sim.effects.base import Effect
from tests.lab.diagnose.on_blocks import dataset


@dataclass(frozen=True)
class Judged:
    """The table of sets of some measurements, all of whose numbers are used."""

    reading: SideTable

    @property
    def names(self) -> list[str]:
        """What is named: effects and wrong statements, and families where no member is; likeliest first."""
        return [f.name for f in self.reading.posterior.named]

    @property
    def unlisted(self) -> dict[str, float]:
        """States on which something unlisted is likelier than not, with the probability of it."""
        found = self.reading.posterior.findings
        return {f.name: f.probability for f in found if f.kind == "unlisted" and f.probability >= LIKELIER}

    @property
    def is_calm(self) -> bool:
        """Whether nothing is found: no name, nothing unlisted, and no place departs from the camera without effects."""
        return not self.names and not self.unlisted and not self.departing

    @cached_property
    def departing(self) -> set[str]:
        """Measurements of which a place departs from the camera without effects, everyday small physics included."""
        return departing(self.reading.used, self.reading.baseline)

    @cached_property
    def left(self) -> set[str]:
        """Measurements of which a place departs from the likeliest set, everyday small physics included."""
        fit = self.reading.fit_of(next(iter(self.reading.sets)))
        assert fit is not None
        return departing(self.reading.used, self.reading.gaussian(fit, frozenset()))

    def probability(self, name: str) -> float:
        """Probability that an effect acts, or any of a family."""
        return max(self.reading.posterior.probability(kind, name) for kind in ("effect", "family"))

    def effect(self, name: str) -> Effect:
        """An effect as it is in the likeliest set that holds it."""
        members = next(found for found in self.reading.sets if name in found)
        return self.fitted(*members)[name]

    def fit(self, *members: str) -> FittedSet:
        """The fit of a set of effects."""
        found = self.reading.fit_of(frozenset(members))
        assert found is not None, f"the table has no estimate of {', '.join(members)}"
        return found

    def fitted(self, *members: str) -> dict[str, Effect]:
        """The effects of a set at the mode, by name."""
        return {one.name: one for one in self.reading.effects_of(self.fit(*members).state)}

    def size(self, name: str, parameter: str) -> Size:
        """A parameter of an effect that is named."""
        return next(s for s in self.reading.posterior.sizes[name] if s.parameter == parameter)

    def size_alone(self, name: str, parameter: str) -> Size:
        """A parameter of an effect where it acts alone, named or not."""
        row = Row(self.fit(name).members, frozenset(), 1.0, refitted=True)
        alone = replace(self.reading.table, rows=(row,), fits=self.reading.search.fits)
        found = sizes_of(alone, self.reading.search.hypotheses, name)
        return next(s for s in found if s.parameter == parameter)


def judged(model: MeasurementModel, of: Dataset) -> Judged:
    """Run the search on these measurements of a dataset, and read its table."""
    problem = SideProblem(of.side, of, replace(model, noise=of.noise), (), ())
    search, table = search_side(problem)
    posterior = read_table(table, search.hypotheses)
    return Judged(SideTable(of.recordings, of.side, problem, search, table, posterior, (), (), 0.0))


def judge(recordings: RecordingSet, *makers: Callable[[Dataset], Observable]) -> Judged:
    looked_at = dataset(recordings)
    return judged(MeasurementModel(tuple(make(looked_at) for make in makers), looked_at.camera), looked_at)


def departing(model: MeasurementModel, gaussian: Gaussian) -> set[str]:
    """Measurements of which a place departs from a distribution of all numbers: the probability of as large a chi2 by
    chance, corrected for the number of places, is below that of a mismatch."""
    places = examine_places(model, gaussian)
    return {part.block.measurement.name for part in places if part.log_probability < np.log(PLACE_RATE)}
