"""What is said: read off the table of sets.

Effect, family, metadata error, unlisted physics: inclusion probabilities, sums over the sets that hold them. Sizes:
mixtures over the sets of the conditional posteriors. The verdict: by these probabilities and the held-out check."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from lab.inference.hypotheses import Hypothesis
from lab.inference.search import FittedSet, Search, Table
from sim.spectrum import FloatArray

#: Threshold of a name, and of more likely than not.
NAMED, LIKELIER = 0.95, 0.5
#: Draws of the mixtures behind sizes.
_DRAWS = 4000

Verdict = Literal["no_mismatch", "explained", "partly_explained", "unexplained"]
Kind = Literal["effect", "family", "unlisted"]


@dataclass(frozen=True)
class Finding:
    """A statement with its probability: that an effect acts, that any of a family does, that something unlisted acts on
    a group's state."""

    kind: Kind
    name: str
    probability: float


@dataclass(frozen=True)
class Size:
    """A parameter of an effect, given that it acts: a mixture over the sets. `interval` holds 95 %. `is_determined`:
    the interval doesn't hold absence."""

    parameter: str
    mean: float
    std: float
    interval: tuple[float, float]
    is_determined: bool


@dataclass(frozen=True)
class Posterior:
    """What the table says. `named`: effects, and families of which another member acts. `nothing`: p(no effect, nothing
    unlisted). `inexact`: of each named effect, p(its law is wrong by more than it declares | the effect acts)."""

    findings: tuple[Finding, ...]
    named: tuple[Finding, ...]
    nothing: float
    sizes: Mapping[str, tuple[Size, ...]]
    left: float
    is_undecided: bool
    inexact: Mapping[str, float] = field(default_factory=dict)

    def probability(self, kind: Kind, name: str) -> float:
        """Return the probability of a statement; 0 where the table doesn't hold it."""
        return next((f.probability for f in self.findings if f.kind == kind and f.name == name), 0.0)


def read_table(table: Table, hypotheses: Mapping[str, Hypothesis]) -> Posterior:
    """Return what a table says."""
    effects: dict[str, float] = {}
    families: dict[str, float] = {}
    unlisted: dict[str, float] = {}
    nothing = 0.0
    for row in table.rows:
        for name in row.members:
            effects[name] = effects.get(name, 0.0) + row.probability
        for family in {hypotheses[name].family for name in row.members}:
            families[family] = families.get(family, 0.0) + row.probability
        for state in table.states(row.unlisted):
            unlisted[state] = unlisted.get(state, 0.0) + row.probability
        if not row.members and not row.unlisted:
            nothing += row.probability
    for tail in table.tails:
        for name in tail.members:
            effects[name] = effects.get(name, 0.0) + tail.probability
        for state, share in tail.unlisted.items():
            unlisted[state] = unlisted.get(state, 0.0) + tail.probability * share
        for name, share in tail.effects.items():
            effects[name] = effects.get(name, 0.0) + tail.probability * share
        held_families = {hypotheses[name].family for name in tail.members}
        for family in held_families | set(tail.families):
            share = 1.0 if family in held_families else tail.families[family]
            families[family] = families.get(family, 0.0) + tail.probability * share
    kinds: tuple[tuple[Kind, dict[str, float]], ...] = (
        ("effect", effects), ("family", families), ("unlisted", unlisted),
    )  # fmt: skip
    findings = [Finding(kind, name, min(p, 1.0)) for kind, found in kinds for name, p in found.items()]
    findings.sort(key=lambda f: (-f.probability, f.kind, f.name))
    named = [f for f in findings if f.kind == "effect" and f.probability >= NAMED]
    named += _named_families(table, hypotheses, families, frozenset(f.name for f in named))
    sizes = {f.name: sizes_of(table, hypotheses, f.name) for f in named if f.kind == "effect"}
    inexact = {name: inexact_probability(table, name) for name in sizes}
    return Posterior(tuple(findings), tuple(named), nothing, sizes, table.left, table.is_undecided, inexact)


def _named_families(
    table: Table, hypotheses: Mapping[str, Hypothesis], families: Mapping[str, float], effects: frozenset[str]
) -> list[Finding]:
    """Return the families of which a member acts that isn't among the named effects, with that probability."""
    further: dict[str, float] = {}
    for row in table.rows:
        for family in {hypotheses[name].family for name in row.members - effects}:
            further[family] = further.get(family, 0.0) + row.probability
    held = {hypotheses[name].family for name in effects}
    found = [Finding("family", name, further.get(name, 0.0) if name in held else p) for name, p in families.items()]
    return sorted((f for f in found if f.probability >= NAMED), key=lambda f: (-f.probability, f.name))


