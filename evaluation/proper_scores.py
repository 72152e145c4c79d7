"""Proper scores of what an engine says with a probability: effects, families, unlisted physics.

A statement has a probability p and is true or false. The log score of a case is the sum of ln p of its true statements
and of ln(1 - p) of its false ones, p clipped to `CLIP`..1 - `CLIP`; its Brier score the sum of (p - truth)^2 (Gneiting
and Raftery 2007). Both are compared between engines on the same cases, in pairs, with intervals by bootstrap over the
cases. The calibration error is the mean over bins of p of |mean p - share of true statements|, weighted by their number
(Guo et al. 2017).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from evaluation.case_run import CaseRun
from evaluation.score import SEEN, STRONG, families_of
from evaluation.truth import CaseTruth
from lab.formats.results import DiagnosisResult
from sim.effects.families import Family
from sim.effects.library import effects as library
from sim.spectrum import FloatArray

Kind = Literal["effect", "family", "unlisted"]
KINDS: tuple[Kind, ...] = ("effect", "family", "unlisted")
#: Least probability of a statement in the log score, and of one in the reliability.
CLIP, LEAST_RELIABLE = 1e-4, 0.05
#: Edges of the bins of the reliability.
BINS = (0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 0.99, 1.0 + 1e-12)
#: Draws of the bootstrap, its seed, and the share of an interval.
DRAWS, SEED, SHARE = 2000, 1288, 0.95
#: Cases of a class below which no difference is judged.
FEWEST_OF_CLASS = 30


@dataclass(frozen=True)
class Statement:
    """A statement with its probability, and whether it is true."""

    kind: Kind
    name: str
    probability: float
    is_true: bool


@dataclass(frozen=True)
class CaseStatements:
    """All statements on one case. `group`: its class; `named`: probabilities of its names, and `wrong`: of those that
    are wrong."""

    case: str
    group: str
    statements: tuple[Statement, ...]
    named: tuple[float, ...]
    wrong: tuple[str, ...]

    @property
    def log_score(self) -> float:
        """Log score, of effects and families. Today's engine states no probability of unlisted physics."""
        p, y = self._arrays(("effect", "family"))
        p = np.clip(p, CLIP, 1.0 - CLIP)
        return float(np.sum(np.where(y, np.log(p), np.log1p(-p))))

    @property
    def brier_score(self) -> float:
        """Brier score, of effects and families."""
        p, y = self._arrays(("effect", "family"))
        return float(np.sum(np.square(p - y)))

    def _arrays(self, kinds: Sequence[Kind]) -> tuple[FloatArray, np.ndarray]:
        used = [s for s in self.statements if s.kind in kinds]
        return np.array([s.probability for s in used]), np.array([s.is_true for s in used], bool)


@dataclass(frozen=True)
class Interval:
    """A mean with its 95 % interval, over n cases."""

    value: float
    low: float
    high: float
    n: int


@dataclass(frozen=True)
class Bin:
    """Statements with p between `low` and `high`: number, mean p, and how many are true."""

    low: float
    high: float
    n: int
    mean: float
    true: int


def case_statements(case: str, truth: CaseTruth, run: CaseRun) -> CaseStatements:
    """Return what was said of a case, with what is true of it.

    An effect or a family that the truth accepts in addition to what is concealed is neither true nor false, and left
    out; so is unlisted physics where a fault of metadata or a weak law is concealed. Everything about a case that
    failed has probability 0.
    """
    found = run.diagnosis
    told = _effects(found)
    families = _families(found, told)
    accepted = set(truth.accepts) - set(truth.names)
    true_families = {f for c in truth.concealed if c.effect is not None for f in families_of(c)}
    also = {library()[n].family.value for n in accepted}.union(*(families_of(c) for c in truth.concealed))
    statements = [
        Statement("effect", name, told.get(name, 0.0), name in truth.names)
        for name in sorted(library())
        if name not in accepted
    ]
    statements += [
        Statement("family", family, families.get(family, 0.0), family in true_families)
        for family in sorted({kind.family.value for kind in library().values()})
        if family in true_families or family not in also
    ]
    outside = [c for c in truth.concealed if c.effect is None]
    is_told = found is not None and found.engine == "evidence" and truth.fault is None
    if is_told and all(c.noncentrality > STRONG for c in outside):
        probability = max((u.probability for u in found.unlisted), default=0.0)  # type: ignore[union-attr]
        statements.append(Statement("unlisted", "any", probability, bool(outside)))
    named = found.effects if found is not None else ()
    right = {*truth.names, *accepted}, true_families | also
    wrong = tuple(e.name for e in named if not (e.family in right[1] if e.members else e.name in right[0]))
    return CaseStatements(case, _group(truth), tuple(statements), tuple(e.probability for e in named), wrong)


