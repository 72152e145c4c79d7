"""All sets of one, two and three effects compared in closed form, in the linear problem about a fitted set.

    r = G u + e,  u >= 0,  e ~ N(0, 1)

r is the whitened residual, the columns of G are whitened signatures; nuisance parameters, and the parameters of the set
about which it is linear, are projected out of both. With z = G'r and R = G'G, taken once, the score of the columns c is

    S(c) = max over u >= 0 of 2 z_c'u - u'R_cc u,

the gain in chi2. A parameter of one sign has one column, one of either sign has two. A pair may score far above both of
its members, which growing sets one by one never sees (FINEMAP: Benner et al., 2016, Bioinformatics 32, 1493)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.optimize import nnls

from sim.spectrum import FloatArray

#: Added to the variances of unit columns: without it, the active set of least squares cycles between columns that are
#: all but equal.
RIDGE = 1e-8
#: Sets of one size from which larger ones are made.
EXTENDED = 60
#: Effects that each of these is extended by, the best by a lower bound of the score.
EXTENSIONS = 12
#: 1 - rho^2 of two columns below which they count as one.
LEAST_ANGLE = 1e-6


@dataclass(frozen=True)
class LinearSet:
    """Some alternatives, of different owners, by index; their score S, the log odds S / 2 less their costs, and the
    coefficients u of each alternative's columns."""

    members: tuple[int, ...]
    score: float
    log_odds: float
    share: tuple[FloatArray, ...]


