"""Fit the parameters of a set of effects to the seen numbers: maximum a posteriori, by Gauss-Newton steps within
bounds."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, least_squares

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.policy import DecisionPolicy
from lab.inference.coordinates import EffectCoordinate, coordinate_prior, coordinates, moved
from lab.observables.gaussian import Gaussian
from sim.camera import CameraModel
from sim.effects.base import Effect, Effects
from sim.spectrum import FloatArray

#: The covariance depends on the parameters through form tolerances: it is updated this often, for a fit to convergence
#: and a rough one.
PASSES, ROUGH_PASSES = 3, 2
#: Evaluations of the prediction in the first pass, likewise; and in later ones.
EVALUATIONS, ROUGH_EVALUATIONS, LATER_EVALUATIONS = 12, 8, 5
#: Step of finite differences, in typical sizes of the coordinate.
DIFFERENCE_STEP = 0.02
#: Shares of the declared form tolerances that are tried, from the whole to the policy's least, by equal factors.
TOLERATED_SHARES = 3
#: Profile intervals end at this many times the fitted distance from absence.
MOST_WIDENED = 100.0


@dataclass(frozen=True)
class Fit:
    """A set of effects at their best parameters.

    `log_posterior` is the log-likelihood and log prior there, less `parameter_log_odds` for every parameter.
    `jacobian` (n, p) is that of the prediction by the coordinates that were fitted.
    `promised_gain`: the log posterior that one more Newton step of all coordinates would gain.
    `tolerated`: the share of the laws' form tolerances by which the seen numbers are likeliest.
    """

    effects: tuple[Effect, ...]
    std: tuple[dict[str, float | None], ...]
    log_likelihood: float
    log_posterior: float
    jacobian: FloatArray
    converged: bool = True  # False: a rough fit
    promised_gain: float = 0.0
    tolerated: float = 1.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(e.name for e in self.effects)

    def jacobian_columns(
        self, effects: Effects, coords: Sequence[EffectCoordinate]
    ) -> dict[EffectCoordinate, FloatArray]:
        """Columns of the Jacobian for the coordinates of those of `effects` that are members of this set with the same
        parameters."""
        fitted = [(e, name) for e, std in zip(self.effects, self.std, strict=True) for name in std]
        column = dict(zip(fitted, self.jacobian.T, strict=True))
        return {c: column[key] for c in coords if (key := (effects[c.index], c.name)) in column}


def log_likelihood(model: MeasurementModel, effects: Effects, policy: DecisionPolicy) -> float:
    """Of the seen numbers under the effects as they stand, with the likeliest share of their form tolerances."""
    return _likeliest_tolerance(model, effects, policy).log_likelihood


class _Tolerated(NamedTuple):
    """A share of the form tolerances, the seen numbers' distribution with it, and their log-likelihood."""

    share: float
    gaussian: Gaussian
    log_likelihood: float


def _likeliest_tolerance(
    model: MeasurementModel, effects: Effects, policy: DecisionPolicy, tolerance: float | None = None
) -> _Tolerated:
    """Return the share of the form tolerances, down to `least_tolerated_share`, by which the seen numbers are
    likeliest; the whole, and `tolerance` at least, where that is given.

    By the declared tolerances alone, of two laws that fit equally well the one with the smaller tolerance is far
    likelier: by 8 in the logarithm for a low-pass filter of 1 % beside a vibration of 5 %, even where the numbers meet
    the vibration's form to a tenth of that."""
    if tolerance is not None:
        gaussian = model.seen_gaussian(effects, 1.0, tolerance)
        return _Tolerated(1.0, gaussian, gaussian.log_likelihood(model.seen_value))
    least = policy.least_tolerated_share
    is_one = least == 1.0 or all(e.form_tolerance == 0.0 for e in effects)
    found = []
    for share in (1.0,) if is_one else np.geomspace(1.0, least, TOLERATED_SHARES).tolist():
        gaussian = model.seen_gaussian(effects, share)
        found.append(_Tolerated(share, gaussian, gaussian.log_likelihood(model.seen_value)))
    return max(found, key=lambda one: one.log_likelihood)


