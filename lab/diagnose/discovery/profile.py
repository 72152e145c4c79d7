"""What is left along an index, and the forms by which few numbers may describe it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from math import comb

import numpy as np
from scipy import sparse
from scipy.optimize import minimize
from scipy.special import betaln
from scipy.stats import f as f_distribution

from sim.effects.empirical_law import Along, Of, Stage
from sim.spectrum import FloatArray

PERIODS = tuple(range(2, 65))
BIT_PERIODS = (128, 256, 512)  # of the codes of a converter whose higher bits are wrong, too
#: Classes of a table, at most, that differ from all others where a table of few numbers is told.
FEW_CLASSES, FEW_FROM = 2, 8
UPPER_PERIODS = (2, 4, 8, 16)  # of tables that begin within the index
LEAST_REPEATS = 6  # of a period over the index
LEAST_WAVES, LEAST_PERIOD = 3.0, 3  # waves over the index, and lines of a wave
MOST_ORDERS = 4  # waves about the sensor's centre
END_LENGTHS = 24  # lengths of a decay that are tried
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
    noise     (n,) of it, the variance by noise of independent pixels; None: all of it
    """

    index: np.ndarray
    residual: FloatArray
    variance: FloatArray
    matrix: sparse.csr_array | FloatArray
    noise: FloatArray | None = None

    @property
    def excess(self) -> float:
        """Return chi2 beyond what noise of independent pixels gives."""
        noise = float(len(self.residual)) if self.noise is None else float(np.sum(self.noise / self.variance))
        return max(self.chi2(np.zeros(1)) - noise, 0.0)

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

    def said_by(self, table: FloatArray) -> float:
        """Return by how much chi2 is expected to fall by a table of departures that is right."""
        return float(np.sum(np.square(self.matrix @ np.resize(table, self.count)) / self.variance))

    def part(self, used: np.ndarray) -> Profile:
        """Return the profile of some (n,) of its numbers."""
        noise = None if self.noise is None else self.noise[used]
        matrix = self.matrix[np.flatnonzero(used)]
        return Profile(self.index[used], self.residual[used], self.variance[used], matrix, noise)

    def beside(self, nuisance: FloatArray) -> Profile:
        """Return the profile without what columns (n, k) add, of variance 1."""
        weight = 1.0 / np.sqrt(self.variance)
        free, size, _ = np.linalg.svd(nuisance * weight[:, None], full_matrices=False)
        free = free[:, size > DETERMINED * size.max()]
        value, matrix = self.residual * weight, np.asarray(self.matrix * weight[:, None])
        noise = None if self.noise is None else self.noise / self.variance
        value, matrix = (one - free @ (free.T @ one) for one in (value, matrix))
        return Profile(self.index, value, np.ones(len(value)), matrix, noise)


@dataclass(frozen=True)
class Look:
    """The profiles of one quantity along one index: of the captures that the search may use, and of those held out.

    `at`: the points of a curve, in the coordinate's unit; none along an index. `known`: those at which there are seen
    numbers. `channels`: of curves by channel. `columns`: of a table by row and column, the period of the columns.
    `step`: lines of a period of the mosaic. `least`: range of departures below which nothing is told. `shown_in`:
    measurements that the quantity is part of. `is_own_axis`: whether a mismatched one of them is stated along it.
    `is_whole`: whether it is the whole course, not what a filter leaves of it. `is_of_measurements`: whether the
    numbers are those of the measurements, with their covariance.
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
    channels: tuple[str, ...] = ()
    least: float = 0.0
    is_own_axis: bool = False
    is_whole: bool = False
    is_of_measurements: bool = False


@dataclass(frozen=True)
class Form:
    """A way to write the departures by index with few numbers.

    name     "periodic", "by index", "wave", "decay", "step", "line", "knee", "bump", "formula", "curve"
    basis    (N, k), or (period, k) of a table that repeats
    numbers  that it has, those beside its k coefficients too
    tried    alternatives of the same form, the best of which counts
    share    of the chance of a false law that the form may take of its look
    period   of a table that repeats, from the index `first` on; 0: it doesn't
    say      its k coefficients in words
    centred  whether the departures have the mean 0
    """

    name: str
    basis: FloatArray
    numbers: int
    tried: int = 1
    share: float = 0.1
    period: int = 0
    first: int = 0
    say: Say | None = None
    centred: bool = False

    @property
    def change(self) -> FloatArray:
        """Return the departures by each coefficient, (N, k) or (period, k)."""
        return self.basis - self.basis.mean(axis=0) if self.centred else self.basis

    def columns(self, profile: Profile) -> FloatArray:
        """Return what the coefficients do to a profile's residuals, in its standard deviations, (n, k)."""
        every = self.change
        if self.period:
            every = np.stack([self.over(profile.count, one) for one in every.T], axis=1)
        return np.asarray(np.asarray(profile.matrix @ every) / np.sqrt(profile.variance)[:, None])

    def over(self, count: int, departure: FloatArray) -> FloatArray:
        """Return departures as of a table (period,) or (N,), for every one of `count` indices."""
        every = np.array(np.resize(departure, count))
        if self.first:
            every = np.concatenate([np.zeros(self.first), np.resize(departure, max(count - self.first, 0))])
        return every


