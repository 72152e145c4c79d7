"""What is left along an index, and the forms by which few numbers may describe it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy import sparse
from scipy.optimize import minimize
from scipy.stats import f as f_distribution

from sim.effects.empirical_law import Along, Of, Stage
from sim.spectrum import FloatArray

PERIODS = (*range(2, 17), 20, 24, 32, 64)
LEAST_REPEATS = 6  # of a period over the index
#: Eigenvalues of a form's normal equations, over the largest, below which its numbers aren't determined.
DETERMINED = 1e-12
#: Decay lengths of the symbolic terms and widths of bumps, over the range of the coordinate; and the waves' cycles over
#: it, with the points that each needs.
DECAYS, WIDTHS = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0), np.geomspace(1 / 60, 1 / 5, 20)
MOST_CENTRES = 64  # of bumps
CYCLES_STEP, POINTS_A_CYCLE, LEAST_CYCLES = 0.25, 2.5, 0.5
MOST_TERMS = 3
FEW_POINTS = 7  # points of the coarser of two curves
#: Coefficients of a form -> the form in words; and a number with its unit.
Say = Callable[[FloatArray], str]
Entry = Callable[[float], str]


@dataclass(frozen=True)
class Profile:
    """What is left along an index in some captures.

    index     (n,) index of each number; of halves of the numbers, each has to predict the other
    residual  (n,) departure, filtered
    variance  (n,) of the residuals
    matrix    (n, N): departures by every index -> the residuals that they leave after the filter
    """

    index: np.ndarray
    residual: FloatArray
    variance: FloatArray
    matrix: sparse.csr_array | FloatArray

    @property
    def count(self) -> int:
        """The number N of indices."""
        return int(self.matrix.shape[1])

    @cached_property
    def low(self) -> np.ndarray:
        """Mask (n,) of the lower part of the index."""
        return np.asarray(self.index < self.index.mean())

    def left_by(self, table: FloatArray) -> FloatArray:
        """Return the residuals (n,) less a table of departures, repeated over the index."""
        return np.asarray(self.residual - self.matrix @ np.resize(table, self.count))

    def chi2(self, table: FloatArray) -> float:
        """Return chi2 of the residuals less a table of departures, repeated over the index."""
        return float(np.sum(np.square(self.left_by(table)) / self.variance))

    def part(self, used: np.ndarray) -> Profile:
        """Return the profile of some (n,) of its numbers."""
        return Profile(self.index[used], self.residual[used], self.variance[used], self.matrix[np.flatnonzero(used)])


@dataclass(frozen=True)
class Look:
    """The profiles of one quantity along one index: of the captures that the search may use, and of those held out.

    `at`: the points of a curve, in the coordinate's unit; none along an index. `known`: those at which there are seen
    numbers. `columns`: of a table by row and column, the period of the columns. `step`: lines of a period of the
    mosaic. `shown_in`: measurements that the quantity is part of. `is_own_axis`: whether a mismatched one of them is
    stated along it.
    """

    stage: Stage
    along: Along
    seen: Profile
    held_out: Profile | None
    of: Of = "mean"
    at: tuple[float, ...] = ()
    known: tuple[float, ...] = ()
    columns: int = 0
    step: int = 1
    shown_in: frozenset[str] = frozenset()
    is_own_axis: bool = False


@dataclass(frozen=True)
class Form:
    """A way to write the departures by index with few numbers.

    name     "periodic", "by index", "step", "line", "knee", "bump", "formula", "curve"
    basis    (N, k), or (period, k) of a table that repeats
    numbers  that it has, those beside its k coefficients too
    tried    alternatives of the same form, the best of which counts
    say      its k coefficients in words
    centred  whether the departures have the mean 0
    """

    name: str
    basis: FloatArray
    numbers: int
    tried: int = 1
    period: int = 0
    say: Say | None = None
    centred: bool = False


@dataclass(frozen=True)
class Table:
    """A form fitted: departures (period,) or (N,), their standard deviations, and ln of the probability that chance
    gains as much.
    """

    form: Form
    departure: FloatArray
    std: FloatArray
    log_probability: float
    said: str = ""

    @property
    def period(self) -> int:
        """Indices after which it repeats; 0: it doesn't."""
        return self.form.period


def fitted(profile: Profile, form: Form) -> Table:
    """Fit a form.

    Weighted least squares of least norm, as a filter takes out what all classes of a table share. F test of the gain:
    the scatter that the form leaves stands for the noise, so that a variance that is too small gains nothing. The
    probability is multiplied by the number of alternatives (Bonferroni).
    """
    weight = 1.0 / np.sqrt(profile.variance)
    basis = form.basis
    if form.period:
        basis = basis[np.arange(profile.count) % form.period]
    columns = np.asarray(profile.matrix @ basis) * weight[:, None]
    value = profile.residual * weight
    size, vectors = np.linalg.eigh(columns.T @ columns)
    kept = size > DETERMINED * max(float(size[-1]), 1e-300)
    inverse = (vectors[:, kept] / size[kept]) @ vectors[:, kept].T
    coefficients = inverse @ (columns.T @ value)
    rank = int(kept.sum())
    before = float(value @ value)
    after = float(np.sum(np.square(value - columns @ coefficients)))
    freedom = max(len(value) - rank, 1)
    change = form.basis - form.basis.mean(axis=0) if form.centred else form.basis
    departure = change @ coefficients
    std = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", change, inverse, change) * after / freedom, 0.0))
    said = form.say(coefficients) if form.say is not None else ""
    if rank == 0 or len(value) <= rank or after >= before:
        return Table(form, departure, std, 0.0, said)
    ratio = (before - after) / rank / (after / freedom)
    log_p = float(f_distribution.logsf(ratio, rank, freedom)) + np.log(form.tried)
    return Table(form, departure, std, min(log_p, 0.0), said)