def refit(
    model: MeasurementModel,
    start: Effects,
    policy: DecisionPolicy,
    *,
    rough: bool = False,
    passes: int | None = None,
    beside: Fit | None = None,
    of_any_size: bool = False,
    tolerance: float | None = None,
) -> Fit:
    """Maximum a posteriori of all parameters, from `start`.

    The covariance has the likeliest share of the form tolerances. Standard deviations follow from the Jacobian and hold
    the whole of them: a law's error that has a parameter's own signature moves the parameter, and can't be seen.
    Dispensable parameters stay absent in a converged fit unless they gain `dispensable_log_odds`. `rough`: fewer steps,
    enough to rank sets. `beside`: a fit whose Jacobian is reused for members that stand as they do there; it changes
    little by what joins them. `of_any_size`: sizes far from the usual ones aren't drawn towards them
    (`_wide_residual`), for the values of effects that are named; a law that needs such a size is no likelier by that.
    `tolerance`: the whole of the form tolerances, and this at least, in place of the likeliest share.
    """
    coords = coordinates(start, model.camera)
    known = {} if beside is None else beside.jacobian_columns(start, coords)
    found = _fit(model, tuple(start), coords, policy, rough, passes, known, of_any_size, tolerance)
    spare = [c for c in coords if c.quantity.dispensable]
    if not rough and spare:
        without = moved(found.effects, spare, np.zeros(len(spare)))
        less = _fit(
            model, without, [c for c in coords if c not in spare], policy, rough, passes, {}, of_any_size, tolerance
        )
        found = less if less.log_posterior >= found.log_posterior - policy.dispensable_log_odds else found
    return found


def refit_alone(
    model: MeasurementModel,
    effects: Effects,
    index: int,
    parameter: str,
    sizes: Collection[str],
    policy: DecisionPolicy,
) -> Fit:
    """Return the fit of a set in which of one member's `sizes` only `parameter` is fitted, the others absent; its
    shapes, and the other members, are fitted as always."""
    coords = coordinates(effects, model.camera)
    gone = [c for c in coords if c.index == index and c.name in sizes and c.name != parameter]
    less = moved(effects, gone, np.array([c.to_u(c.absent) for c in gone]))
    return _fit(model, less, [c for c in coords if c not in gone], policy, False, None)


def profile_interval(
    model: MeasurementModel, effects: Effects, index: int, parameter: str, policy: DecisionPolicy
) -> tuple[float, float]:
    """Return the interval of one member's parameter by its profile likelihood, in the parameter's unit (Pawitan, In All
    Likelihood, 2001).

    It holds the values at which the log posterior of all other parameters, fitted there, is within `least_size_sigma`^2
    / 2 of its largest. The parameter itself has no prior. The covariance holds the whole of the form tolerances, as
    standard deviations do. An end to which the posterior doesn't fall is a bound of the parameter, or `MOST_WIDENED`
    times as far from absence as the fit."""
    coords = coordinates(effects, model.camera)
    (one,) = [c for c in coords if c.index == index and c.name == parameter]
    others = [c for c in coords if c is not one]
    low, high = one.bounds
    start = float(np.clip(one.to_u(float(getattr(effects[index], parameter))), low, high))
    absent = one.to_u(one.absent)
    fits: dict[float, tuple[float, tuple[Effect, ...]]] = {}
    drop = 0.5 * policy.least_size_sigma**2

    def profile(u: float) -> float:
        if u not in fits:
            about = fits[min(fits, key=lambda at: abs(at - u))][1] if fits else tuple(effects)
            fit = _fit(model, moved(about, [one], np.array([u])), others, policy, True, None, tolerance=0.0)
            fits[u] = fit.log_posterior, fit.effects
        return fits[u][0]

    def top() -> float:
        return max(fits, key=profile)

    profile(start)
    for direction in (-1.0, 1.0):
        outside, step = start, 0.25 * (abs(start - absent) or one.typical(one.absent))
        while profile(outside) >= profile(top()) - drop and outside != (low if direction < 0.0 else high):
            if abs(outside - absent) > MOST_WIDENED * abs(start - absent):
                break
            outside, step = float(np.clip(outside + direction * step, low, high)), 2.0 * step

    best = top()
    least = profile(best) - drop
    ends = []
    for beyond in ([u for u in fits if u < best], [u for u in fits if u > best]):
        out = [u for u in beyond if profile(u) < least]
        if not out:
            ends.append(max(beyond, key=lambda u: abs(u - best), default=best))
            continue
        first = min(out, key=lambda u: abs(u - best))
        inside = max([best, *(u for u in beyond if abs(u - best) < abs(first - best))], key=lambda u: abs(u - best))
        ends.append(float(brentq(lambda u: profile(u) - least, inside, first, xtol=1e-2 * abs(first - inside))))
    return one.to_value(ends[0]), one.to_value(ends[1])


