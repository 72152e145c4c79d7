"""Effects and families with their inclusion probabilities, sizes and rivals, read off the table of one side."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lab.diagnose.evidence.side_table import SideTable
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.outcome.next_capture import NOTHING, WITH
from lab.inference.hypotheses import Coordinate
from lab.inference.posterior import Size, parameter_draws, parameter_slice, sizes_of, weights_of_sets
from lab.inference.search import FittedSet, Table
from sim.effects.base import Effect
from sim.effects.library import effects as library
from sim.spectrum import FloatArray

#: From this inclusion probability on a cause is described; sides may raise one another's.
LEAST_DESCRIBED = 0.02
#: From this probability on, and so many of them, rivals and members of a family are listed.
LEAST_LISTED, MOST_LISTED = 0.001, 6
#: Share of an effect's posterior that another mode has to hold to be listed.
LEAST_MODE = 0.05
#: Share of draws of one sign from which on the sign of a parameter is known.
SIGN_KNOWN = 0.975
#: chi2 of an effect's change from which on a measurement shows it (five standard deviations), and its least share of
#: the strongest measurement's.
SHOWN_CHI2, SHOWN_SHARE = 25.0, 0.02


@dataclass(frozen=True)
class Cause:
    """An effect, or a family of which no member is named, with its inclusion probability on one side.

    `effect`: the law whose parameters these are, at the mode of its likeliest set. `prior`: inclusion probability
    before the recordings. `mean` (p,), `covariance` (p, p): of its parameters u, over the mixture; `coordinates`: these
    with their priors. `members`: of a
    family, with their inclusion probabilities, likeliest first. `rivals`: what stands in its place in the sets without
    it, with their probabilities. `inexact`: probability that its law's error is above the declared tolerance, or that
    unlisted physics acts where it does, given the name. `alike`: the effect by other choices that remain probable."""

    name: str
    effect: Effect
    probability: float
    prior: float
    sizes: tuple[Size, ...]
    mean: FloatArray
    covariance: FloatArray
    inexact: float
    members: tuple[tuple[str, float], ...] = ()
    rivals: tuple[tuple[str, float], ...] = ()
    unsigned: frozenset[str] = frozenset()
    modes: tuple[dict[str, float], ...] = ()
    alike: tuple[Effect, ...] = ()
    shown_in: tuple[str, ...] = ()
    coordinates: tuple[Coordinate, ...] = ()

    @property
    def kind(self) -> type[Effect]:
        """The law's class."""
        return type(self.effect)

    @property
    def is_of_the_set(self) -> bool:
        """Whether the cause is the light, the screen or the chart, which both sides share, and not the camera."""
        return self.kind.stages() == ("light",)


def causes_of(reading: SideTable) -> tuple[Cause, ...]:
    """Return the effects that may be named, and the families of which another member acts, likeliest first."""
    posterior = reading.posterior
    named = frozenset(f.name for f in posterior.named if f.kind == "effect")
    found = []
    for finding in posterior.findings:
        is_described = finding.probability >= LEAST_DESCRIBED and finding.name not in reading.statements
        if finding.kind == "effect" and is_described and weights_of_sets(reading.table, finding.name):
            alone = frozenset((finding.name,))
            found.append(_cause(reading, finding.name, finding.name, finding.probability, (), alone))
    for finding in posterior.named:
        if finding.kind != "family" or finding.name in reading.statements:
            continue
        members = members_of(reading, finding.name, named)
        of_effects = (name for name, _ in members if name not in reading.statements)
        law = next((name for name in of_effects if weights_of_sets(reading.table, name)), "")
        if law:
            every = frozenset(f.name for f in posterior.findings if f.kind == "effect")
            alternatives = frozenset(n for n in every - named if reading.family_of(n) == finding.name)
            found.append(_cause(reading, finding.name, law, finding.probability, members, alternatives))
    return tuple(sorted(found, key=lambda cause: -cause.probability))


def members_of(reading: SideTable, family: str, without: frozenset[str] = frozenset()) -> tuple[tuple[str, float], ...]:
    """Return a family's effects with their inclusion probabilities, likeliest first, `without` those that are named."""
    found = [
        (f.name, f.probability)
        for f in reading.posterior.findings
        if f.kind == "effect" and f.name not in without and reading.search.hypotheses[f.name].family == family
    ]
    return tuple((n, p) for n, p in found if p >= LEAST_LISTED)[:MOST_LISTED]


def _cause(
    reading: SideTable,
    name: str,
    law: str,
    probability: float,
    members: tuple[tuple[str, float], ...],
    alternatives: frozenset[str],
) -> Cause:
    table, hypothesis = reading.table, reading.search.hypotheses[law]
    weights = weights_of_sets(table, law)
    members_of_best = max(weights, key=lambda key: weights[key])
    best = table.fits[members_of_best].given(reading.unlisted_with(members_of_best))
    effect = next(e for e in reading.effects_of(best.state) if e.name == law)
    draws = parameter_draws(table, law)
    prior = sum(reading.inclusion_prior[n] for n in alternatives)
    mean = draws.mean(axis=0)
    return Cause(
        name=name,
        effect=effect,
        probability=probability,
        prior=prior,
        sizes=sizes_of(table, reading.search.hypotheses, law),
        mean=mean,
        covariance=np.atleast_2d(np.cov(draws.T)),
        inexact=_inexact(reading, alternatives),
        members=members,
        rivals=_rivals(reading, alternatives),
        unsigned=frozenset(
            c.name
            for k, c in enumerate(hypothesis.coordinates)
            if not c.is_shape
            and (np.isneginf(c.lower) or c.lower < 0.0)
            and max(np.mean(draws[:, k] > 0.0), np.mean(draws[:, k] < 0.0)) < SIGN_KNOWN
            and not _holds_absence(draws[:, k])
        ),
        modes=tuple(_modes(reading, law, best, draws)),
        alike=tuple(_other_choices(reading, weights, effect)),
        shown_in=shown_in(reading.used, effect, reading.effects_of(best.state)),
        # without their conversions, which can't be sent between processes
        coordinates=tuple(replace(c, to_value=None) for c in hypothesis.coordinates),
    )


