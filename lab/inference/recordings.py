"""One side of a recording set as a problem of inference: what is held out, what is measured, which hypotheses.

The forward model is the diagnosis' measurement model: m and J by the chain of light, S by each observable."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from lab.capture_kinds.base import Capture
from lab.capture_kinds.chart import ChartCapture
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.side_model import any_aperture, dataset_of, measurement_model
from lab.errors import NotDetermined
from lab.formats.camera_file import CameraFile
from lab.formats.recording_set import RecordingSet
from lab.formats.results import FitResult, Skipped
from lab.inference.check import held_out_ids
from lab.inference.discrepancy import depends_not_on_axis, groups_of, law_error, observable_kernel
from lab.inference.hypotheses import EffectParameter, Hypothesis, SetPrior, effect_at, hypothesis_of, parameters_of
from lab.inference.model import Group, State
from lab.inference.search import Search, Table
from lab.inference.statements.statement import (
    AffineChange,
    Changes,
    Numbers,
    Restatement,
    hypotheses_of_statements,
    restated,
)
from lab.observables.dataset import Dataset
from lab.observables.gaussian import Gaussian
from lab.observables.observable import Label, Observable, Prediction, measurements
from sim.camera import Side
from sim.effects.base import Effect, Effects
from sim.effects.library import candidates
from sim.effects.other_f_number import OtherFNumber
from sim.scene.colorchecker import reflectances
from sim.spectrum import FloatArray
from sim.uniform import electron_rate

#: Standard deviations of the noise by which a usual size has to change the numbers.
LEAST_SHOWN = 0.3
#: The largest share of its change that a law may be wrong by: the largest tolerance that any effect declares. What
#: differs by more is another law.
MOST_WRONG = 0.3


@dataclass
class SideModel:
    """The model of one side (`lab.inference.model.Model`): effects and wrong statements in the place of a toy's
    changes. `numbers`: the same numbers with their captures, which statements are about; None where none is asked."""

    measured: MeasurementModel
    groups: Sequence[Group]
    numbers: Numbers | None = None
    parameters: dict[str, tuple[EffectParameter, ...]] = field(default_factory=dict)
    _prepared: dict[Restatement, Changes] = field(default_factory=dict)
    _kernels: dict[tuple[int, bool], FloatArray] = field(default_factory=dict)

    @property
    def value(self) -> FloatArray:
        """y, (n,)."""
        return self.measured.value

    def effects(self, state: State) -> tuple[Effect, ...]:
        """Return the effects of a state."""
        found = []
        for name in sorted(state):
            point = state[name]
            if isinstance(point.template, Restatement):
                continue
            if name not in self.parameters:
                self.parameters[name] = parameters_of(type(point.template), self.measured.camera)
            found.append(effect_at(point, self.parameters[name]))
        return tuple(found)

    def changes(self, state: State) -> tuple[AffineChange, ...]:
        """Return the changes of the prediction by the wrong statements of a state."""
        found = []
        for name in sorted(state):
            point = state[name]
            if isinstance(point.template, Restatement):
                assert self.numbers is not None
                if point.template not in self._prepared:
                    self._prepared[point.template] = point.template.on(self.numbers)
                found.append(self._prepared[point.template](point.u))
        return tuple(found)

    def mean(self, state: State) -> FloatArray:
        """m under these effects and wrong statements, (n,)."""
        mean = self.measured.mean(self.effects(state))
        for change in self.changes(state):
            mean = change.on_mean(mean)
        return mean

    def gaussian(self, state: State, form_scale: float) -> Gaussian:
        """N(m, S + J P J'), with the form errors of the effects at `form_scale` times their tolerance.

        A law's error is a share of its change. It is smooth along the observable's axis, and in the logarithm of the
        change: numbers of one place that the law changes differently (in time, after other light) err differently.
        Where the law doesn't depend on the axis (`Effect.invariances`), its error doesn't, either: it is one share of
        all numbers that the law changes by the same share of their scale."""
        effects, changes = self.effects(state), self.changes(state)
        gaussian = self.measured.gaussian(effects, None, 0.0)
        if changes:
            gaussian = restated(self.measured, gaussian, changes, effects)
        if form_scale == 0.0:
            return gaussian
        stated = self.measured.mean(effects)
        for k, effect in enumerate(effects):
            if effect.form_tolerance == 0.0:
                continue
            change = stated - self.measured.mean((*effects[:k], *effects[k + 1 :]))
            for index in self.measured.affected_blocks(effect):
                own = change[self.measured.slices[index]]
                if own.any():
                    block = self.measured.blocks[index]
                    is_invariant = depends_not_on_axis(block, type(effect))
                    error = min(form_scale * effect.form_tolerance, MOST_WRONG) * own
                    kernel = self._kernel(index, is_invariant)
                    gaussian = gaussian.with_discrepancy(index, law_error(block, kernel, error, is_invariant))
        return gaussian

    def _kernel(self, index: int, is_invariant: bool) -> FloatArray:
        key = index, is_invariant
        if key not in self._kernels:
            self._kernels[key] = observable_kernel(self.measured.blocks[index], is_invariant=is_invariant)
        return self._kernels[key]

    def has_form_error(self, state: State) -> bool:
        """Whether any effect declares a form tolerance."""
        return any(point.template.form_tolerance > 0.0 for point in state.values())


@dataclass(frozen=True)
class SideProblem:
    """One side, measured: what is used, what is held out, and what was skipped."""

    side: Side
    dataset: Dataset
    measured: MeasurementModel
    held_out: tuple[Observable, ...]
    skipped: tuple[Skipped, ...]

    @cached_property
    def whole(self) -> MeasurementModel:
        """The model of the numbers that are used, and after them of those that are held out. They share the nuisance
        parameters that several observables share; of others, held-out captures have their own."""
        names = self.measured.nuisance_jacobian()
        own = {n for n in names if sum(bool(c.any()) for c in self._by_block(names[n])) == 1}
        others = tuple(replace(b, predict=_with_own(b.predict, own)) for b in self.held_out)
        whole = replace(
            self.measured, blocks=(*self.measured.blocks, *others), unstated_jacobian={}, _predictions={},
            _covariances={}, _numbers={},
        )  # fmt: skip
        if not self.measured.unstated_jacobian:
            return whole
        return replace(whole, unstated_jacobian=any_aperture(whole, len(self.measured.value)))

    def numbers(self, model: MeasurementModel) -> Numbers:
        """Return the numbers of a model of this side with their captures, held-out ones too."""
        return Numbers(model, {c.id: c for c in self.dataset.in_time_order}, self.dataset.stated, self._rate)

    def _rate(self, capture: Capture, label: Label, channel: str) -> float:
        """Electrons a second on axis in the light of a narrowband or chart capture, by the baseline."""
        known = reflectances(capture.chart) if isinstance(capture, ChartCapture) else {}
        light = self.dataset.spectrum(str(getattr(capture, "radiance", None)))
        reflectance = known.get(label.condition)
        return electron_rate(self.dataset.camera, channel, light, kind=capture.kind, reflectance=reflectance)

    def side_model(self, groups: Sequence[Group]) -> SideModel:
        """Return the model of the numbers that are used."""
        return SideModel(self.measured, groups, self.numbers(self.measured))

    def whole_model(self, groups: Sequence[Group]) -> SideModel:
        """Return the model of the numbers that are used, and of those that are held out."""
        return SideModel(self.whole, groups, self.numbers(self.whole))

    def _by_block(self, column: FloatArray) -> list[FloatArray]:
        return [column[at] for at in self.measured.slices]

    @cached_property
    def groups(self) -> tuple[Group, ...]:
        """The groups of small physics."""
        return groups_of(self.whole, self.dataset, len(self.measured.value))


def _with_own(predict: Callable[[Effects], Prediction], own: set[str]) -> Callable[[Effects], Prediction]:
    """Return a prediction whose nuisance parameters `own` have names of their own."""

    def renamed(effects: Effects) -> Prediction:
        made = predict(effects)
        return Prediction(
            made.mean, lambda: {f"held out: {n}" if n in own else n: c for n, c in made.jacobian.items()}
        )  # fmt: skip

    return renamed


def measure_side(
    recordings: RecordingSet,
    side: Side,
    fit: Callable[[RecordingSet], FitResult] | None,
    baseline: CameraFile | None = None,
) -> SideProblem | None:
    """Hold captures out, fit the others by `fit` (None: no fit), and measure both. `baseline`: a camera file in the
    place of data sheet and fit, with its effects. None where nothing can be measured."""
    held = held_out_ids(recordings, side)
    used = recordings.without(held)
    fitted = None if fit is None else fit(used)
    order = _in_time_order(recordings, side)
    dataset = _with_history(dataset_of(used, side, fitted, baseline), order)
    model, skipped = measurement_model(used, side, fitted, baseline, dataset)
    if model is None:
        return None
    return SideProblem(side, dataset, model, _held_out(recordings, held, dataset, order), skipped)


def _in_time_order(recordings: RecordingSet, side: Side) -> list[Capture]:
    captures = list(recordings.captures(side=side))
    if any(c.time is None for c in captures):
        return captures
    return sorted(captures, key=lambda c: c.time.timestamp() if c.time is not None else 0.0)


def _with_history(dataset: Dataset, order: list[Capture]) -> Dataset:
    """Return the dataset with all of the side's captures as its history: what frames before leave in a frame doesn't
    ask whether they are held out, nor does the time since the first one. Their levels predict, and aren't data."""
    times = [c.time for c in order if c.time is not None]
    dataset.first_time = min(times, default=None)
    dataset.in_time_order = [c for c in order if c.id not in dataset.copies.ids]
    dataset.__dict__.pop("_before", None)
    return dataset


def _held_out(
    recordings: RecordingSet, held: frozenset[str], dataset: Dataset, order: list[Capture]
) -> tuple[Observable, ...]:
    """Measure the held-out captures by themselves, about the same camera; what they don't determine is left out."""
    if not held:
        return ()
    only = recordings.without({c.id for c in recordings.captures() if c.id not in held})
    try:
        other = Dataset(
            only, dataset.side, dataset.camera, dataset.saturation_dn, dataset.misstated, dataset.fitted, dataset.noise
        )
    except NotDetermined:
        return ()
    _with_history(other, order)
    found = []
    for measurement in measurements():
        try:
            found.append(measurement.make(other))
        except NotDetermined:
            continue
    return tuple(found)


def hypotheses_of(measured: MeasurementModel) -> dict[str, Hypothesis]:
    """Return every effect that these recordings can show at a usual size, and another f-number or pitch than stated.

    An effect is one where its change at the prior's scale has a length of `LEAST_SHOWN` standard deviations of the
    noise. Of others the probability stays that of the prior."""
    base, gaussian = measured.mean(), measured.gaussian((), None, 0.0)
    found = {}
    kinds: list[type[Effect]] = [*candidates(), OtherFNumber]
    for kind in kinds:
        if not measured.affected(kind).any():
            continue
        one = hypothesis_of(kind, measured.camera)
        changes = [measured.mean((p.template,)) - base for alternative in one.alternatives for p in alternative.points]
        scales = [scale for alternative in one.alternatives for scale in alternative.scales]
        shown = np.linalg.norm(gaussian.whiten(np.column_stack(changes)), axis=0) * scales
        if shown.max() > LEAST_SHOWN:
            found[kind.name] = one
    return found


def search_side(
    problem: SideProblem, report: Callable[[str], None] = lambda text: None, everyday: float = 1.0
) -> tuple[Search, Table]:
    """Run the search on one side. `everyday`: factor to all everyday scales, to see what depends on them."""
    hypotheses = hypotheses_of(problem.measured) | hypotheses_of_statements(problem.numbers(problem.measured))
    groups = tuple(
        replace(g, everyday=everyday * g.everyday, least=None if g.least is None else everyday * g.least)
        for g in problem.groups
    )
    model = problem.side_model(groups)
    prior = SetPrior({name: h.family for name, h in hypotheses.items()})
    search = Search(model, hypotheses, prior, report=report)
    return search, search.run()