def _fit(
    model: MeasurementModel,
    effects: tuple[Effect, ...],
    coords: Sequence[EffectCoordinate],
    policy: DecisionPolicy,
    rough: bool,
    passes: int | None,
    known: Mapping[EffectCoordinate, FloatArray] = MappingProxyType({}),
    of_any_size: bool = False,
    tolerance: float | None = None,
) -> Fit:
    """Fit the coordinates `coords`, other parameters as they are. `known`: columns of the Jacobian that aren't computed
    again."""
    seen = model.seen
    if not coords:
        value = _likeliest_tolerance(model, effects, policy, tolerance).log_likelihood
        return Fit(effects, (), value, value, np.zeros((len(model.value), 0)))
    u = np.array([c.to_u(float(getattr(effects[c.index], c.name))) for c in coords])
    low, high = (np.array(b) for b in zip(*(c.bounds for c in coords), strict=True))
    typical = np.array([c.typical(float(getattr(effects[c.index], c.name))) for c in coords])
    prior_centre, prior_std = coordinate_prior(coords)
    tolerated = _likeliest_tolerance(model, moved(effects, coords, u), policy, tolerance)
    for turn in range(passes or (ROUGH_PASSES if rough else PASSES)):

        def residual(at: FloatArray, gaussian: Gaussian = tolerated.gaussian) -> FloatArray:
            white = gaussian.whiten((model.value - model.mean(moved(effects, coords, at)))[seen])
            t = (at - prior_centre) / prior_std
            return np.concatenate([white, _wide_residual(t) if of_any_size else t])

        def residual_jacobian(at: FloatArray, gaussian: Gaussian = tolerated.gaussian) -> FloatArray:
            base = model.mean(moved(effects, coords, at))[seen]
            columns = []
            for k, c in enumerate(coords):
                if c in known:
                    columns.append(-known[c][seen])
                    continue
                step = _difference_step(c, at[k], typical[k], high[k])
                shifted = at.copy()
                shifted[k] += step
                columns.append((base - model.mean(moved(effects, coords, shifted))[seen]) / step)
            white = gaussian.whiten(np.array(columns).T)
            t = (at - prior_centre) / prior_std
            slope = _wide_slope(t) if of_any_size else np.ones_like(t)
            return np.vstack([white, np.diag(slope / prior_std)])

        evaluations = (ROUGH_EVALUATIONS if rough else EVALUATIONS) if turn == 0 else LATER_EVALUATIONS
        result = least_squares(
            residual,
            np.clip(u, low + 1e-9 * typical, high - 1e-9 * typical),
            jac=residual_jacobian,
            bounds=(low, high),
            x_scale=typical,
            max_nfev=evaluations,
            xtol=1e-5,
            ftol=1e-5,
        )
        before, share_before, u = u, tolerated.share, result.x
        tolerated = _likeliest_tolerance(model, moved(effects, coords, u), policy, tolerance)
        if tolerated.share == share_before and np.all(np.abs(u - before) < 1e-3 * typical):
            break
    best = moved(effects, coords, u)
    value = tolerated.log_likelihood
    log_prior = -0.5 * float(np.sum(np.square((u - prior_centre) / prior_std)))
    if of_any_size:
        prior_std = np.maximum(prior_std, np.abs(u - prior_centre))  # of the normal prior with the same slope there
    at_best = _prediction_jacobian(model, best, coords, u, typical, high)
    whitened = model.seen_gaussian(best).whiten(at_best[seen])
    std = _standard_deviations(whitened, coords, u, prior_std, len(best))
    log_prior += sum(_usual_log_odds(e, s) for e, s in zip(best, std, strict=True))
    promised = _promised_gain(
        tolerated.gaussian, model.seen_value, at_best[seen], (u - prior_centre) / prior_std, prior_std
    )
    log_posterior = value + log_prior - policy.parameter_log_odds * len(coords)
    return Fit(best, tuple(std), value, log_posterior, at_best, not rough, promised, tolerated.share)