def _holds_absence(u: FloatArray) -> bool:
    """Whether the posterior of a size is dense at 0: of one whose sign alone isn't known, it isn't."""
    return float(np.mean(np.abs(u) < 0.25 * np.abs(u).mean())) > 0.05


def _inexact(reading: SideTable, names: frozenset[str]) -> float:
    """Return p(a form error above the declared tolerance, or unlisted physics, given that one of these acts).
    Unlisted groups count where most of what they change lies in measurements that the effect changes."""
    total = inexact = 0.0
    groups = {name: _shared_groups(reading, name) for name in names}
    for row in reading.table.rows:
        here = row.members & names
        if not here:
            continue
        total += row.probability
        if any(row.unlisted & groups[name] for name in here):
            inexact += row.probability
        elif row.refitted:
            inexact += row.probability * reading.table.fits[row.members].inexact
    return inexact / total if total > 0.0 else 0.0


def _shared_groups(reading: SideTable, name: str) -> frozenset[int]:
    """Return the groups of small physics most of whose change lies in the measurements that an effect changes."""
    if name in reading.statements:
        return frozenset()
    kind = library()[name]
    model = reading.used
    touched = np.concatenate([np.full(len(b.value), b.touched_by(kind)) for b in model.blocks])
    std = np.sqrt(np.concatenate([np.diag(b.covariance) for b in model.blocks]))
    found = []
    for k, group in enumerate(reading.problem.groups):
        power = np.square(group.columns / std[:, None]).sum(axis=1)
        if power[touched].sum() > 0.5 * power.sum():
            found.append(k)
    return frozenset(found)


def _rivals(reading: SideTable, names: frozenset[str]) -> tuple[tuple[str, float], ...]:
    """Return what stands in the place of these effects in the sets without them, with their probabilities: the members
    that the likeliest set with one of them hasn't; else unlisted physics; else nothing."""
    table = reading.table
    best = next((row.members for row in table.rows if row.members & names), frozenset[str]())
    found: dict[str, float] = {}
    for row in table.rows:
        if row.members & names:
            continue
        instead = sorted(row.members - best)
        unlisted = [f"unlisted physics of the {state}" for state in table.states(row.unlisted)]
        name = WITH.join(instead or unlisted) or NOTHING
        found[name] = found.get(name, 0.0) + row.probability
    listed = sorted(found.items(), key=lambda item: -item[1])
    return tuple((n, p) for n, p in listed if p >= LEAST_LISTED)[:MOST_LISTED]


def _modes(reading: SideTable, law: str, best: FittedSet, draws: FloatArray) -> Iterator[dict[str, float]]:
    """Yield the parameters at other modes of the posterior, given the effect."""
    spread = np.sqrt(np.diag(best.laplace.covariance)[parameter_slice(best, law)])
    coordinates = reading.search.hypotheses[law].coordinates
    seen = [best.state[law].u]
    fits = [m for key in weights_of_sets(reading.table, law) for m in _modes_of(reading.table, key)]
    for fit, share in fits:
        u = fit.state[law].u
        if share < LEAST_MODE or any(np.all(np.abs(u - other) < 3.0 * spread + 1e-12) for other in seen):
            continue
        seen.append(u)
        yield {
            c.name: float(x) if c.to_value is None else c.to_value(float(x))
            for c, x in zip(coordinates, u, strict=True)
        }


def _modes_of(table: Table, members: frozenset[str]) -> list[tuple[FittedSet, float]]:
    """Return the modes of a set with their shares of the table's probability."""
    fit = table.fits[members]
    modes = [fit, *fit.others]
    log = np.array([fit.base - fit.shift, *(m.base for m in fit.others)])
    weight = np.exp(log - log.max())
    probability = sum(row.probability for row in table.rows if row.members == members)
    return [(m, probability * float(w)) for m, w in zip(modes, weight / weight.sum(), strict=True)]


def _other_choices(reading: SideTable, weights: Mapping[frozenset[str], float], effect: Effect) -> Iterator[Effect]:
    """Yield an effect by its other choices that hold some of the probability."""
    seen = {_choices(effect)}
    for key, weight in weights.items():
        for fit, share in _modes_of(reading.table, key):
            one = next(e for e in reading.effects_of(fit.state) if e.name == effect.name)
            if min(weight, share) > LEAST_MODE and _choices(one) not in seen:
                seen.add(_choices(one))
                yield one


def _choices(effect: Effect) -> tuple[object, ...]:
    return tuple(getattr(effect, name) for name in type(effect).told_choices())


def shown_in(model: MeasurementModel, effect: Effect, effects: Sequence[Effect]) -> tuple[str, ...]:
    """Return the measurements in which an effect's change stands out of the noise beside the others, strongest first;
    only the strongest, where none does."""
    others = tuple(e for e in effects if e.name != effect.name)
    changes: dict[str, float] = {}
    for index in model.affected_blocks(effect):
        name = model.blocks[index].measurement.name
        changes[name] = changes.get(name, 0.0) + model.change_chi2(effect, others, index)
    least = max(SHOWN_CHI2, SHOWN_SHARE * max(changes.values(), default=0.0))
    strongest = sorted(changes, key=lambda name: -changes[name])
    return tuple(name for name in strongest if changes[name] > least) or tuple(strongest[:1])
