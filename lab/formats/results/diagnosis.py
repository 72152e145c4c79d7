"""The result of `calibench diagnose`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from lab.engine import Engine
from lab.formats.results.estimate import Estimate
from lab.formats.results.fit import Skipped
from lab.shown import Tabular
from sim.camera import Side
from sim.parameters import Frozen

#: `nothing_judged`: the recordings determine no measurement.
DiagnosisVerdict = Literal["no_mismatch", "explained", "partly_explained", "unexplained", "nothing_judged"]
#: Where a correction of the sensitivities stands, in words.
IN_CURVES = "in the sensitivity curves"
#: Standard deviations of a normal distribution to either side that hold 95 %, and those by which the ends of an
#: interval may differ from them where the distribution counts as normal.
NORMAL_95, SKEWED = 1.96, 0.5


class Mismatch(Frozen):
    """A part of a measurement whose prediction and recording differ beyond the threshold."""

    side: Side
    measurement: str
    axis: str
    where: str
    significance_sigma: float
    captures: tuple[str, ...]


class ParameterValue(Estimate):
    """An estimated parameter of an effect.

    `sign_known`: False where the recordings show its size only, as it acts by its square. `interval`: from low to high,
    95 %. `is_determined`: False where that interval holds the value at which the effect is absent: its size isn't
    determined, the name stands.
    """

    sign_known: bool = True
    interval: tuple[float, float] | None = None
    is_determined: bool = True

    @property
    def shown_interval(self) -> tuple[float, float] | None:
        """The interval, where `value` and `std` as a normal distribution don't describe it."""
        if self.interval is None or not self.std:
            return self.interval
        ends = (self.value - NORMAL_95 * self.std, self.value + NORMAL_95 * self.std)
        apart = max(abs(end - bound) for end, bound in zip(ends, self.interval, strict=True))
        return self.interval if apart > SKEWED * self.std or not self.is_determined else None


class Combination(Frozen):
    """What the recordings determine of parameters that they can't tell apart: the sum of `weights` times `parameters`,
    each less its value in absence and raised to `power`, with the size's own sign.

    The weights are the direction; the first is 1, and the unit that of the first parameter to that power.
    """

    side: Side
    parameters: tuple[str, ...]
    weights: tuple[float, ...]
    power: int
    value: float
    std: float
    unit: str


class Rival(Frozen):
    """Another effect that explains the same mismatch, with its posterior probability."""

    name: str
    probability: float


class Member(Frozen):
    """An effect of a family that is named, with its probability if the cause is one of the listed effects."""

    name: str
    probability: float


class NamedEffect(Frozen):
    """An effect that the diagnosis names, or the family of one, with its posterior probability. By the engine
    `evidence`, an effect of a camera has an entry for each side, one of the light, the screen or the chart one entry.

    `law`: `exact` where what the effects leave is within noise and the laws' tolerances, else `inexact`. `members`:
    where the family is named, its effects, likeliest first; `name` is then the family's identifier, and `parameters`
    are those of the first member. `combinations`: of parameters that aren't determined by themselves. `choices`: which
    of its alternatives the law is, by field: the corner of a glow. `modes`: other values of the parameters, in their
    units, that fit as well. `shown_in`: measurements in which it stands out of the noise, strongest first.
    """

    name: str
    family: str
    law: Literal["exact", "inexact"]
    members: tuple[Member, ...] = ()
    probability: float
    sides: tuple[Side, ...]
    parameters: dict[str, ParameterValue]
    combinations: tuple[Combination, ...] = ()
    choices: dict[str, str] = {}
    modes: tuple[dict[str, float], ...] = ()
    shown_in: tuple[str, ...] = ()
    rivals: tuple[Rival, ...] = ()
    statement: str
    #: Publication that the effect's law is taken from.
    reference: str | None = None
    #: What stands in the improved model beside the nearest law, in words, where a family is named.
    corrections: tuple[str, ...] = ()

    @property
    def alternatives(self) -> tuple[str, ...]:
        """What else may be meant: of a family its members, and the rivals."""
        return (*(member.name for member in self.members), *(rival.name for rival in self.rivals))

    @property
    def nearest_law(self) -> str:
        """The effect whose parameters these are."""
        return self.members[0].name if self.members else self.name


