"""Open the seals, and score the diagnoses against the concealed truths."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from math import inf
from pathlib import Path
from statistics import fmean, median
from typing import Literal

from scipy.special import betaincinv

from evaluation.case_run import CaseRun
from evaluation.independent_simulator import OUTSIDE
from evaluation.truth import CaseTruth, Concealed, Purpose, Seals, Truths, digest, seal
from lab.formats.results import DiagnosisResult
from sim.effects.library import effects as library
from sim.parameters import Frozen

CONFIDENCE = 0.95
#: Half width of a parameter's 95 % interval, standard deviations.
INTERVAL_SIGMAS = 1.959964
STRONG, SEEN = 50.0, 25.0  # limits of non-centrality, and of separability, between the classes
#: Classes of separability: (name, above, at most).
CLASSES = (("above 50", STRONG, inf), ("25 to 50", SEEN, STRONG), ("below 25", -1.0, SEEN))
CPU_GOAL_S, MEMORY_GOAL_MIB = 120.0, 3072.0  # 60 s on two cores
#: Smallest excess of held-out chi2 whose removal is scored, standard deviations of chi2.
EXCESS_SIGMAS = 3.0


class Rate(Frozen):
    """`count` of `of` cases, the share, and its 95 % interval (Clopper-Pearson); None where `of` is 0."""

    count: int
    of: int
    share: float | None
    low: float | None
    high: float | None

    @classmethod
    def over(cls, hits: Iterable[bool]) -> Rate:
        """Return the rate of hits."""
        seen = list(hits)
        count, of = sum(seen), len(seen)
        if of == 0:
            return cls(count=0, of=0, share=None, low=None, high=None)
        tail = (1.0 - CONFIDENCE) / 2.0
        low = 0.0 if count == 0 else float(betaincinv(count, of - count + 1, tail))
        high = 1.0 if count == of else float(betaincinv(count + 1, of - count, 1.0 - tail))
        return cls(count=count, of=of, share=count / of, low=low, high=high)


def rate_words(rate: Rate) -> str:
    """Return a count of cases with the interval of the share, for a table."""
    if rate.share is None or rate.low is None or rate.high is None:
        return "none"
    return f"{rate.count} of {rate.of} ({100 * rate.low:.0f}..{100 * rate.high:.0f} %)"


class Goal(Frozen):
    """A goal of the proof."""

    name: str
    wanted: str
    reached: str
    met: bool | None  # None where no case applies
    sure: bool | None = None  # whether the 95 % interval lies entirely on one side of the limit
    oracle: float | None = None  # mean share of the oracle on the same cases; None where it wasn't computed

    @property
    def verdict(self) -> str:
        """Whether it was met, in words, and whether the cases are enough to be sure."""
        if self.met is None:
            return "no case"
        return ("met" if self.met else "missed") + (", too few cases to be sure" if self.sure is False else "")


class CaseScore(Frozen):
    """One case: the concealed truth, and the diagnosis."""

    case: str
    kind: str
    truth: tuple[str, ...]
    variants: tuple[int, ...]
    noncentrality: tuple[float, ...]
    separability: float | None  # the least of its concealed laws; None: not measured
    oracle_share: float | None  # share of draws of the noise in which the oracle is right
    fault: str | None
    verdict: str
    named: tuple[str, ...]
    rivals: tuple[str, ...]
    unexplained: tuple[str, ...]
    right: bool
    effects: tuple[str, ...]  # concealed effects, by their names in the library
    true_families: tuple[
        tuple[str, ...], ...
    ]  # families that are right for each concealed law; empty where no family has it
    families: tuple[str, ...]  # of the named effects
    right_family: bool  # whether the effect or the family of every concealed law is named
    wrong_family: bool  # whether an effect or a family is named that is right for none
    set_holds: (
        bool | None
    )  # whether the 95 % sets of effects contain the truth; None where no set of listed effects is the truth
    excess_removed: float | None
    cpu_s: float
    memory_mib: float


class SinglesScore(Frozen):
    """Single effects of one class of non-centrality: rates of the right first name, of only that name, and of no
    name."""

    noncentrality: str
    top_1: Rate
    alone: Rate
    unnamed: Rate


class FairScore(Frozen):
    """Cases of one class of separability (`evaluation.noncentrality`) for which the oracle was computed."""

    kind: Literal["single", "compound"]
    separability: str
    right: Rate  # a single effect is named first, or both of a compound are named
    oracle: float | None  # mean share of the oracle
    of_oracle: float | None  # share of right answers over that of the oracle


class FamiliesScore(Frozen):
    """Names of effects and families, as rates of cases whose concealed laws have a family and a non-centrality above
    25."""

    right_effects: Rate  # of cases of listed effects: every effect is named
    right_families: Rate  # every concealed law is named by its effect or its family
    wrong_families: Rate  # of all cases, healthy ones included: something of another family is named


class EffectScore(Frozen):
    """All cases of one single effect: how often its name came first, and which names or verdicts came instead."""

    effect: str
    top_1: Rate
    strong_top_1: Rate
    instead: dict[str, int]


class SealedScore(Frozen):
    """What the scores of all sealed cases begin with. `failed`: the error of each case that didn't end."""

    purpose: Purpose
    seed: int
    size: str
    cases: int
    seals_sha256: str
    broken_seals: tuple[str, ...]
    failed: dict[str, str]
    goals: tuple[Goal, ...]

    @property
    def reached(self) -> bool:
        """Whether no goal was missed."""
        return all(goal.met is not False for goal in self.goals)