def is_of_usual_size(effects: Effects, camera: CameraModel) -> bool:
    """Say whether all parameters lie within the width of a fit's prior."""
    coords = coordinates(effects, camera)
    centre, std = coordinate_prior(coords)
    u = np.array([c.to_u(float(getattr(effects[c.index], c.name))) for c in coords])
    return bool(np.all(np.abs(u - centre) <= std))


def _wide_residual(t: FloatArray) -> FloatArray:
    """r with -r^2 / 2 the log prior of coordinates t, in widths from its centre: r = t up to |t| = 1, |r| = sqrt(1 + 2
    ln |t|) from there.

    It is the normal prior of the likeliest width that isn't below the declared one: -t^2 / 2, and -1/2 - ln |t|, whose
    slopes agree at
    |t| = 1. A normal prior pulls a parameter far out by many of its standard deviations: a lamp's drift of 5 %/min,
    usual 0.3, to 3.8."""
    far = np.maximum(np.abs(t), 1.0)
    return np.asarray(np.where(far > 1.0, np.sign(t) * np.sqrt(1.0 + 2.0 * np.log(far)), t))


def _wide_slope(t: FloatArray) -> FloatArray:
    """Derivative of `_wide_residual`."""
    far = np.maximum(np.abs(t), 1.0)
    return np.asarray(1.0 / (far * np.sqrt(1.0 + 2.0 * np.log(far))))


def _standard_deviations(
    jacobian: FloatArray, coords: Sequence[EffectCoordinate], u: FloatArray, prior_std: FloatArray, effects: int
) -> list[dict[str, float | None]]:
    """Of every effect's parameters, from (J'J + P^-1)^-1. With s the standard deviation of u = p^k, that of p is s / (k
    |p|^(k - 1)), and at most s^(1/k), which holds at p = 0. A flat prior between two bounds has their distance over
    sqrt(12)."""
    covariance, told = _covariance(jacobian, coords, prior_std)
    std: list[dict[str, float | None]] = [{} for _ in range(effects)]
    for k, c in enumerate(coords):
        if not told[k]:
            std[c.index][c.name] = None
            continue
        su = float(np.sqrt(max(covariance[k, k], 0.0)))
        if c.quantity.logarithmic:
            std[c.index][c.name] = su * c.to_value(float(u[k]))
            continue
        power = c.quantity.linear_power
        away = abs(c.to_value(float(u[k])) - c.absent)
        std[c.index][c.name] = (
            su if power == 1 else min(su / max(power * away ** (power - 1), 1e-12), su ** (1.0 / power))
        )
    return std