def _effects(found: DiagnosisResult | None) -> dict[str, float]:
    """Return the probability of each effect: of its name, else its inclusion probability, the larger of both sides."""
    told: dict[str, float] = {}
    for models in found.models if found is not None else ():
        for one in models.inclusion:
            told[one.name] = max(told.get(one.name, 0.0), one.probability)
    for effect in found.effects if found is not None else ():
        if not effect.members:
            told[effect.name] = effect.probability
        for member in effect.members:
            told[member.name] = member.probability
    return told


def _families(found: DiagnosisResult | None, told: Mapping[str, float]) -> dict[str, float]:
    """Return the probability of each family: of its name, else of the sets that hold a member, or of its likeliest
    member where sets aren't listed."""
    families: dict[str, float] = {}
    for name, probability in told.items():
        family = _family_of(name)
        families[family] = max(families.get(family, 0.0), probability)
    for models in found.models if found is not None else ():
        held: dict[str, float] = {}
        for one in models.sets:
            for family in {_family_of(n) for n in one.effects}:
                held[family] = held.get(family, 0.0) + one.probability
        for family, probability in held.items():
            families[family] = max(families.get(family, 0.0), min(probability, 1.0))
    for effect in found.effects if found is not None else ():
        if effect.members:
            families[effect.family] = effect.probability
    return families


def _family_of(name: str) -> str:
    """Return the family's identifier of an effect; of a wrong statement that of metadata."""
    known = library()
    return (known[name].family if name in known else Family.METADATA).value


def _group(truth: CaseTruth) -> str:
    if truth.kind == "outside" and truth.fault is not None:
        return "fault of metadata or rig"
    if truth.kind in ("healthy", "outside"):
        return truth.kind
    separability = min((c.separability or 0.0 for c in truth.concealed), default=0.0)
    strength = "above 50" if separability > STRONG else "25 to 50" if separability > SEEN else "below 25"
    return f"{truth.kind}, separability {strength}"


def mean_interval(values: Sequence[float]) -> Interval:
    """Return the mean of values, one a case, with its interval by bootstrap."""
    array = np.asarray(values, float)
    if not len(array):
        return Interval(np.nan, np.nan, np.nan, 0)
    rng = np.random.default_rng(SEED)
    means = array[rng.integers(len(array), size=(DRAWS, len(array)))].mean(axis=1)
    low, high = np.quantile(means, [0.5 - 0.5 * SHARE, 0.5 + 0.5 * SHARE])
    return Interval(float(array.mean()), float(low), float(high), len(array))


def reliability(cases: Sequence[CaseStatements], kind: Kind) -> list[Bin]:
    """Return the statements of a kind by bins of their probability."""
    p, y = _told(cases, kind)
    found = []
    for low, high in pairwise(BINS):
        inside = (p >= low) & (p < high)
        if inside.any():
            found.append(Bin(low, high, int(inside.sum()), float(p[inside].mean()), int(y[inside].sum())))
    return found


def calibration_error(cases: Sequence[CaseStatements], kind: Kind) -> Interval:
    """Return the expected calibration error of statements with p >= `LEAST_RELIABLE`, with its interval by bootstrap
    over the cases."""
    return _over_cases(cases, lambda some: _calibration_error(*_told(some, kind)))


def wrong_names(cases: Sequence[CaseStatements]) -> tuple[int, float, float]:
    """Return how many names are wrong, how many their probabilities promise (the sum of 1 - p), and the standard
    deviation of that number by those probabilities."""
    p = np.array([probability for case in cases for probability in case.named])
    return (
        sum(len(case.wrong) for case in cases),
        float(np.sum(1.0 - p)),
        float(np.sqrt(np.sum(p * (1.0 - p)))),
    )