class BlindScore(SealedScore):
    """All scores of the blind proof: what `python -m evaluation score --json FILE` writes."""

    format: Literal["calibench-challenge-score"] = "calibench-challenge-score"
    version: Literal[1] = 1
    singles: tuple[SinglesScore, ...]
    fair: tuple[FairScore, ...]
    families: FamiliesScore
    effects: tuple[EffectScore, ...]
    compounds_both_named: Rate
    compounds_one_named: Rate
    compounds_strong_both_named: Rate
    rival_sets_cover: Rate
    rival_set_mean_size: float | None
    model_sets_hold: Rate
    model_sets_mean_size: float | None
    false_alarms: Rate
    false_names: Rate
    outside_not_named: Rate
    outside_located: Rate
    parameters_covered: Rate
    excess_removed: float | None
    excess_removed_median: float | None
    outside_excess_removed_median: float | None
    wall_median_s: float | None
    cpu_median_s: float | None
    cpu_max_s: float | None
    memory_max_mib: float | None
    case_scores: tuple[CaseScore, ...]


def goals_of_run(seals: Seals, broken: Sequence[str], ran: int, cases: int) -> tuple[Goal, Goal]:
    """Return the goals of all sealed cases: that their seals hold, and that each of the `cases` ran."""
    whole = len(seals.seals)
    return (
        Goal(
            name="seals that hold", wanted="all", reached=f"{whole - len(broken)} of {whole}", met=not broken, sure=True
        ),
        Goal(name="cases that ran", wanted="all", reached=f"{ran} of {cases}", met=ran == cases, sure=True),
    )


def broken_seals(folder: Path, seals: Seals, truths: Truths) -> tuple[str, ...]:
    """Cases whose truth or recordings differ from the sealed ones or are missing."""
    broken = []
    for case in sorted({*seals.seals, *truths.truths}):
        salted = truths.truths.get(case)
        there = salted is not None and case in seals.seals and (folder / case).is_dir()
        if (
            salted is None
            or not there
            or seal(salted) != seals.seals[case]
            or digest(folder / case) != salted.truth.recordings_sha256
        ):
            broken.append(case)
    return tuple(broken)


def seals_sha256(seals: Seals) -> str:
    """One hash over all seals, in the order of the cases."""
    return hashlib.sha256(
        "".join(f"{case} {value}\n" for case, value in sorted(seals.seals.items())).encode()
    ).hexdigest()