def _covariance(
    jacobian: FloatArray, coords: Sequence[EffectCoordinate], prior_std: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """(J'J + P^-1)^-1 of coordinates (p, p), from the whitened Jacobian, and which of them anything bounds (p,). A flat
    prior between two bounds has their distance over sqrt(12)."""
    low, high = np.array([c.bounds for c in coords]).T
    prior_std = np.where(np.isfinite(prior_std), prior_std, (high - low) / np.sqrt(12.0))
    curvature = jacobian.T @ jacobian + np.diag(1.0 / prior_std**2)
    told = np.diag(curvature) > 0.0  # else the numbers don't depend on it, and nothing bounds it
    size = np.sqrt(np.where(told, np.diag(curvature), 1.0))
    return np.linalg.pinv(curvature / np.outer(size, size)) / np.outer(size, size), told


def size_covariance(
    model: MeasurementModel, effects: Effects, index: int
) -> tuple[list[EffectCoordinate], FloatArray, FloatArray]:
    """Return the coordinates that size member `index`, theirs less those of absence (k,), and their posterior
    covariance (k, k), that of its shapes and of the other members marginalised."""
    coords = coordinates(effects, model.camera)
    own = [k for k, c in enumerate(coords) if c.index == index and c.name not in type(effects[index]).shapes]
    if not own:
        return [], np.zeros(0), np.zeros((0, 0))
    u, covariance, told = _posterior_covariance(model, effects, coords)
    own = [k for k in own if told[k] and coords[k].quantity.absent is not None]
    absent = np.array([coords[k].to_u(coords[k].absent) for k in own])
    return [coords[k] for k in own], u[own] - absent, covariance[np.ix_(own, own)]


def _posterior_covariance(
    model: MeasurementModel, effects: Effects, coords: Sequence[EffectCoordinate]
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Coordinates (p,), their posterior covariance (p, p), and which of them anything bounds (p,)."""
    u = np.array([c.to_u(float(getattr(effects[c.index], c.name))) for c in coords])
    typical = np.array([c.typical(float(getattr(effects[c.index], c.name))) for c in coords])
    high = np.array([c.bounds[1] for c in coords])
    jacobian = _prediction_jacobian(model, effects, coords, u, typical, high)[model.seen]
    covariance, told = _covariance(model.seen_gaussian(effects).whiten(jacobian), coords, coordinate_prior(coords)[1])
    return u, covariance, told


def displaced(model: MeasurementModel, effects: Effects, index: int) -> list[tuple[Effect, ...]]:
    """Return the effects with member `index` moved by one standard deviation along each principal direction of its
    parameters' posterior, within bounds: a set for each direction. Predictions by these, less that by `effects`, are a
    square root of the covariance that the member's parameters give to a prediction."""
    coords = coordinates(effects, model.camera)
    own = [k for k, c in enumerate(coords) if c.index == index]
    if not own:
        return []
    u, covariance, told = _posterior_covariance(model, effects, coords)
    low, high = (np.array(b) for b in zip(*(c.bounds for c in coords), strict=True))
    scale = np.array([c.typical(float(getattr(effects[c.index], c.name))) for c in coords])[own]
    size, direction = np.linalg.eigh(covariance[np.ix_(own, own)] / np.outer(scale, scale))
    found = []
    for part in (direction * np.sqrt(np.maximum(size, 0.0))).T:
        step = np.zeros(len(u))
        step[own] = np.where(told[own], part * scale, 0.0)
        inside = step if np.all((u + step >= low) & (u + step <= high)) else -step
        found.append(moved(effects, coords, np.clip(u + inside, low, high)))
    return found


def _promised_gain(
    gaussian: Gaussian, seen_value: FloatArray, jacobian: FloatArray, from_prior: FloatArray, prior_std: FloatArray
) -> float:
    """Half of Newton's decrement, g' (J'J + P^-1)^-1 g / 2: what a step to the optimum would gain if the prediction
    were linear and without bounds."""
    white = gaussian.whiten(jacobian)
    gradient = white.T @ gaussian.whiten(seen_value - gaussian.mean) - from_prior / prior_std
    return float(0.5 * gradient @ np.linalg.pinv(white.T @ white + np.diag(1.0 / prior_std**2)) @ gradient)


def _usual_log_odds(effect: Effect, std: dict[str, float | None]) -> float:
    """Return the effect's `log_prior`, the largest within a standard deviation of the values found: noise makes nothing
    unusual."""
    if type(effect).log_prior is Effect.log_prior:
        return 0.0
    quantities = type(effect).quantities()
    near = []
    for name, width in std.items():
        value, low, high = float(getattr(effect, name)), quantities[name].lower, quantities[name].upper
        around = (value - (width or 0.0), value, value + (width or 0.0))
        near.append([min(max(v, -np.inf if low is None else low), np.inf if high is None else high) for v in around])
    return max(effect.replace_fields(**dict(zip(std, v, strict=True))).log_prior() for v in product(*near))


def _difference_step(coordinate: EffectCoordinate, at: float, typical: float, high: float) -> float:
    """Step of a one-sided difference at u = `at`, towards the inside of the bounds."""
    step = max(DIFFERENCE_STEP * max(typical, DIFFERENCE_STEP * abs(at)), coordinate.quantity.smooth_over)
    return -step if at + step > high else step


def _prediction_jacobian(
    model: MeasurementModel,
    effects: Effects,
    coords: Sequence[EffectCoordinate],
    u: FloatArray,
    typical: FloatArray,
    high: FloatArray,
) -> FloatArray:
    """(n, p), by one-sided differences."""
    base = model.mean(effects)
    columns = []
    for k, c in enumerate(coords):
        step = _difference_step(c, u[k], typical[k], high[k])
        shifted = u.copy()
        shifted[k] += step
        columns.append((model.mean(moved(effects, coords, shifted)) - base) / step)
    return np.array(columns).T