@dataclass(frozen=True)
class LinearProblem:
    """z (p,) and R (p, p), with p columns. `owners`: the effect of each alternative; `columns`: its columns, by index.
    Of the alternatives of one owner a set holds one at most. `cost`: log odds that each owner has to earn."""

    z: FloatArray
    gram: FloatArray
    owners: tuple[str, ...]
    columns: tuple[tuple[int, ...], ...]
    cost: Mapping[str, float]
    _found: dict[int, tuple[LinearSet, ...]] = field(default_factory=dict)
    _known: dict[frozenset[str], LinearSet] = field(default_factory=dict)

    @classmethod
    def of(
        cls, white: FloatArray, tables: Sequence[FloatArray], owners: Sequence[str], cost: Mapping[str, float]
    ) -> LinearProblem:
        """From the whitened residual (n,) and every alternative's whitened signatures (n, k)."""
        ends = np.cumsum([t.shape[1] for t in tables]).tolist()
        columns = tuple(tuple(range(end - t.shape[1], end)) for end, t in zip(ends, tables, strict=True))
        stacked = np.concatenate(tables, axis=1) if tables else np.zeros((len(white), 0))
        return cls(stacked.T @ white, stacked.T @ stacked, tuple(owners), columns, cost)

    def best(self, size: int) -> tuple[LinearSet, ...]:
        """Return the sets of `size` members whose log odds are higher than those of each set without one of them,
        highest first. All singles and all pairs are compared; of larger sets those that extend the best of the next
        smaller size."""
        if size not in self._found:
            made = (
                list(self.singles.values())
                if size == 1
                else self.pairs
                if size == 2
                else self._larger(self.best(size - 1))
            )
            self._known.update({self.names(s): s for s in made})
            every = sorted(made, key=lambda s: -s.log_odds)
            if size == 2:
                self.best(1)
            self._found[size] = tuple(s for s in every if self._is_worth_its_members(s, self._known))
        return self._found[size]

    def scored(self, members: Sequence[int]) -> LinearSet:
        """Return the score of the alternatives `members` together."""
        where = np.concatenate([self.columns[m] for m in members]).astype(int)
        size = self._size[where]
        square = self.gram[np.ix_(where, where)] / np.outer(size, size)
        square[np.diag_indices_from(square)] += RIDGE
        lower = np.linalg.cholesky(square)
        z = self.z[where] / size
        u, _ = nnls(lower.T, np.linalg.solve(lower, z))
        score = float(max(2.0 * z @ u - u @ square @ u, 0.0))
        cuts = np.cumsum([len(self.columns[m]) for m in members])[:-1]
        cost = sum(self.cost.get(self.owners[m], 0.0) for m in members)
        return LinearSet(tuple(members), score, 0.5 * score - cost, tuple(np.split(u / size, cuts)))

    @cached_property
    def _size(self) -> FloatArray:
        size = np.sqrt(np.diag(self.gram))
        return np.where(size > 0, size, 1.0)

    @cached_property
    def _alternative(self) -> np.ndarray:
        """The alternative of every column."""
        return np.array([i for i, c in enumerate(self.columns) for _ in c], int)

    @cached_property
    def _owner(self) -> np.ndarray:
        """A number for the owner of every column."""
        number = {name: k for k, name in enumerate(dict.fromkeys(self.owners))}
        return np.array([number[self.owners[a]] for a in self._alternative], int)

    def names(self, one: LinearSet) -> frozenset[str]:
        """Return the owners of a set's members."""
        return frozenset(self.owners[m] for m in one.members)

    def _is_worth_its_members(self, one: LinearSet, known: Mapping[frozenset[str], LinearSet]) -> bool:
        key = self.names(one)
        less = [known[key - {name}] for name in key if key - {name} in known]
        return one.score > 0.0 and all(one.log_odds > s.log_odds for s in less)

    @cached_property
    def singles(self) -> Mapping[str, LinearSet]:
        """Of every owner, its best alternative."""
        best: dict[str, LinearSet] = {}
        for m, owner in enumerate(self.owners):
            tried = self.scored((m,))
            if owner not in best or tried.score > best[owner].score:
                best[owner] = tried
        return best

    @cached_property
    def pairs(self) -> Sequence[LinearSet]:
        """Every pair of owners. Which of their alternatives is fixed by the best two columns: exact where each
        alternative has one."""
        z, size = self.z / self._size, self._size
        rho = self.gram / np.outer(size, size)
        angle = np.maximum(1.0 - rho**2, LEAST_ANGLE)
        one, two = (z[:, None] - rho * z) / angle, (z - rho * z[:, None]) / angle
        both = np.where((one > 0) & (two > 0), one * z[:, None] + two * z, 0.0)
        bound = np.maximum(both, np.square(np.maximum(np.maximum(z[:, None], z), 0.0)))
        found = []
        owned = [np.flatnonzero(self._owner == k) for k in range(int(self._owner.max(initial=-1)) + 1)]
        for a, b in combinations(owned, 2):
            part = bound[np.ix_(a, b)]
            i, j = np.unravel_index(int(np.argmax(part)), part.shape)
            found.append(self.scored((int(self._alternative[a[i]]), int(self._alternative[b[j]]))))
        return found

    def _larger(self, smaller: Sequence[LinearSet]) -> list[LinearSet]:
        """Return the best smaller sets, each with the owners that promise most beside it: by what one column takes of
        what the set leaves."""
        found: dict[frozenset[str], LinearSet] = {}
        for start in smaller[:EXTENDED]:
            gain = self._gain_beside(start)
            names = self.names(start)
            inside = np.array([self.owners[a] in names for a in self._alternative], bool)
            gain[inside] = 0.0
            taken: set[int] = set()
            for column in np.argsort(-gain):
                if gain[column] <= 0.0 or len(taken) == EXTENSIONS:
                    break
                if self._owner[column] in taken:
                    continue
                taken.add(int(self._owner[column]))
                tried = self.scored((*start.members, int(self._alternative[column])))
                key = self.names(tried)
                if key not in found or tried.score > found[key].score:
                    found[key] = tried
        return list(found.values())

    def _gain_beside(self, start: LinearSet) -> FloatArray:
        """Return what every column by itself takes of the residual that a set leaves, its active columns free to move,
        (p,)."""
        where = np.concatenate([self.columns[m] for m in start.members]).astype(int)
        active = where[np.concatenate(start.share) > 0]
        rho = self.gram / np.outer(self._size, self._size)
        z = self.z / self._size
        inner = rho[np.ix_(active, active)] + RIDGE * np.eye(len(active))
        weight = np.linalg.solve(inner, np.column_stack([z[active], rho[active]]))
        left = z - rho[:, active] @ weight[:, 0]
        own = np.maximum(1.0 - np.einsum("ij,ji->i", rho[:, active], weight[:, 1:]), LEAST_ANGLE)
        return np.square(np.maximum(left, 0.0)) / own


def posterior(log_odds: Sequence[float]) -> FloatArray:
    """Probabilities of models that exclude one another, from their log posterior odds over any one of them, (n,)."""
    weights = np.exp(np.asarray(log_odds) - max(log_odds))
    return np.asarray(weights / weights.sum())


def smallest_set(probabilities: Sequence[float], share: float) -> tuple[int, ...]:
    """Indices of the fewest models that together hold `share`, likeliest first."""
    order = np.argsort(-np.asarray(probabilities), kind="stable")
    before = np.cumsum(np.asarray(probabilities)[order]) - np.asarray(probabilities)[order]
    return tuple(int(i) for i in order[before < share])