class Unexplained(Frozen):
    """A mismatch that no effect of the library explains; a model discrepancy stands for it in the improved model."""

    side: Side
    measurement: str
    axis: str
    where: str
    shape: str
    significance_sigma: float
    chi2_before: float
    chi2_after: float
    n: int
    captures: tuple[str, ...] = ()  # that show it
    correction: str = ""  # the model discrepancy, or the discovered law, in words
    would_help: str = ""  # captures that would help where nothing predicts it, as a sentence
    check: str = ""  # stated values, of the camera or of captures, that the recordings contradict, as sentences
    probability: float | None = None  # of a stated value: that it is wrong; None where that isn't weighed

    @property
    def corrects_curves(self) -> bool:
        """Whether the model discrepancy is a factor on the sensitivity curves."""
        return IN_CURVES in self.correction


class DiscoveredLaw(Frozen):
    """A table or a curve along one index of the camera that recordings hold and no effect of the library has; it stands
    in the improved model as `empirical_law`.

    `stage`, `along`, `of`, `period`, `columns`, `first`, `at` and `table` are those of that effect. `form` is that in
    which it was found (`periodic`, `by index`, `wave`, `decay`, `step`, `line`, `knee`, `bump`, `formula`, `curve`).
    `shown_departure` is the shortest table that does nearly as well, by index mod `shown_period` (0: by index, or by
    `at`): departures from no change, relative, or in DN or e (offsets of stage `signal`), with their standard
    deviations. chi2 is of the `n` numbers along the index in held-out captures (in the captures themselves where none
    are held out), without and with the law; of images (rows, columns, places, variances), whose patterns stand for the
    noise, of the table's own numbers. `own_chi2_before`, `own_chi2_after` and `own_n` are those of the table's own
    numbers throughout: of the means of its classes. `measurements`: those that it shows in. `suspects`: what physics
    may do it; none of them is a name.

    By the engine `evidence`, a law is the posterior of the small physics of one `state`, given that something unlisted
    acts there, with its `probability`: mean and standard deviations at the nodes `at`. Where no stage of the chain has
    it, it is a curve of the `curve_of` measurement: `at` are places of its axis, each value with its channel and its
    condition in `labels`, `table` departures in its quantity; `empirical_law` can't act so. chi2 is of the held-out
    numbers of `measurements`, by the covariance without the law.
    """

    side: Side
    stage: str
    along: str
    of: str = "mean"
    form: str = "periodic"
    period: int
    columns: int = 0
    first: int = 0
    at: tuple[float, ...] = ()
    table: tuple[float, ...]
    shown_period: int
    shown_departure: tuple[float, ...]
    shown_std: tuple[float, ...]
    chi2_before: float
    chi2_after: float
    n: int
    own_chi2_before: float | None = None
    own_chi2_after: float | None = None
    own_n: int | None = None
    measurements: tuple[str, ...] = ()
    suspects: str
    statement: str
    state: str = ""
    probability: float | None = None
    curve_of: str = ""
    labels: tuple[str, ...] = ()


class Unlisted(Frozen):
    """Unlisted physics that acts on one state of the chain of light, with its posterior probability.

    `measurements`: those that show it, strongest first. `where`: the part of the first of them that shows it."""

    side: Side
    state: str
    measurements: tuple[str, ...] = ()
    probability: float
    where: str = ""


class VetoedName(Frozen):
    """An effect that the captures used for the choice suggest, and that held-out captures contradict: it isn't named.

    `before`, `after`: chi2 of n held-out numbers without and with it.
    """

    side: Side
    name: str
    probability: float
    captures: tuple[str, ...]
    chi2_before: float
    chi2_after: float
    n: int
    statement: str


class HeldOut(Frozen):
    """chi2 of captures that neither the fit nor the choice of effects has used.

    `before`: under the baseline. `after`: with the named effects and the mean of the model discrepancy. `discovered`:
    with the laws besides that no effect has; None where there are none.
    """

    captures: tuple[str, ...]
    chi2_before: float
    chi2_after: float
    chi2_discovered: float | None = None
    n: int