@dataclass(frozen=True)
class Table:
    """A form fitted: departures (period,) or (N,), their standard deviations, and ln of the probability that chance
    gains as much in any form of the look.
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

    def over(self, count: int) -> FloatArray:
        """Return the departures of every one of `count` indices."""
        return self.form.over(count, self.departure)


def fitted(profile: Profile, form: Form) -> Table:
    """Fit a form.

    Weighted least squares of least norm, as a filter takes out what all classes of a table share. F test of the gain:
    the scatter that the form leaves stands for the noise, so that a variance that is too small gains nothing. The
    probability is multiplied by the number of alternatives, and divided by the form's share (weighted Bonferroni).
    """
    weight = 1.0 / np.sqrt(profile.variance)
    change = form.change
    columns = form.columns(profile)
    value = profile.residual * weight
    size, vectors = np.linalg.eigh(columns.T @ columns)
    kept = size > DETERMINED * max(float(size[-1]), 1e-300)
    inverse = (vectors[:, kept] / size[kept]) @ vectors[:, kept].T
    coefficients = inverse @ (columns.T @ value)
    rank = int(kept.sum())
    before = float(value @ value)
    after = float(np.sum(np.square(value - columns @ coefficients)))
    freedom = max(len(value) - rank, 1)
    departure = change @ coefficients
    std = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", change, inverse, change) * after / freedom, 0.0))
    said = form.say(coefficients) if form.say is not None else ""
    if rank == 0 or len(value) <= rank or after >= before:
        return Table(form, departure, std, 0.0, said)
    log_p = _log_chance(before, after, rank, freedom) + np.log(form.tried / form.share)
    return Table(form, departure, std, min(log_p, 0.0), said)


def _log_chance(before: float, after: float, rank: int, freedom: int) -> float:
    """Return ln of the probability that chance takes as much off a sum of squares (F test)."""
    log_p = float(f_distribution.logsf((before - after) / rank / (after / freedom), rank, freedom))
    if np.isfinite(log_p):
        return log_p
    # the incomplete beta function's first term, for what is too small for a number
    a, b, share = 0.5 * freedom, 0.5 * rank, after / before
    return float(a * np.log(share) + b * np.log1p(-share) - np.log(a) - betaln(a, b))


def chi2_within(profile: Profile, table: Table) -> tuple[float, float, int]:
    """Return chi2 of a profile in the directions of a form, before and after its table, and their number."""
    columns = table.form.columns(profile)
    free, size, _ = np.linalg.svd(columns, full_matrices=False)
    free = free[:, size > np.sqrt(DETERMINED) * max(float(size.max()), 1e-300)]
    weight = 1.0 / np.sqrt(profile.variance)
    before, after = (
        float(np.sum(np.square(free.T @ (profile.left_by(one) * weight))))
        for one in (np.zeros(profile.count), table.over(profile.count))
    )
    return before, after, free.shape[1]


def description_length(profile: Profile, table: Table | PredictiveTable) -> float:
    """Return n ln chi2 + k ln n + 2 ln(alternatives) of a table with k numbers."""
    n, form = len(profile.residual), table.form
    return float(
        n * np.log(profile.chi2(table.over(profile.count))) + form.numbers * np.log(n) + 2.0 * np.log(form.tried)
    )


# --- forms along an index --------------------------------------------------------------------------------------------


def periodic_forms(look: Look) -> Iterator[Form]:
    """Yield tables that repeat, those of the whole cell along rows and columns."""
    if look.columns:
        count = look.seen.count
        row, column = np.divmod(np.arange(count), look.columns)
        lines = np.hstack([np.eye(count // look.columns)[row], np.eye(look.columns)[column]])
        yield Form("lines", lines, lines.shape[1] - 2, share=0.5, period=count, centred=True)
        yield Form("periodic", np.eye(count), count - 1, share=0.5, period=count, centred=True)
        return
    span = int(np.ptp(look.seen.index)) + 1
    for period in (*PERIODS, *(BIT_PERIODS if look.stage == "codes" else ())):
        if period * LEAST_REPEATS > span:
            break
        share = 0.5 / (period * (period - 1))  # of all periods together a half
        whole = Form("periodic", np.eye(period), period - 1, share=share, period=period, centred=True)
        yield whole
        if period >= FEW_FROM:
            away = np.abs(fitted(look.seen, whole).departure)
            for few in range(1, FEW_CLASSES + 1):
                kept = np.sort(np.argsort(away)[-few:])
                tried = comb(period, few)
                few_of = np.eye(period)[:, kept]
                yield Form("periodic", few_of, 2 * few, tried, 0.2 * share, period=period, centred=True)


def upper_forms(look: Look) -> Iterator[Form]:
    """Yield tables that repeat from a quarter, half or three quarters of the index on."""
    for quarter in (1, 2, 3):
        for period in UPPER_PERIODS:
            first = look.seen.count * quarter // (4 * period) * period
            if period * LEAST_REPEATS <= int(look.seen.index.max()) - max(first, int(look.seen.index.min())):
                yield Form(
                    "periodic", np.eye(period), period, 3, 0.1 / (period * (period - 1)), period, first, centred=True
                )


def wave_forms(look: Look, entry: Entry) -> Iterator[Form]:
    """Yield the sine along an index, of any period, that takes most off chi2."""
    count = look.seen.count
    frequency = np.arange(LEAST_WAVES, count // LEAST_PERIOD, 0.5) / count
    if not len(frequency):
        return
    turn = 2.0 * np.pi * np.arange(count)[:, None] * frequency
    weight = 1.0 / np.sqrt(look.seen.variance)
    waves = (np.asarray(look.seen.matrix @ np.cos(turn)), np.asarray(look.seen.matrix @ np.sin(turn)))
    cos, sin = (one * weight[:, None] for one in waves)
    value = look.seen.residual * weight
    a, b, c = (np.einsum("ij,ij->j", x, y) for x, y in ((cos, cos), (cos, sin), (sin, sin)))
    u, v = value @ cos, value @ sin
    gain = (c * u * u - 2.0 * b * u * v + a * v * v) / np.maximum(a * c - b * b, DETERMINED * (a + c) ** 2 + 1e-300)
    best = frequency[int(np.argmax(gain))]
    angle = 2.0 * np.pi * best * np.arange(count)
    basis = np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def say(size: FloatArray) -> str:
        return f"a wave of {entry(float(np.hypot(*size)))} with a period of {1.0 / best:.3g} {look.along}s"

    yield Form("wave", basis, 3, len(frequency), centred=True, say=say)


def end_forms(look: Look, entry: Entry) -> Iterator[Form]:
    """Yield what decays from the first or from the last line on, of the length that takes most off chi2."""
    count = look.seen.count
    lengths = np.geomspace(2.0, count / 6.0, END_LENGTHS)
    from_first = np.exp(-np.arange(count)[:, None] / lengths)
    basis = np.hstack([from_first, from_first[::-1]])
    best = _most_gaining(look.seen, basis)
    end = "first" if best < len(lengths) else "last"
    length = lengths[best % len(lengths)]

    def say(size: FloatArray) -> str:
        return f"{entry(size[0])} at the {end} {look.along}, which decays over {length:.3g} {look.along}s"

    yield Form("decay", basis[:, [best]], 2, basis.shape[1], centred=True, say=say)


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


def angle_forms(at: FloatArray, entry: Entry) -> Iterator[Form]:
    """Yield waves of one to four periods about the sensor's centre, and a curve. at : angles (N,), deg."""
    turn = np.radians(at)
    for order in range(1, MOST_ORDERS + 1):
        basis = np.stack([np.cos(order * turn), np.sin(order * turn)], axis=1)

        def say(c: FloatArray, order: int = order) -> str:
            first = np.degrees(np.arctan2(c[1], c[0])) / order % (360.0 / order)
            return f"{entry(float(np.hypot(*c)))} in the corners, times r^2 cos {order} (angle - {first:.0f} deg)"

        yield Form("wave", basis, 2, MOST_ORDERS, say=say)


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