def description_length(profile: Profile, table: Table | PredictiveTable) -> float:
    """Return n ln chi2 + k ln n + 2 ln(alternatives) of a table with k numbers."""
    n, form = len(profile.residual), table.form
    return float(n * np.log(profile.chi2(table.departure)) + form.numbers * np.log(n) + 2.0 * np.log(form.tried))


# --- forms along an index --------------------------------------------------------------------------------------------


def periodic_forms(look: Look) -> Iterator[Form]:
    """Yield tables that repeat, those of the whole cell along rows and columns."""
    if look.columns:
        count = look.seen.count
        yield Form("periodic", np.eye(count), count - 1, period=count, centred=True)
        return
    span = int(np.ptp(look.seen.index)) + 1
    for period in PERIODS:
        if period * LEAST_REPEATS <= span:
            yield Form("periodic", np.eye(period), period - 1, period=period, centred=True)


def tap_forms(look: Look, entry: Entry) -> Iterator[Form]:
    """Yield steps where the areas of two or four read-outs may meet: at half and at quarters of a side."""
    count = look.seen.count
    for taps in (2, 4):
        edges = [round(k * count / taps / look.step) * look.step for k in range(1, taps)]
        basis = np.array([np.arange(count) >= edge for edge in edges], float).T

        def say(sizes: FloatArray, edges: list[int] = edges) -> str:
            words = [f"{entry(size)} from {look.along} {edge} on" for edge, size in zip(edges, sizes, strict=True)]
            return f"{'a step' if len(edges) == 1 else 'steps'} of {', '.join(words)}"

        yield Form("step", basis, len(edges), centred=True, say=say)


# --- forms along a coordinate ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Term:
    """A term of a short law: its values (N, k), its words for the coefficients, and the numbers that it has beside
    them.
    """

    values: FloatArray
    say: Say
    beside: int = 0