class ResidualCurve(Frozen):
    """One measurement as recorded and as predicted, before and after the named effects, for the report's figures.

    `before` has the nuisance parameters that were found with the named effects, within three prior standard deviations
    of what is stated: what a camera without these effects would show, and not a fit of the baseline to recordings that
    contradict it."""

    side: Side
    measurement: str
    label: str
    channel: str
    axis: str
    quantity: str = ""  # that `measured`, `before` and `after` are, with its unit
    x: tuple[float, ...]
    names: tuple[str, ...] = ()  # of the points, where x is only their number
    measured: tuple[float, ...]
    measured_std: tuple[float, ...]
    before: tuple[float, ...]  # prediction of the baseline
    after: tuple[float, ...]  # prediction with the named effects and the model discrepancy
    held_out: bool


class EffectSet(Frozen):
    """A set of effects that may act together, with its posterior probability; the empty set is the baseline.
    `refitted`: its parameters were fitted; otherwise the probability is of the linear problem about a likely set.
    `unlisted`: states of the chain of light on which unlisted physics acts beside them."""

    effects: tuple[str, ...]
    probability: float
    refitted: bool = True
    unlisted: tuple[str, ...] = ()


class IncludedEffect(Frozen):
    """An effect, with the probability that it is a part of what acts: the sum over the sets that hold it."""

    name: str
    probability: float


class SideModels(Frozen):
    """The table of sets of one side. Probabilities are unconditional where the result's `engine` is `evidence`, else
    conditional on every cause being a listed effect.

    `sets`: the fewest sets of effects that together hold `share` of the probability, likeliest first. `inclusion`: of
    all sets that were fitted, likeliest first. `not_weighed`: sets that promised enough and that the budget of CPU time
    left without a refit. `never_refitted`: the probability of sets that had to be refitted and never were;
    `closed_form`: of those whose probability the recordings hardly change; None: not stated."""

    side: Side
    share: float
    sets: tuple[EffectSet, ...]
    inclusion: tuple[IncludedEffect, ...]
    not_weighed: tuple[tuple[str, ...], ...] = ()
    never_refitted: float | None = None
    closed_form: float | None = None


class NextCapture(Frozen):
    """A capture that could be taken to tell rivals apart.

    `distance`: D = 1/2 d' C^-1 d of the two nearest rivals, with d the difference of their predictions and C the
    covariance of the measurement. `told_apart`: probability Phi(sqrt(D / 2)) of a right decision between them.
    `settles`: probability that afterwards one of all rivals holds the threshold of a name; None: not computed."""

    side: Side
    capture: str
    rivals: tuple[str, str]
    distance: float
    told_apart: float
    settles: float | None = None


class ExaminedPlace(Frozen):
    """A part of one measurement that was tested: chi2 under the baseline and with the named effects.

    `sigma_before`, `sigma_after`: significance in standard deviations, corrected for the number of places tested.
    """

    side: Side
    measurement: str
    axis: str
    where: str
    n: int
    chi2_before: float
    chi2_after: float
    sigma_before: float
    sigma_after: float


class MeasurementFit(Frozen):
    """chi2 of one whole measurement before and after the named effects and the model discrepancy.

    `n`, `chi2`: of the captures that the fit and the choice of effects used. `held_out`: of the others.
    """

    side: Side
    measurement: str
    n: int
    chi2_before: float
    chi2_after: float
    held_out_n: int
    held_out_before: float
    held_out_after: float


class Visibility(Frozen):
    """What the recordings could show of one effect.

    `smallest`: size of each parameter that is detected with a probability of 90 %; a parameter without such a size is
    left out. `nearest`: the effect with the most similar signature, `cosine`: of the angle between the two signatures,
    `told_apart`: probability of a right decision between them.
    """

    side: Side
    effect: str
    smallest: dict[str, float]
    nearest: str | None
    cosine: float
    told_apart: float


class ResidualPicture(Frozen):
    """Residuals of a frame averaged over cells, in standard deviations: under the baseline and with the named
    effects."""

    side: Side
    kind: str
    capture: str
    held_out: bool
    before: tuple[tuple[float, ...], ...]
    after: tuple[tuple[float, ...], ...]


class RivalOdds(Frozen):
    """A rival and its probability among the rivals."""

    name: str
    probability: float


