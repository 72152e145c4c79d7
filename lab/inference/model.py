"""The generative model of everything that was measured on one side, and its Gaussian.

    y = m(theta, e_A) + H delta + noise,   noise ~ N(0, S),   theta ~ N(theta_0, P),   delta_g ~ N(0, tau_g^2 K_g)

y       the numbers of all observables, stacked
m       their prediction by the chain of light, linear in theta about the fit: J theta
A       the active hypotheses (`hypotheses.py`), each with its parameters u in place of e
H       changes of m by a disturbance of a state of the chain (`discrepancy.py`); H_g has a factor of K_g in it, so that
        delta is a vector of independent standard normal numbers times tau_g

Everything but u and tau enters linearly: theta and delta are marginalised in closed form. This module knows nothing of
cameras: `camera.py` binds it to a recording set, a test to a toy."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, eigh
from scipy.linalg.lapack import dpotri

from lab.observables.gaussian import Gaussian
from sim.spectrum import FloatArray


@dataclass(frozen=True)
class Point:
    """A hypothesis at given parameters: u (p,), and what the model needs besides to predict it (`template`: an effect
    with its choices; None in a toy)."""

    u: FloatArray
    template: Any = None

    def at(self, u: FloatArray) -> Point:
        """Return the same hypothesis at other parameters."""
        return replace(self, u=u)


#: A set of hypotheses at their parameters, by name.
State = Mapping[str, Point]


class Model(Protocol):
    """What the search asks of a model."""

    @property
    def value(self) -> FloatArray:
        """y, (n,)."""

    @property
    def groups(self) -> Sequence[Group]:
        """The groups of small physics that no hypothesis lists."""

    def mean(self, state: State) -> FloatArray:
        """m under these hypotheses, at the linearisation point of theta, (n,)."""

    def gaussian(self, state: State, form_scale: float) -> Gaussian:
        """N(m, S + J P J'), with the form errors of the active hypotheses at `form_scale` times their declared
        tolerance."""

    def has_form_error(self, state: State) -> bool:
        """Whether any of these hypotheses declares a form tolerance."""


@dataclass(frozen=True)
class Process:
    """One Gaussian process of a group: its values f (k,) at its nodes, given the coefficients d (r,) of the group's
    columns, d ~ N(0, tau^2):

        f = values d + f',   f' ~ N(0, tau^2 rest)

    f' is what the numbers don't show. `curve`: what the nodes are; None in a toy."""

    values: FloatArray  # (k, r)
    rest: FloatArray  # (k, k)
    curve: Any = None


@dataclass(frozen=True)
class Group:
    """Columns H (n, r) of delta that share one scale, at tau = 1, and the state of the chain that they act on (`name`).

    `everyday`: s_g; tau is half-normal with this standard deviation, in the same unit. 0: there is none but where it is
    unlisted. Unlisted physics has tau log-uniform from `least` to `largest`; 0: it is never unlisted. What is unlisted
    acts along one axis of a state: of each state, one group holds everything that is everyday, and each process is a
    group of its own, which is there where it is unlisted."""

    name: str
    columns: FloatArray
    everyday: float
    unit: str = "1"
    source: str = ""
    largest: float = 1.0
    held_out: FloatArray | None = None  # the same columns at the held-out numbers, (n*, r)
    process: Process | None = None
    least: float | None = None  # None: 3 `everyday`

    @property
    def may_be_unlisted(self) -> bool:
        """Whether unlisted physics may act so."""
        return self.largest > 0.0

    def varies(self, unlisted: bool) -> bool:
        """Whether tau has more than one value."""
        return unlisted or self.everyday > 0.0

    def scales(self, unlisted: bool) -> FloatArray:
        """Return the points of tau at which it is integrated: medians of shares of the prior (`shares`)."""
        if not self.varies(unlisted):
            return np.zeros(1)
        edges = np.concatenate([[0.0], np.cumsum(self.shares(unlisted))])
        middle = 0.5 * (edges[:-1] + edges[1:])
        if not unlisted:
            return self.everyday_quantile(middle)
        low, high = np.log(3.0 * self.everyday if self.least is None else self.least), np.log(self.largest)
        return np.exp(low + middle * (high - low))

    def shares(self, unlisted: bool) -> FloatArray:
        """Return the prior probabilities of the points. Everyday ones are closer in the tail: of a dozen groups that
        the numbers determine well, one lies there."""
        if not self.varies(unlisted):
            return np.ones(1)
        return np.full(SCALES, 1.0 / SCALES) if unlisted else EVERYDAY_SHARES

    def everyday_quantile(self, share: FloatArray) -> FloatArray:
        """Return the quantiles of the everyday prior of tau."""
        return np.asarray(self.everyday * _half_normal_quantile(share))


#: Points of tau for every unlisted group, and the prior probabilities of those of everyday ones.
SCALES = 7
EVERYDAY_SHARES = np.array([0.22, 0.22, 0.22, 0.18, 0.1, 0.045, 0.015])
#: Shares of the declared form tolerances: midpoints of equal shares of a standard half-normal distribution.
FORM_SHARES = 3
#: Probability that the laws of a set are wrong by several times what they declare, and by how many times.
FORM_UNLISTED, FORM_BEYOND = 0.05, (3.0, 6.7)


def _half_normal_quantile(share: FloatArray) -> FloatArray:
    from scipy.special import ndtri

    return np.asarray(ndtri(0.5 + 0.5 * share))


@dataclass(frozen=True)
class FormScale:
    """A scale of form errors, as a multiple of the declared tolerances, and its log prior probability."""

    share: float
    log_prior: float

    @property
    def is_inexact(self) -> bool:
        """Whether laws are wrong by more than they declare."""
        return self.share > 1.0


def everyday_forms(has_form_error: bool) -> tuple[FormScale, ...]:
    """Return the everyday scales of form errors: equally probable points of a half-normal distribution; 0 alone where
    nothing declares a tolerance."""
    if not has_form_error:
        return (FormScale(0.0, 0.0),)
    shares = _half_normal_quantile((np.arange(FORM_SHARES) + 0.5) / FORM_SHARES)
    log_prior = float(np.log1p(-FORM_UNLISTED) - np.log(FORM_SHARES))
    return tuple(FormScale(float(share), log_prior) for share in shares)


def unlisted_forms() -> tuple[FormScale, ...]:
    """Return the scales of form errors beyond everyday: equally probable points of a log-uniform distribution from 2
    to 10 times the declared tolerance."""
    log_prior = float(np.log(FORM_UNLISTED) - np.log(len(FORM_BEYOND)))
    return tuple(FormScale(share, log_prior) for share in FORM_BEYOND)


def with_columns(gaussian: Gaussian, columns: FloatArray) -> Gaussian:
    """Return the Gaussian with more independent standard normal coefficients: C + columns columns'."""
    return replace(gaussian, shared_jacobian=np.column_stack([gaussian.shared_jacobian, columns]))


def everyday_scales(groups: Sequence[Group]) -> FloatArray:
    """Return the median everyday tau of every group, (G,)."""
    return np.array([g.everyday * _half_normal_quantile(np.array(0.5)) for g in groups])


def scaled_columns(groups: Sequence[Group], tau: FloatArray, n: int) -> FloatArray:
    """Columns of all groups that are there times their tau, (n, R)."""
    return np.column_stack([np.zeros((n, 0)), *(t * g.columns for g, t in zip(groups, tau, strict=True) if t > 0.0)])


@dataclass(frozen=True)
class ScaleIntegral:
    """Marginal likelihood as a function of the scales tau of all groups, the parameters u of the active hypotheses
    marginalised in the linear problem about their mode.

    In whitened coordinates in which S + J P J' = 1: residual r (n,) at the mode, W = [H, J_u] (n, R + p). The prior of
    u is normal there, with `precision` (p,) and centre `pull` / precision from the mode:

        log p = 1/2 b' (M + Q)^-1 b - 1/2 log det(1 + Q^-1 M) + const,  M = W'W, b = W'r + pull, Q = diag(1/tau^2,
        precision)
    """

    gram: FloatArray
    projected: FloatArray
    group_sizes: tuple[int, ...]
    precision: FloatArray
    groups: tuple[Group, ...]
    prior_log: FloatArray  # log prior of u_g = 0 and of u_g = 1, of each group, (2, G)
    _known: dict[bytes, float] = field(default_factory=dict)
    _known_spectra: dict[bytes, Mapping[int, tuple[FloatArray, FloatArray]]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        gaussian: Gaussian,
        residual: FloatArray,
        groups: Sequence[Group],
        jacobian: FloatArray,
        precision: FloatArray,
        pull: FloatArray,
        any_unlisted: float,
    ) -> ScaleIntegral:
        """From the Gaussian without delta at the mode, the residual there (n,), and the Jacobian by u (n, p)."""
        columns = np.column_stack([*(g.columns for g in groups), jacobian]) if groups else jacobian
        white = gaussian.whiten(np.column_stack([columns, residual]))
        table, r = white[:, :-1], white[:, -1]
        projected = table.T @ r
        projected[len(projected) - len(pull) :] += pull
        return cls(
            table.T @ table, projected, tuple(g.columns.shape[1] for g in groups), precision, tuple(groups),
            cls.log_priors(groups, any_unlisted),
        )  # fmt: skip

    @staticmethod
    def log_priors(groups: Sequence[Group], any_unlisted: float) -> FloatArray:
        """Return the log prior of u_g = 0 and of u_g = 1 of each group, (2, G): equal for all states, and for all
        groups of a state."""
        able = [g.name for g in groups if g.may_be_unlisted]
        one = 1.0 - (1.0 - any_unlisted) ** (1.0 / max(len(set(able)), 1))
        share = {name: 1.0 / able.count(name) for name in able}
        with np.errstate(divide="ignore"):
            return np.array([
                [np.log1p(-one) * share.get(g.name, 0.0) if g.may_be_unlisted else 0.0 for g in groups],
                [np.log(one * share[g.name]) if g.may_be_unlisted else -np.inf for g in groups],
            ]).reshape(2, len(groups))  # fmt: skip

    def log_likelihood(self, tau: FloatArray) -> float:
        """Log marginal likelihood at these scales (G,), up to a constant of the set."""
        key = tau.tobytes()
        if key not in self._known:
            there, scale, factor = self._factored(tau)
            b = scale * self.projected[there]
            log_det = 2.0 * float(np.log(np.diag(factor[0])).sum())
            self._known[key] = 0.5 * float(b @ cho_solve(factor, b, check_finite=False)) - 0.5 * log_det
        return self._known[key]

    def _factored(self, tau: FloatArray) -> tuple[NDArray[np.intp], FloatArray, tuple[FloatArray, bool]]:
        """Return which coefficients are there at these scales, their amplitudes D, and the Cholesky factor of
        D M D + diag(1, precision)."""
        amplitude = np.concatenate([np.repeat(tau, self.group_sizes), np.ones(len(self.precision))])
        there = np.flatnonzero(amplitude)
        scale, split = amplitude[there], len(there) - len(self.precision)
        inner = scale[:, None] * self.gram[np.ix_(there, there)] * scale
        inner[np.diag_indices_from(inner)] += np.concatenate([np.ones(split), self.precision])
        return there, scale, cho_factor(inner, lower=True, check_finite=False)

    def profile(self, g: int, tau: FloatArray, points: FloatArray) -> FloatArray:
        """Log marginal likelihood at these scales with tau_g at each of `points` (k,)."""
        return self.profiles(g, tau, points, self.projected[:, None])[:, 0]

    def profiles(self, g: int, tau: FloatArray, points: FloatArray, projected: FloatArray) -> FloatArray:
        """Return the same (k, m) for m residuals, given their W'r (R + p, m)."""
        size, power, rest = self._left_of(g, tau, projected)
        t2 = np.square(points)[:, None]
        return np.asarray(rest + 0.5 * ((t2 / (1.0 + t2 * size)) @ power - np.log1p(t2 * size).sum(1)[:, None]))

    def _left_of(self, g: int, tau: FloatArray, projected: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the eigenvalues (k,) of what the others leave of group g's part (Schur complement), the squares (k, m)
        of the residuals along its eigenvectors, and the log marginal likelihood (m,) without the group."""
        amplitude = np.concatenate([np.repeat(tau, self.group_sizes), np.ones(len(self.precision))])
        ends = np.cumsum(self.group_sizes)
        own = np.zeros(len(amplitude), bool)
        own[ends[g] - self.group_sizes[g] : ends[g]] = True
        rest = ~own & (amplitude > 0.0)
        scale = amplitude[rest]
        inner = scale[:, None] * self.gram[np.ix_(rest, rest)] * scale
        inner[np.diag_indices_from(inner)] += np.concatenate(
            [np.ones(int(rest.sum()) - len(self.precision)), self.precision]
        )
        across, b, b_own = (
            scale[:, None] * self.gram[np.ix_(rest, own)],
            scale[:, None] * projected[rest],
            projected[own],
        )
        square = self.gram[np.ix_(own, own)]
        total = np.zeros(projected.shape[1])
        if len(inner):
            factor = cho_factor(inner, lower=True, check_finite=False)
            solved = cho_solve(factor, np.column_stack([across, b]), check_finite=False)
            left, right = solved[:, : across.shape[1]], solved[:, across.shape[1] :]
            square, b_own = square - across.T @ left, b_own - across.T @ right
            total = 0.5 * np.einsum("ij,ij->j", b, right) - float(np.log(np.diag(factor[0])).sum())
        size, vectors = eigh(square)
        return np.maximum(size, 0.0), np.square(vectors.T @ b_own), total

    def profiles_of_processes(self, tau: FloatArray, projected: FloatArray) -> Iterator[tuple[int, FloatArray]]:
        """Yield each group that is there only where it is unlisted, with its gain of log marginal likelihood at the
        points of its scale (k, m) for m residuals, given their W'r (R + p, m) and the scales of the others: one
        factorisation for all."""
        which = [g for g, group in enumerate(self.groups) if group.may_be_unlisted and not group.varies(False)]
        amplitude = np.concatenate([np.repeat(tau, self.group_sizes), np.ones(len(self.precision))])
        there = np.flatnonzero(amplitude)
        scale, split = amplitude[there], len(amplitude) - len(self.precision)
        inner = scale[:, None] * self.gram[np.ix_(there, there)] * scale
        inner[np.diag_indices_from(inner)] += np.concatenate([np.ones(split), self.precision])[there]
        factor = cho_factor(inner, lower=True, check_finite=False) if len(there) else None
        right = np.zeros((0, projected.shape[1]))
        if factor is not None:
            right = cho_solve(factor, scale[:, None] * projected[there], check_finite=False)
        ends = np.cumsum(self.group_sizes)
        for g in which:
            own = np.arange(ends[g] - self.group_sizes[g], ends[g])
            across = scale[:, None] * self.gram[np.ix_(there, own)]
            left = across if factor is None else cho_solve(factor, across, check_finite=False)
            size, vectors = eigh(self.gram[np.ix_(own, own)] - across.T @ left)
            size, power = np.maximum(size, 0.0), np.square(vectors.T @ (projected[own] - across.T @ right))
            t2 = np.square(self.groups[g].scales(True))[:, None]
            yield g, 0.5 * ((t2 / (1.0 + t2 * size)) @ power - np.log1p(t2 * size).sum(1)[:, None])

    def _spectra(self, tau: FloatArray) -> Mapping[int, tuple[FloatArray, FloatArray]]:
        """Return the eigenvalues of what the others leave of each group's part (Schur complement), and the squares of
        the residual along its eigenvectors, for all groups that are there at these scales: with A = 1 + D M D, D the
        amplitudes, group g's block of A^-1 is (1 + tau_g^2 Q)^-1, Q its Schur complement. One factorisation for all but
        those whose block of A^-1 is lost in rounding (`LEAST_INVERSE`)."""
        key = tau.tobytes()
        if key not in self._known_spectra:
            there, scale, factor = self._factored(tau)
            solved = cho_solve(factor, scale * self.projected[there], check_finite=False)
            inverse = dpotri(factor[0], lower=True)[0]
            ends = np.cumsum(self.group_sizes)
            place = np.full(len(self.projected), -1)
            place[there] = np.arange(len(there))
            found = {}
            for g in np.flatnonzero(tau):
                own = place[ends[g] - self.group_sizes[g] : ends[g]]
                value, vectors = eigh(inverse[np.ix_(own, own)], lower=True)
                if value[0] < LEAST_INVERSE:
                    size, power, _ = self._left_of(int(g), tau, self.projected[:, None])
                    found[int(g)] = size, power[:, 0]
                    continue
                size = (1.0 / np.minimum(value, 1.0) - 1.0) / tau[g] ** 2
                found[int(g)] = size, np.square(vectors.T @ solved[own] / value / tau[g])
            self._known_spectra[key] = found
        return self._known_spectra[key]

    def gains(self, g: int, tau: FloatArray, points: FloatArray) -> FloatArray:
        """Return what the log marginal likelihood gains with tau_g at each of `points` (k,) in place of its own value,
        which isn't 0, and the others as they are."""
        size, power = self._spectra(tau)[g]
        t2 = np.square(np.append(points, tau[g]))[:, None]
        values = 0.5 * ((t2 / (1.0 + t2 * size)) @ power - np.log1p(t2 * size).sum(1))
        return np.asarray(values[:-1] - values[-1])

    def _climb(self, tau: FloatArray, which: Iterable[int], unlisted: frozenset[int]) -> FloatArray:
        """Return the scales (G,) at a mode along each of the coordinates of `which`: of these that moves which gains
        most, until none gains."""
        tau, which = tau.copy(), list(which)
        log = {g: np.log(self.groups[g].shares(g in unlisted)) for g in which}
        points = {g: self.groups[g].scales(g in unlisted) for g in which}
        for g in which:
            if tau[g] == 0.0:
                tau[g] = points[g][int(np.argmax(self.profile(g, tau, points[g]) + log[g]))]
        for _ in range(MOST_MOVES):
            best, moved = 1e-9, None
            for g in which:
                gains = self.gains(g, tau, points[g]) + log[g]
                now = float(np.interp(tau[g], points[g], log[g]))
                top = int(np.argmax(gains))
                if gains[top] - now > best and points[g][top] != tau[g]:
                    best, moved = float(gains[top] - now), (g, points[g][top])
            if moved is None:
                break
            tau[moved[0]] = moved[1]
        return tau

    def integrated(self, tau: FloatArray, unlisted: frozenset[int]) -> float:
        """Log marginal likelihood with every tau integrated over its points, by one-dimensional integrals about
        `tau`, a mode along each coordinate."""
        total = self.log_likelihood(tau)
        for g, group in enumerate(self.groups):
            if group.varies(g in unlisted):
                total += log_mean(self.gains(g, tau, group.scales(g in unlisted)), group.shares(g in unlisted))
        return total

    @cached_property
    def _everyday_groups(self) -> list[int]:
        return [g for g, group in enumerate(self.groups) if group.varies(False)]

    @cached_property
    def everyday_mode(self) -> FloatArray:
        """The likeliest everyday scales (G,)."""
        return self._climb(everyday_scales(self.groups), self._everyday_groups, frozenset())

    @cached_property
    def everyday(self) -> float:
        """Log marginal likelihood with all groups everyday."""
        return self._flips[0]

    @cached_property
    def _flips(self) -> tuple[float, dict[int, float]]:
        """Log marginal likelihood with all groups everyday, and what it gains by each group's flip, the scales of the
        others as without: a lower bound of the gain."""
        tau, flips = self.everyday_mode, dict[int, float]()
        everyday = self.log_likelihood(tau)
        for g, gains in self.profiles_of_processes(tau, self.projected[:, None]):
            flips[g] = log_mean(gains[:, 0], self.groups[g].shares(True))
        for g in self._everyday_groups:
            group = self.groups[g]
            usual, other = group.scales(False), group.scales(True) if group.may_be_unlisted else np.zeros(0)
            values = self.gains(g, tau, np.concatenate([usual, other]))
            usual_log = log_mean(values[: len(usual)], group.shares(False))
            everyday += usual_log
            if group.may_be_unlisted:
                flips[g] = log_mean(values[len(usual) :], group.shares(True)) - usual_log
        return everyday, flips

    @cached_property
    def quick(self) -> tuple[float, float]:
        """Log marginal likelihood and prior with all groups everyday, and summed over single flips, the scales of the
        others as without: a lower bound."""
        everyday, flips = self._flips
        priors = [gain + self.log_prior(frozenset((g,))) for g, gain in flips.items()]
        return everyday + self.log_prior(frozenset()), everyday + log_sum_exp(priors)

    def mode(self, unlisted: frozenset[int]) -> FloatArray:
        """The likeliest scales (G,) with these groups unlisted."""
        if not unlisted:
            return self.everyday_mode
        if unlisted not in self._modes:
            tau = self._climb(self.everyday_mode, sorted(unlisted), unlisted)
            every = sorted(unlisted.union(self._everyday_groups))
            self._modes[unlisted] = self._climb(tau, every, unlisted)
        return self._modes[unlisted]

    @cached_property
    def _modes(self) -> dict[frozenset[int], FloatArray]:
        return {}

    def stratified(self, unlisted: frozenset[int], count: int) -> FloatArray:
        """Return scales (count, G) of their posterior with these groups unlisted: a Latin hypercube of the quantiles of
        each group's, the others at their mode."""
        tau = self.mode(unlisted)
        rng = np.random.default_rng(0)
        found = np.tile(tau, (count, 1))
        for g, group in enumerate(self.groups):
            if not group.varies(g in unlisted):
                continue
            points = group.scales(g in unlisted)
            values = self.gains(g, tau, points)
            weight = group.shares(g in unlisted) * np.exp(values - values.max())
            share = (np.cumsum(weight) - 0.5 * weight) / weight.sum()
            found[:, g] = np.interp((rng.permutation(count) + 0.5) / count, share, points)
        return found

    def flipped(self, unlisted: frozenset[int]) -> float:
        """Log marginal likelihood with these groups unlisted, the scales of the others again at their mode."""
        return self.integrated(self.mode(unlisted), unlisted)

    def log_prior(self, unlisted: frozenset[int]) -> float:
        """Log prior probability of exactly these groups being unlisted."""
        is_unlisted = np.isin(np.arange(len(self.groups)), list(unlisted))
        return float(np.where(is_unlisted, self.prior_log[1], self.prior_log[0]).sum())

    def weights(self, least: float = 5.0) -> dict[frozenset[int], float]:
        """Log of p(y | A, u) p(u) of no, single and pair flips, and of larger ones about the best. Of flips that are
        more than `least` below the best, and of all but the `REFINED` likeliest, it is that with the scales of the
        others as without; pairs are of the likeliest groups that aren't, by themselves. The best is extended by the
        groups that promise most in addition: the rest of a process may be far above noise, and a small part of it."""
        none: frozenset[int] = frozenset()
        found = {none: self.everyday + self.log_prior(none)}
        roughly = {g: self.everyday + gain + self.log_prior(frozenset((g,))) for g, gain in self._flips[1].items()}
        top = max([found[none], *roughly.values()])
        for rank, g in enumerate(sorted(roughly, key=lambda g: -roughly[g])):
            one, is_near = frozenset((g,)), rank < REFINED and roughly[g] > top - least
            found[one] = self.flipped(one) + self.log_prior(one) if is_near else roughly[g]
        top = max(found.values())
        near = sorted((s for s in found if len(s) == 1 and found[s] > top - least), key=lambda s: -found[s])[:PAIRED]
        for i, a in enumerate(near):
            for b in near[:i]:
                pair = a | b
                found[pair] = self.flipped(pair) + self.log_prior(pair)
        best = max(found, key=lambda u: found[u])
        while 0 < len(best) < MOST_UNLISTED:
            more = [u for u in self._extended(best) if u not in found]
            found |= {u: self.flipped(u) + self.log_prior(u) for u in more}
            larger = max((u for u in found if best < u), key=lambda u: found[u], default=best)
            if found[larger] <= found[best]:
                break
            best = larger
        return found

    def _extended(self, unlisted: frozenset[int], least: float = 3.0) -> list[frozenset[int]]:
        """Return these groups and one more: of those that are at most `least` less likely, the `PAIRED` likeliest."""
        tau, prior = self.mode(unlisted), self.log_prior(unlisted)
        found = {}
        for g, gains in self.profiles_of_processes(tau, self.projected[:, None]):
            more = unlisted | {g}
            if g not in unlisted:
                found[more] = log_mean(gains[:, 0], self.groups[g].shares(True)) + self.log_prior(more) - prior
        near = sorted((u for u in found if found[u] > -least), key=lambda u: -found[u])
        return near[:PAIRED]


#: Groups of which all pairs are tried, and by which the best set is extended; the most that are unlisted; and those
#: with which the scales of the others are at their mode again.
PAIRED, MOST_UNLISTED, REFINED = 4, 4, 8


#: Smallest eigenvalue of a block of an inverse, whose rounding is 1e-16, that is known to 1e-8.
LEAST_INVERSE = 1e-8
#: Moves of the scales to a mode along each coordinate, at most.
MOST_MOVES = 30


def log_mean(values: FloatArray, shares: FloatArray) -> float:
    """Log of the mean of exp(values) over points of these probabilities."""
    top = float(values.max())
    return top + float(np.log(shares @ np.exp(values - top)))


def log_sum_exp(values: Sequence[float]) -> float:
    """log sum exp of some numbers; -inf of none."""
    if not len(values):
        return -np.inf
    top = max(values)
    return float(top) if not np.isfinite(top) else top + float(np.log(np.sum(np.exp(np.asarray(values) - top))))