def score(truths: Truths, seals: Seals, runs: dict[str, CaseRun], broken: Sequence[str] = ()) -> BlindScore:
    """All scores. Cases with a broken seal are left out; cases that failed have no verdict and no name."""
    cases = [
        (case, truths.truths[case].truth, runs[case])
        for case in sorted(runs)
        if case in truths.truths and case not in broken
    ]
    scored = [_case_score(case, truth, run) for case, truth, run in cases]
    diagnoses = {case: run.diagnosis for case, _, run in cases}
    of_truth = {case: truth for case, truth, _ in cases}
    singles = [s for s in scored if s.kind == "single"]
    compounds = [s for s in scored if s.kind == "compound"]
    healthy = [s for s in scored if s.kind == "healthy"]
    outside = [s for s in scored if s.kind == "outside"]
    strong = [s for s in compounds if min(s.noncentrality) > STRONG]
    sets = [(s.truth[0], {s.named[0], *s.rivals}) for s in singles if s.named]
    removed = [s.excess_removed for s in scored if s.excess_removed is not None and s.kind != "outside"]
    outside_removed = [s.excess_removed for s in outside if s.excess_removed is not None]
    ran = [run for _, _, run in cases if run.error is None]
    classes = (
        _singles("above 50", [s for s in singles if s.noncentrality[0] > STRONG]),
        _singles("25 to 50", [s for s in singles if SEEN < s.noncentrality[0] <= STRONG]),
        _singles("below 25", [s for s in singles if s.noncentrality[0] <= SEEN]),
    )
    both = Rate.over(len(set(s.truth) & set(s.named)) == 2 for s in compounds)
    one = Rate.over(bool(set(s.truth) & set(s.named)) for s in compounds)
    both_strong = Rate.over(set(s.truth) <= set(s.named) for s in strong)
    cover = Rate.over(truth in names for truth, names in sets)
    size = fmean(len(names) for _, names in sets) if sets else None
    weighed = [s for s in scored if s.set_holds is not None]
    model_sizes = [len(_model_sets(diagnoses[s.case])) for s in weighed]
    alarms = Rate.over(s.verdict not in {"no_mismatch", "nothing_judged", "failed"} for s in healthy)
    names = Rate.over(bool(s.named) for s in healthy)
    abstained = Rate.over(s.right for s in outside)
    located = Rate.over(
        s.verdict not in {"no_mismatch", "nothing_judged", "failed"}
        for s in outside
        if s.fault is None and max(s.noncentrality, default=0.0) > SEEN
    )
    covered = Rate.over(hit for case, truth in of_truth.items() for hit in _covered(truth, diagnoses[case]))
    mean_removed = fmean(removed) if removed else None
    cpu, memory = max((r.cpu_s for r in ran), default=None), max((r.memory_mib for r in ran), default=None)
    families = _families(scored)
    fair = tuple(
        _fair(kind, what, [s for s in scored if s.kind == kind and above < (s.separability or 0.0) <= most])
        for kind in ("single", "compound")
        for what, above, most in CLASSES
    )
    goals = (
        *goals_of_run(seals, broken, len(ran), len(cases)),
        at_least("top-1 of single effects above 50", classes[0].top_1, 0.95).model_copy(
            update={"oracle": _oracle(s for s in singles if s.noncentrality[0] > STRONG)}
        ),
        at_least("right families above 25", families.right_families, 0.97),
        at_most("names of a wrong family", families.wrong_families, 0.01),
        at_least("both members of a compound named", both, 0.80).model_copy(update={"oracle": _oracle(compounds)}),
        at_least("rival sets cover the truth", cover, 0.95),
        _limit("rivals in a set, mean", size, 1.5, ""),
        at_least("95 % sets of models hold the truth", Rate.over(bool(s.set_holds) for s in weighed), 0.95),
        at_most("false names on healthy cameras", names, 0.01),
        at_least("outside the library, no cause named", abstained, 0.90),
        _between("95 % intervals of parameters hold", covered, 0.90, 0.98),
        Goal(
            name="held-out excess chi2 removed",
            wanted=">= 90 %",
            reached=_percent(mean_removed),
            met=None if mean_removed is None else mean_removed >= 0.9,
        ),
        _limit("CPU time of a case", cpu, CPU_GOAL_S, " s"),
        _limit("memory of a case", memory, MEMORY_GOAL_MIB, " MiB"),
    )
    return BlindScore(
        purpose=truths.purpose, seed=truths.seed, size=truths.size, cases=len(cases), seals_sha256=seals_sha256(seals),
        broken_seals=tuple(broken),
        failed={case: run.error for case, _, run in cases if run.error is not None}, singles=classes, fair=fair,
        families=families, effects=_by_effect(singles),
        compounds_both_named=both, compounds_one_named=one, compounds_strong_both_named=both_strong,
        rival_sets_cover=cover,
        rival_set_mean_size=size, model_sets_hold=Rate.over(bool(s.set_holds) for s in weighed),
        model_sets_mean_size=fmean(model_sizes) if model_sizes else None, false_alarms=alarms, false_names=names,
        outside_not_named=abstained, outside_located=located,
        parameters_covered=covered, excess_removed=mean_removed,
        excess_removed_median=median(removed) if removed else None,
        outside_excess_removed_median=median(outside_removed) if outside_removed else None,
        wall_median_s=median(r.wall_s for r in ran) if ran else None,
        cpu_median_s=median(r.cpu_s for r in ran) if ran else None,
        cpu_max_s=cpu, memory_max_mib=memory, goals=goals, case_scores=tuple(scored),
    )  # fmt: skip