#: How resolving ended.
ResolveEnd = Literal["settled", "this station can't", "budget spent"]


class Resolution(Frozen):
    """One step of resolving: what was in doubt on a side, the capture that was taken, and what the diagnosis said.

    `session` holds its frames; `verdict_before`, `effects_before`: the diagnosis before it. `rivals`, `rivals_after`:
    what was and what is in doubt, or the names that stand there; None while no diagnosis has said it yet. `then`: the
    capture that is planned after it, as only both together tell. `information_nat`: expected information of the capture
    (of both). `settles`: probability that one rival holds the threshold of a name afterwards. `expected_s` and
    `spent_s`: lab time that was expected and that it took.
    """

    capture: str
    session: str
    verdict_before: DiagnosisVerdict
    effects_before: tuple[NamedEffect, ...]
    side: Side = "left"
    rivals: tuple[RivalOdds, ...] = ()
    then: str = ""
    information_nat: float | None = None
    settles: float | None = None
    expected_s: float | None = None
    spent_s: float | None = None
    rivals_after: tuple[RivalOdds, ...] | None = None


class ResolveJournal(Frozen):
    """The journal of resolving one session. `budget_min`: lab time that its captures may take (None: any),
    `most_rounds`: how many they may be. `end`, `reason`: how it ended and why; None while it goes on."""

    format: Literal["calibench-resolve-journal"] = "calibench-resolve-journal"
    version: Literal[1] = 1
    budget_min: float | None = None
    most_rounds: int | None = None
    resolutions: tuple[Resolution, ...] = ()
    end: ResolveEnd | None = None
    reason: str = ""


class PolicyRule(Frozen):
    """One number by which a diagnosis decided (`lab.diagnose.policy.DecisionPolicy` declares them)."""

    name: str
    group: str
    value: float
    unit: str
    meaning: str


class DiagnosisLists(Frozen):
    """What a diagnosis lists of one side, or of all: each entry names its side."""

    mismatches: tuple[Mismatch, ...] = ()
    unexplained: tuple[Unexplained, ...] = ()
    unlisted: tuple[Unlisted, ...] = ()
    vetoed: tuple[VetoedName, ...] = ()
    discovered: tuple[DiscoveredLaw, ...] = ()  # the most significant first, for each side
    models: tuple[SideModels, ...] = ()
    places: tuple[ExaminedPlace, ...] = ()
    measurements: tuple[MeasurementFit, ...] = ()
    visibility: tuple[Visibility, ...] = ()
    pictures: tuple[ResidualPicture, ...] = ()
    curves: tuple[ResidualCurve, ...] = ()
    skipped: tuple[Skipped, ...] = ()

    @staticmethod
    def joined(parts: Sequence[DiagnosisLists]) -> DiagnosisLists:
        """Join the lists of several sides. Parts of one measurement are skipped for the same reason, which is listed
        once."""
        every = {name: tuple(x for part in parts for x in getattr(part, name)) for name in DiagnosisLists.model_fields}
        return DiagnosisLists.model_validate(every | {"skipped": tuple(dict.fromkeys(every["skipped"]))})


class DiagnosisResult(Tabular, DiagnosisLists):
    """What the first model left out, and how much better the improved model predicts."""

    format: Literal["calibench-diagnosis"] = "calibench-diagnosis"
    version: Literal[1] = 1
    source: str
    engine: Engine = "today"
    verdict: DiagnosisVerdict
    effects: tuple[NamedEffect, ...] = ()
    held_out: HeldOut | None = None
    next_capture: str | None = None
    next_captures: tuple[NextCapture, ...] = ()  # best first, for each side
    resolutions: tuple[Resolution, ...] = ()  # in the order in which they were taken
    resolve_end: ResolveEnd | None = None  # how resolving ended; None: nothing was to be resolved
    resolve_reason: str = ""
    threshold: float | None = None
    false_alarm_rate: float | None = None
    summary: tuple[str, ...] = ()  # the diagnosis in sentences
    warnings: tuple[str, ...] = ()  # of the fit: figures outside the range of working cameras
    policy: tuple[PolicyRule, ...] = ()  # the rules of decision
    baseline: str | None = None  # names of the camera files that it began with, where not with the fitted cameras