def curve_forms(profile: Profile, x: FloatArray, known: FloatArray, unit: str, entry: Entry) -> Iterator[Form]:
    """Yield a straight line; a step, a knee and a bump at the place where each takes most off chi2; and curves through
    few and through all points.

    x : the points (N,); known : those at which there are seen numbers
    """
    scale = float(np.ptp(x))
    yield Form("line", ((x - x[0]) / scale)[:, None], 1, say=lambda c: f"a straight line, {entry(c[0])} over the range")

    edges = x[:-1] + 0.5 * np.diff(x)
    edge = edges[_most_gaining(profile, (x[:, None] > edges).astype(float))]
    step = (x > edge).astype(float)[:, None]
    yield Form("step", step, 2, len(edges), say=lambda c: f"a step of {entry(c[0])} at {edge:.4g} {unit}")

    bends = np.maximum(x[:, None] - x[1:-1], 0.0) / scale
    bend = _most_gaining(profile, bends)
    yield Form("knee", bends[:, [bend]], 2, len(x) - 2, say=lambda c: f"a knee at {x[1 + bend]:.4g} {unit}")

    centres, widths = (one.ravel() for one in np.meshgrid(x[:: -(-len(x) // MOST_CENTRES)], scale * WIDTHS))
    best = _most_gaining(profile, _bumps(x, centres, widths))
    start = np.array([centres[best], np.log(widths[best])])
    simplex = start + np.array([[0.0, 0.0], [0.3 * widths[best], 0.0], [0.0, 0.1]])
    place = minimize(
        lambda p: -float(_gains(profile, _bumps(x, p[:1], np.exp(p[1:])))[0]), start, method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxiter": 60},
    ).x  # fmt: skip
    centre, width = float(np.clip(place[0], x[0], x[-1])), float(np.clip(np.exp(place[1]), widths[0], widths[-1]))
    bump = _bumps(x, np.array([centre]), np.array([width]))
    words = f"at {centre:.4g} {unit}, {width:.3g} {unit} wide (1 sigma)"
    yield Form("bump", bump, 3, len(centres), say=lambda c: f"a bump of {entry(c[0])} {words}")

    for number in (FEW_POINTS, len(known)) if len(known) > FEW_POINTS else (len(known),):
        through = known[np.unique(np.linspace(0, len(known) - 1, number).round().astype(int))]
        hats = np.array([np.interp(x, through, one) for one in np.eye(number)]).T
        yield Form("curve", hats, number, say=lambda c: f"a curve through {len(c)} points")


def _bumps(x: FloatArray, centre: FloatArray, width: FloatArray) -> FloatArray:
    return np.asarray(np.exp(-0.5 * np.square((x[:, None] - centre) / width)))


def _gains(profile: Profile, basis: FloatArray) -> FloatArray:
    """Return how much each column of a basis (N, m), by itself, takes off chi2."""
    columns = np.asarray(profile.matrix @ basis) / np.sqrt(profile.variance)[:, None]
    value = profile.residual / np.sqrt(profile.variance)
    return np.asarray(np.square(value @ columns) / np.maximum(np.square(columns).sum(axis=0), 1e-300))


def _most_gaining(profile: Profile, basis: FloatArray) -> int:
    return int(np.argmax(_gains(profile, basis)))


def formulas(profile: Profile, x: FloatArray, unit: str, *, by_inverse: bool) -> Iterator[Form]:
    """Yield short laws: for 1, 2 and 3 terms those that forward selection finds, of u, u^2, sqrt u, ln u, 1/u,
    exp(-u/t) and cos(2 pi u/p), u the coordinate x over its largest value. A constant is none: levels are free.

    by_inverse : whether waves in 1/u are terms, too, as interference has them
    """
    terms = _terms(x, by_inverse)
    chosen: list[int] = []
    weight = 1.0 / np.sqrt(profile.variance)
    value = profile.residual * weight
    columns = [np.asarray(profile.matrix @ term.values) * weight[:, None] for term in terms]
    for _ in range(MOST_TERMS):
        before = np.hstack([np.zeros((len(value), 0)), *(columns[k] for k in chosen)])
        rest = [k for k in range(len(terms)) if k not in chosen]
        chosen.append(min(rest, key=lambda k: _left(np.hstack([before, columns[k]]), value)))
        own = [terms[k] for k in chosen]
        ends = np.cumsum([0, *(term.values.shape[1] for term in own)])

        def say(c: FloatArray, own: list[_Term] = own, ends: np.ndarray = ends) -> str:
            parts = [term.say(c[a:b]) for term, (a, b) in zip(own, pairwise(ends), strict=True)]
            return f"{' '.join(parts)} with u = 1 at {float(np.abs(x).max()):.4g} {unit}"

        numbers = int(ends[-1]) + sum(term.beside for term in own)
        yield Form("formula", np.hstack([t.values for t in own]), numbers, len(terms) ** len(chosen), say=say)


def _left(columns: FloatArray, value: FloatArray) -> float:
    """Return the sum of squares that least squares leave."""
    normal, shared = columns.T @ columns, columns.T @ value
    return float(value @ value - shared @ np.linalg.pinv(normal, rcond=DETERMINED, hermitian=True) @ shared)


def _terms(x: FloatArray, by_inverse: bool) -> list[_Term]:
    u = x / float(np.abs(x).max())
    found: list[_Term] = []

    def add(values: FloatArray, words: str, beside: int = 0) -> None:
        found.append(_Term(values[:, None], lambda c: f"{c[0]:+.3g} {words}", beside))

    add(u, "u")
    add(u * u, "u^2")
    if float(u.min()) >= 0.0:
        add(np.sqrt(u), "sqrt u")
    if float(u.min()) > 1e-3:
        add(np.log(u), "ln u")
        add(1.0 / u, "1/u")
    for decay in float(np.ptp(u)) * np.array(DECAYS):
        add(np.exp(-(u - u.min()) / decay), f"exp(-(u - {u.min():.3g}) / {decay:.3g})", 1)
    for wave, word in ((u, "u"), (1.0 / u, "1/u")) if by_inverse else ((u, "u"),):
        for cycles in np.arange(LEAST_CYCLES, len(u) / POINTS_A_CYCLE, CYCLES_STEP):
            found.append(_wave(wave, float(np.ptp(wave) / cycles), word))
    return found


def _wave(u: FloatArray, period: float, word: str) -> _Term:
    turn = 2.0 * np.pi * u / period

    def say(c: FloatArray) -> str:
        ahead = float(np.arctan2(c[1], c[0])) * period / (2.0 * np.pi)
        return f"{float(np.hypot(*c)):+.3g} cos(2 pi ({word} - {ahead:.3g}) / {period:.3g})"

    return _Term(np.stack([np.cos(turn), np.sin(turn)], axis=1), say, 1)


@dataclass(frozen=True)
class PredictiveTable:
    """A form that predicts: departures from no change by class (period,) or by index (N,).

    chi2 : of the held-out captures (of the seen ones without any), before, after, and the number of numbers
    shorter : forms of fewer numbers that it rests on, the shortest first
    equal : other places in the chain whose best form the captures can't tell from it, in words
    """

    look: Look
    form: Form
    departure: FloatArray
    std: FloatArray
    log_probability: float
    chi2: tuple[float, float, int]
    said: str = ""
    shorter: tuple[PredictiveTable, ...] = ()
    equal: tuple[str, ...] = field(default=())
    remark: str = ""

    @property
    def period(self) -> int:
        """Indices after which it repeats; 0: it doesn't."""
        return self.form.period