# --- one case ---------------------------------------------------------------------------------------------------------


def _case_score(case: str, truth: CaseTruth, run: CaseRun) -> CaseScore:
    found = run.diagnosis
    effects = sorted(found.effects, key=lambda e: -e.probability) if found is not None else []
    named = tuple(e.name for e in effects)
    rivals = tuple(name for name in effects[0].alternatives if name != "unknown") if effects else ()
    told = [e.family for e in effects]
    true = [families_of(c) for c in truth.concealed]
    accepted = frozenset(library()[name].family.value for name in truth.accepts)
    right = {
        "healthy": found is not None and found.verdict == "no_mismatch",
        "single": named[:1] == truth.names,
        "compound": set(truth.names) <= set(named),
        "outside": found is not None and set(named) <= set(truth.accepts),
    }[truth.kind]
    return CaseScore(
        case=case, kind=truth.kind, truth=tuple(c.name for c in truth.concealed),
        variants=tuple(c.variant for c in truth.concealed),
        noncentrality=tuple(c.noncentrality for c in truth.concealed), separability=_least_separability(truth),
        oracle_share=truth.oracle_share, fault=truth.fault,
        verdict=found.verdict if found is not None else "failed", named=named, rivals=rivals,
        unexplained=tuple(u.measurement for u in found.unexplained) if found is not None else (), right=right,
        effects=truth.names, true_families=tuple(tuple(sorted(one)) for one in true), families=tuple(told),
        right_family=bool(true) and all(set(told) & one for one in true),
        wrong_family=not set(told) <= accepted.union(*true),
        set_holds=frozenset(truth.names) in _model_sets(found) if _is_listed(truth) else None,
        excess_removed=_removed(truth, found), cpu_s=run.cpu_s, memory_mib=run.memory_mib,
    )  # fmt: skip


def _is_listed(truth: CaseTruth) -> bool:
    """Return whether a set of listed effects is the truth."""
    return truth.kind != "outside" and all(c.effect is not None for c in truth.concealed)


def _model_sets(found: DiagnosisResult | None) -> set[frozenset[str]]:
    """Return the credible sets of effects of a diagnosis; only the empty one where nothing was searched for."""
    if found is None:
        return set()
    sets = {frozenset(one.effects) for models in found.models for one in models.sets}
    return sets or {frozenset[str]()}


def _least_separability(truth: CaseTruth) -> float | None:
    found = [c.separability for c in truth.concealed if c.separability is not None]
    return min(found) if found and len(found) == len(truth.concealed) else None


def families_of(concealed: Concealed) -> frozenset[str]:
    """Families that are right for a concealed law: its effect's, or those that the simulator declares; empty where
    no family has it."""
    if concealed.effect is not None:
        return frozenset({library()[concealed.effect].family.value})
    return next((law.families for law in OUTSIDE if law.name == concealed.name), frozenset())


def _removed(truth: CaseTruth, found: DiagnosisResult | None) -> float | None:
    """Share of the held-out excess chi2 that the improved model removes, (before - after) / (before - n), limited to
    -1..1; None where the concealed law left no significant excess there."""
    held = found.held_out if found is not None else None
    if held is None or max((c.noncentrality for c in truth.concealed), default=0.0) <= STRONG:
        return None
    excess = held.chi2_before - held.n
    if excess <= EXCESS_SIGMAS * (2.0 * held.n) ** 0.5:
        return None
    return max(-1.0, min(1.0, (held.chi2_before - held.chi2_after) / excess))