def _told(cases: Sequence[CaseStatements], kind: Kind) -> tuple[FloatArray, np.ndarray]:
    used = [s for c in cases for s in c.statements if s.kind == kind and s.probability >= LEAST_RELIABLE]
    return np.array([s.probability for s in used]), np.array([s.is_true for s in used], bool)


def _calibration_error(p: FloatArray, y: np.ndarray) -> float:
    if not len(p):
        return 0.0
    which = np.digitize(p, BINS)
    return float(sum(abs(p[which == b].sum() - y[which == b].sum()) for b in np.unique(which)) / len(p))


def _over_cases(
    cases: Sequence[CaseStatements], figure: Callable[[Sequence[CaseStatements]], float]
) -> Interval:  # fmt: skip
    rng, n = np.random.default_rng(SEED), len(cases)
    if not n:
        return Interval(np.nan, np.nan, np.nan, 0)
    drawn = [figure([cases[k] for k in rng.integers(n, size=n)]) for _ in range(DRAWS // 10)]
    low, high = np.quantile(drawn, [0.5 - 0.5 * SHARE, 0.5 + 0.5 * SHARE])
    return Interval(figure(cases), float(low), float(high), n)


# --- as Markdown ------------------------------------------------------------------------------------------------------


def comparison_table(engines: Mapping[str, Sequence[CaseStatements]]) -> str:
    """Return the scores of engines on the same cases as Markdown. The first engine is the one to beat."""
    return "\n".join([*_score_lines(engines), "", *_reliability_lines(engines), "", *_wrong_lines(engines)])


def _score_lines(engines: Mapping[str, Sequence[CaseStatements]]) -> Iterator[str]:
    first, *others = engines
    yield "| cases | n | " + " | ".join(f"log score of {e}" for e in engines) + " | difference (95 %) | Brier |"
    yield "| --- " * (len(engines) + 4) + "|"
    groups = ["all", *sorted({c.group for c in engines[first]})]
    for group in groups:
        used = {e: [c for c in cases if group in ("all", c.group)] for e, cases in engines.items()}
        cells = [f"{np.mean([c.log_score for c in used[e]]):.2f}" for e in engines]
        for other in others:
            pairs = list(zip(used[other], used[first], strict=True))
            log = mean_interval([one.log_score - two.log_score for one, two in pairs])
            brier = mean_interval([one.brier_score - two.brier_score for one, two in pairs])
            cells += [f"{log.value:+.2f} ({log.low:+.2f}..{log.high:+.2f})"]
            cells += [f"{brier.value:+.3f} ({brier.low:+.3f}..{brier.high:+.3f})"]
        few = " (few)" if len(used[first]) < FEWEST_OF_CLASS else ""
        yield f"| {group}{few} | {len(used[first])} | " + " | ".join(cells) + " |"


def _reliability_lines(engines: Mapping[str, Sequence[CaseStatements]]) -> Iterator[str]:
    yield "| engine | statements | calibration error (95 %) | of p: true of n (mean p) |"
    yield "| --- | --- | --- | --- |"
    for engine, cases in engines.items():
        for kind in KINDS:
            bins = reliability(cases, kind)
            if not bins:
                continue
            error = calibration_error(cases, kind)
            told = "; ".join(f"{b.low:g}..{min(b.high, 1.0):g}: {b.true} of {b.n} ({b.mean:.3f})" for b in bins)
            yield f"| {engine} | {kind} | {error.value:.3f} ({error.low:.3f}..{error.high:.3f}) | {told} |"


def _wrong_lines(engines: Mapping[str, Sequence[CaseStatements]]) -> Iterator[str]:
    yield "| engine | wrong names | by their probabilities | which |"
    yield "| --- | --- | --- | --- |"
    for engine, cases in engines.items():
        count, promised, std = wrong_names(cases)
        which = "; ".join(f"{c.case}: {', '.join(c.wrong)}" for c in cases if c.wrong) or "none"
        yield f"| {engine} | {count} | {promised:.2f} +- {std:.2f} | {which} |"