def plane_forms(x: FloatArray, channels: Sequence[str], entry: Entry) -> Iterator[Form]:
    """Yield straight lines, and curves through few points, of every channel by itself: columns of a table by channel
    and place, channels first."""
    line = ((x - x[0]) / np.ptp(x))[:, None]
    few = np.unique(np.linspace(0, len(x) - 1, FEW_POINTS).round().astype(int))
    hats = np.array([np.interp(x, x[few], one) for one in np.eye(len(few))]).T
    for name, basis in (("line", line), ("curve", hats)):
        count = basis.shape[1]

        def say(c: FloatArray, name: str = name, count: int = count) -> str:
            each = zip(channels, c.reshape(-1, count), strict=True)
            if name == "line":
                return ", ".join(f"{channel} {entry(float(own[0]))}" for channel, own in each) + " over the range"
            return f"a curve through {count} points for each channel"

        yield Form(name, np.kron(np.eye(len(channels)), basis), len(channels) * count, say=say)


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
    own : the same in the directions of the form
    shorter : forms of fewer numbers that it rests on, the shortest first
    equal : other places in the chain whose best form the captures can't tell from it, in words
    """

    look: Look
    form: Form
    departure: FloatArray
    std: FloatArray
    log_probability: float
    chi2: tuple[float, float, int]
    own: tuple[float, float, int]
    said: str = ""
    shorter: tuple[PredictiveTable, ...] = ()
    equal: tuple[str, ...] = field(default=())
    remark: str = ""

    @property
    def period(self) -> int:
        """Indices after which it repeats; 0: it doesn't."""
        return self.form.period

    def over(self, count: int) -> FloatArray:
        """Return the departures of every one of `count` indices."""
        return self.form.over(count, self.departure)