def _covered(truth: CaseTruth, found: DiagnosisResult | None) -> Iterable[bool]:
    """Of every parameter that has the same meaning in the library: whether its 95 % interval contains the true
    value."""
    named = {e.name: e for e in found.effects} if found is not None else {}
    for hidden in truth.concealed:
        effect = named.get(hidden.effect or "")
        for name, value in hidden.parameters.items() if effect is not None else ():
            said = effect.parameters.get(name)  # type: ignore[union-attr]
            if said is not None and said.interval is not None:
                yield said.interval[0] <= value <= said.interval[1]
            elif said is not None and said.std is not None:
                away = said.value - value if said.sign_known else abs(said.value) - abs(value)
                yield abs(away) <= INTERVAL_SIGMAS * said.std


# --- sums -------------------------------------------------------------------------------------------------------------


def _singles(what: str, cases: Sequence[CaseScore]) -> SinglesScore:
    return SinglesScore(
        noncentrality=what,
        top_1=Rate.over(s.right for s in cases),
        alone=Rate.over(s.named == s.truth for s in cases),
        unnamed=Rate.over(not s.named for s in cases),
    )


def _oracle(cases: Iterable[CaseScore]) -> float | None:
    """Mean share of the oracle over the cases for which it was computed."""
    shares = [s.oracle_share for s in cases if s.oracle_share is not None]
    return fmean(shares) if shares else None


def _fair(kind: Literal["single", "compound"], what: str, cases: Sequence[CaseScore]) -> FairScore:
    asked = [s for s in cases if s.oracle_share is not None and s.separability is not None]
    right, oracle = Rate.over(s.right for s in asked), _oracle(asked)
    return FairScore(
        kind=kind, separability=what, right=right, oracle=oracle,
        of_oracle=right.share / oracle if right.share is not None and oracle else None
    )  # fmt: skip


def _families(scored: Sequence[CaseScore]) -> FamiliesScore:
    held = [s for s in scored if s.truth and all(s.true_families) and min(s.noncentrality) > SEEN]
    return FamiliesScore(
        right_effects=Rate.over(set(s.effects) <= set(s.named) for s in held if s.kind != "outside"),
        right_families=Rate.over(s.right_family for s in held),
        wrong_families=Rate.over(s.wrong_family for s in scored),
    )


def _by_effect(singles: Sequence[CaseScore]) -> tuple[EffectScore, ...]:
    found = []
    for effect in sorted({s.truth[0] for s in singles}):
        mine = [s for s in singles if s.truth[0] == effect]
        instead = Counter(s.named[0] if s.named else s.verdict for s in mine if not s.right)
        found.append(
            EffectScore(
                effect=effect,
                top_1=Rate.over(s.right for s in mine),
                strong_top_1=Rate.over(s.right for s in mine if s.noncentrality[0] > STRONG),
                instead=dict(instead.most_common()),
            )
        )
    return tuple(found)


def _percent(share: float | None) -> str:
    return "no case" if share is None else f"{100 * share:.1f} %"


def _said(rate: Rate) -> str:
    if rate.share is None or rate.low is None or rate.high is None:
        return "no case"
    return f"{rate.count} of {rate.of}: {100 * rate.share:.1f} % ({100 * rate.low:.1f}..{100 * rate.high:.1f})"


def _judged(name: str, wanted: str, rate: Rate, good: Callable[[float], bool], low: float, high: float) -> Goal:
    if rate.share is None or rate.low is None or rate.high is None:
        return Goal(name=name, wanted=wanted, reached="no case", met=None)
    inside = low <= rate.low and rate.high <= high
    beyond = rate.high < low or rate.low > high
    return Goal(name=name, wanted=wanted, reached=_said(rate), met=good(rate.share), sure=inside or beyond)


def at_least(name: str, rate: Rate, limit: float) -> Goal:
    return _judged(name, f">= {100 * limit:g} %", rate, lambda share: share >= limit, limit, 1.0)


def at_most(name: str, rate: Rate, limit: float) -> Goal:
    return _judged(name, f"<= {100 * limit:g} %", rate, lambda share: share <= limit, 0.0, limit)


def _between(name: str, rate: Rate, low: float, high: float) -> Goal:
    return _judged(name, f"{100 * low:g}..{100 * high:g} %", rate, lambda share: low <= share <= high, low, high)


def _limit(name: str, value: float | None, limit: float, unit: str) -> Goal:
    reached = "no case" if value is None else f"{value:.3g}{unit}"
    return Goal(name=name, wanted=f"<= {limit:g}{unit}", reached=reached, met=None if value is None else value <= limit)