def inexact_probability(table: Table, name: str) -> float:
    """Return p(the laws of a set are wrong by more than they declare | the effect acts), over the refitted sets."""
    held = [(row.probability, table.fits[row.members].inexact) for row in table.rows
            if row.refitted and name in row.members]  # fmt: skip
    total = sum(p for p, _ in held)
    return sum(p * inexact for p, inexact in held) / total if total > 0.0 else 0.0


def sizes_of(table: Table, hypotheses: Mapping[str, Hypothesis], name: str) -> tuple[Size, ...]:
    """Return an effect's parameters in their own units, as mixtures over the refitted sets that hold it."""
    every = parameter_draws(table, name)
    found = []
    for k, c in enumerate(hypotheses[name].coordinates if len(every) else ()):
        u = np.clip(every[:, k], c.lower, c.upper)
        low, high = np.quantile(u, [0.025, 0.975])
        determined = c.is_shape or not low <= 0.0 <= high
        value = u if c.to_value is None else np.array([c.to_value(float(x)) for x in u])
        interval = np.quantile(value, [0.025, 0.975])
        found.append(
            Size(c.name, float(value.mean()), float(value.std()), (float(interval[0]), float(interval[1])), determined)
        )
    return tuple(found)


def weights_of_sets(table: Table, name: str) -> dict[frozenset[str], float]:
    """Return the refitted sets that hold an effect, with their probabilities given that one of them holds."""
    weights: dict[frozenset[str], float] = {}
    for row in table.rows:
        if row.refitted and name in row.members:
            weights[row.members] = weights.get(row.members, 0.0) + row.probability
    total = sum(weights.values())
    return {members: w / total for members, w in weights.items()} if total > 0.0 else {}


def parameter_draws(table: Table, name: str) -> FloatArray:
    """Draw an effect's parameters u (k, p) from the mixture of the refitted sets that hold it, each over its modes."""
    rng = np.random.default_rng(0)
    draws: list[FloatArray] = []
    rows = [row for row in table.rows if row.refitted and name in row.members]
    total = sum(row.probability for row in rows)
    weights: dict[tuple[frozenset[str], int], tuple[FittedSet, float]] = {}
    for row in rows:
        fit = table.fits[row.members].given(row.unlisted)
        key = row.members, id(fit)
        weights[key] = fit, row.probability / total + (weights[key][1] if key in weights else 0.0)
    for best, weight in weights.values():
        modes = (best, *best.others)
        log = np.array([best.base - best.shift, *(m.base for m in best.others)])
        shares = np.exp(log - log.max())
        for fit, share in zip(modes, shares / shares.sum(), strict=True):
            own = parameter_slice(fit, name)
            count = round(_DRAWS * weight * float(share))
            if count:
                u = fit.state[name].u + fit.laplace.mean[own]
                draws.append(rng.multivariate_normal(u, fit.laplace.covariance[own, own], count, check_valid="ignore"))
    return np.concatenate(draws) if draws else np.zeros((0, 0))


def parameter_slice(fit: FittedSet, name: str) -> slice:
    """Return where an effect's parameters stand among all of a fitted set."""
    first = 0
    for other in fit.state:
        if other == name:
            break
        first += len(fit.state[other].u)
    return slice(first, first + len(fit.state[name].u))


def verdict(posterior: Posterior, least_nothing: float, check_passed: bool) -> Verdict:
    """Return the verdict. `least_nothing`: p(nothing) that 1 % of healthy draws fall short of."""
    calm = all(f.probability < LIKELIER for f in posterior.findings if f.kind == "unlisted")
    if posterior.nothing > least_nothing and check_passed:
        return "no_mismatch"
    if not posterior.named:
        return "unexplained"
    return "explained" if calm and check_passed else "partly_explained"


def healthy_nothing(search: Search, draws: int, rate: float, rng: np.random.Generator) -> float:
    """Return the p(no effect, nothing unlisted) of which a share `rate` of healthy draws falls short.

    Each draw has noise, theta and everyday delta of their priors; its table holds the empty set, all single effects in
    closed form and all single flips."""
    return float(np.quantile(search.healthy_draws(draws, rng), rate))
