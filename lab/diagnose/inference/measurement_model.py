"""The measurement model: one normal distribution of everything that was measured on one side, for any set of effects.

y ~ N(m(effects), C),   C = S + J P J' + sum_k eps_k^2 (dm_k dm_k') o K

S       noise and floors of each measurement
J P J'  nuisance parameters, marginalised: J is the Jacobian of m by them, P their prior covariance
eps_k   form tolerance of effect k: its law may be wrong by this share of its own change dm_k
K       correlation kernel of that error: smooth along the measurement's axis

Held-out numbers are judged by their distribution given the seen ones.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from lab.observables.gaussian import ROUNDING, BlockCovariance, Gaussian
from lab.observables.noise.figures import NoiseFigures
from lab.observables.observable import Observable, Prediction
from sim.camera import CameraModel
from sim.effects.base import Effect, Effects
from sim.effects.library import list_changes
from sim.spectrum import FloatArray

#: Limits of the caches: entries of covariances (80 MB, and as much of their factors), and predictions.
CACHED_ENTRIES, CACHED_PREDICTIONS = 1e7, 20000
#: Prior standard deviations within which a nuisance parameter is what the camera may have.
MOST_PRIOR_STD = 3.0
#: Correlation of a law's error between two channels, and between two conditions, of one measurement.
CORRELATION_BETWEEN_CHANNELS = CORRELATION_BETWEEN_CONDITIONS = 0.7


class _NumberedEffect(NamedTuple):
    """An effect with a number, which is a cheaper key than its values, and whether it may change each block."""

    number: int
    acts: tuple[bool, ...]
    effect: Effect


def form_name(effect: Effect, number: int) -> str:
    """Return the name of the nuisance parameter that mixes another form of an effect's law with the one that stands."""
    return f"form {number} of {effect.name}"


@dataclass
class MeasurementModel:
    """The blocks of one side, stacked into one vector of n numbers.

    `always` are effects that the baseline has: they act first, and their laws have tolerances like those of others.
    `unstated_jacobian` has columns (n,) by nuisance parameters that stand for what nobody states, per prior standard
    deviation. `gain_is_known`: whether the camera's conversion gain is stated or measured, and not 1 for want of both.
    `noise`: the first estimates about which the predictions are linear. Predictions are cached by block, as most
    effects act on few blocks."""

    blocks: tuple[Observable, ...]
    camera: CameraModel
    always: tuple[Effect, ...] = ()
    unstated_jacobian: Mapping[str, FloatArray] = field(default_factory=dict)
    gain_is_known: bool = True
    noise: NoiseFigures | None = None
    _predictions: dict[tuple[int, ...], Prediction] = field(default_factory=dict)
    _covariances: dict[tuple[bytes, tuple[int, ...], tuple[float, float]], BlockCovariance] = field(
        default_factory=dict
    )
    _numbers: dict[Effect, _NumberedEffect] = field(default_factory=dict)

    # --- the numbers -------------------------------------------------------------------------------------------------

    @cached_property
    def value(self) -> FloatArray:
        """The measured numbers, (n,)."""
        return np.concatenate([b.value for b in self.blocks])

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Where each block's numbers stand."""
        ends = np.cumsum([len(b.value) for b in self.blocks])
        return tuple(slice(int(e) - len(b.value), int(e)) for b, e in zip(self.blocks, ends, strict=True))

    @cached_property
    def seen(self) -> np.ndarray:
        """Mask (n,) of the numbers that choice and fit may use; the others are held out."""
        return np.array([not label.held_out for b in self.blocks for label in b.labels])

    @property
    def seen_value(self) -> FloatArray:
        """The measured numbers that aren't held out."""
        return self.value[self.seen]

    def mask(self, index: int) -> np.ndarray:
        """Mask (n,) of one block's numbers."""
        mask = np.zeros(len(self.value), bool)
        mask[self.slices[index]] = True
        return mask

    def captures(self, held_out: bool, where: np.ndarray | None = None) -> tuple[str, ...]:
        """Ids of the captures of held-out or of seen numbers, of all or of those that `where` (n,) marks."""
        labels = [label for b in self.blocks for label in b.labels]
        names: dict[str, None] = {}
        for i, label in enumerate(labels):
            if label.held_out == held_out and (where is None or where[i]):
                names.update(dict.fromkeys(label.captures))
        return tuple(sorted(names))

    # --- which effects act where -------------------------------------------------------------------------------------

    @cached_property
    def _acting(self) -> dict[type[Effect], tuple[bool, ...]]:
        return {}

    def acts(self, effect: type[Effect]) -> tuple[bool, ...]:
        """Return whether an effect may change each block: its mean or its scatter."""
        if effect not in self._acting:
            self._acting[effect] = tuple(block.touched_by(effect) or block.scatters_by(effect) for block in self.blocks)
        return self._acting[effect]

    def affected_blocks(self, effect: Effect) -> list[int]:
        """Indices of the blocks whose mean an effect may change."""
        return [i for i, block in enumerate(self.blocks) if block.touched_by(type(effect))]

    def affected(self, effect: type[Effect]) -> np.ndarray:
        """Mask (n,) of the numbers whose mean an effect may change."""
        mask = np.zeros(len(self.value), bool)
        for block, at in zip(self.blocks, self.slices, strict=True):
            mask[at] = block.touched_by(effect)
        return mask

    def change_chi2(self, effect: Effect, others: Effects, index: int) -> float:
        """Size of an effect in one block beside others: sum of its squared changes over the numbers' own variances."""
        at = self.slices[index]
        change = self.mean((*others, effect))[at] - self.mean(others)[at]
        return float(np.sum(np.square(change) / np.diag(self.blocks[index].covariance)))

    def strongest_block(self, effect: Effect, effects: Effects) -> int:
        """Index of the block that an effect changes most, beside the other members of `effects`."""
        others = tuple(e for e in effects if e.name != effect.name)
        return max(self.affected_blocks(effect), key=lambda i: self.change_chi2(effect, others, i), default=0)

    # --- predictions -------------------------------------------------------------------------------------------------

    def _numbered(self, acting: Effects) -> list[_NumberedEffect]:
        return [self._numbers.get(e) or self._number(e) for e in acting]

    def _number(self, effect: Effect) -> _NumberedEffect:
        """Give an effect a number. As it stands it may change less than its kind: a law on any stage acts on one."""
        changes = list_changes(effect)
        acts = tuple(
            may and not changes.isdisjoint(block.reads | block.scattered_by)
            for may, block in zip(self.acts(type(effect)), self.blocks, strict=True)
        )
        return self._numbers.setdefault(effect, _NumberedEffect(len(self._numbers), acts, effect))

    def _prediction(self, index: int, acting: list[_NumberedEffect]) -> Prediction:
        here = [e for e in acting if e.acts[index]]
        key = index, *(e.number for e in here)
        if key not in self._predictions:
            if len(self._predictions) > CACHED_PREDICTIONS:
                self._predictions.clear()
            self._predictions[key] = self.blocks[index].predict(tuple(e.effect for e in here))
        return self._predictions[key]

    def mean(self, effects: Effects = ()) -> FloatArray:
        """m(effects), (n,), at the first guess of the nuisance parameters."""
        return self._mean_of((*self.always, *effects))

    def _mean_of(self, acting: Effects) -> FloatArray:
        numbered = self._numbered(acting)
        return np.concatenate([self._prediction(i, numbered).mean for i in range(len(self.blocks))])

    def nuisance_jacobian(self, effects: Effects = (), without: frozenset[str] = frozenset()) -> dict[str, FloatArray]:
        """Columns (n,) of the Jacobian by every nuisance parameter that isn't in `without`, per prior standard
        deviation. One that several blocks name is one column."""
        columns = {name: column for name, column in self.unstated_jacobian.items() if name not in without}
        acting = self._numbered((*self.always, *effects))
        columns |= self._form_changes((*self.always, *effects))
        for index, at in enumerate(self.slices):
            for name, column in self._prediction(index, acting).jacobian.items():
                if name in without:
                    continue
                if name not in columns:
                    columns[name] = np.zeros(len(self.value))
                columns[name][at] = column
        return columns

    def _form_changes(self, acting: Effects) -> dict[str, FloatArray]:
        """Changes (n,) of the prediction by the other forms of the acting effects' laws, by `form_name`: columns of the
        Jacobian by coefficients that are 0 for the form as it stands, and 1 for the other, per standard deviation."""
        base, found = None, {}
        for i, effect in enumerate(acting):
            for number, other in enumerate(effect.other_forms()):
                base = self._mean_of(acting) if base is None else base
                change = self._mean_of((*acting[:i], other, *acting[i + 1 :])) - base
                if change.any():
                    found[form_name(effect, number)] = change
        return found

    @cached_property
    def single_block_nuisances(self) -> frozenset[str]:
        """Nuisance parameters of one block alone, which belong to the covariance of that block."""
        count = Counter(name for i in range(len(self.blocks)) for name in self._prediction(i, []).jacobian)
        return frozenset(name for name, blocks in count.items() if blocks == 1)

    def _shared_jacobian(self, effects: Effects) -> FloatArray:
        """Return the Jacobian by nuisance parameters of several blocks, (n, k)."""
        columns = list(self.nuisance_jacobian(effects, self.single_block_nuisances).values())
        return np.column_stack(columns) if columns else np.zeros((len(self.value), 0))

    # --- distributions -----------------------------------------------------------------------------------------------

    @cached_property
    def _correlation_kernels(self) -> tuple[FloatArray, ...]:
        """K of each block, (m, m): squared exponential along the axis, reduced between channels and between
        conditions."""
        found = []
        for block in self.blocks:
            x = block.position.reshape(len(block.value), -1)
            channel = np.array([label.channel for label in block.labels])
            condition = np.array([label.condition for label in block.labels])
            kernel = np.exp(-0.5 * np.square((x[:, None] - x) / block.reach).sum(-1))
            kernel = kernel * np.where(channel[:, None] == channel, 1.0, CORRELATION_BETWEEN_CHANNELS)
            if block.measurement.conditions and not block.measurement.places:
                kernel = kernel * np.where(condition[:, None] == condition, 1.0, CORRELATION_BETWEEN_CONDITIONS)
            found.append(kernel)
        return tuple(found)

    def gaussian(
        self,
        effects: Effects = (),
        where: np.ndarray | None = None,
        tolerated: float = 1.0,
        least_tolerance: float = 0.0,
    ) -> Gaussian:
        """Return the distribution under these effects, of all numbers or of those that `where` (n,) marks. `tolerated`:
        share of the declared form tolerances; each is `least_tolerance` at least."""
        where = np.ones(len(self.value), bool) if where is None else where
        acting = self._numbered((*self.always, *effects))
        blocks = tuple(
            self._block_covariance(index, acting, where, tolerated, least_tolerance)
            for index in range(len(self.blocks))
        )
        return Gaussian(self.mean(effects)[where], blocks, self._shared_jacobian(effects)[where])

    def seen_gaussian(self, effects: Effects = (), tolerated: float = 1.0, least_tolerance: float = 0.0) -> Gaussian:
        """Return the distribution of the seen numbers; arguments as of `gaussian`."""
        return self.gaussian(effects, self.seen, tolerated, least_tolerance)

    def _block_covariance(
        self,
        index: int,
        acting: list[_NumberedEffect],
        where: np.ndarray,
        tolerated: float,
        least_tolerance: float,
    ) -> BlockCovariance:
        only = where[self.slices[index]]
        here = [e for e in acting if e.acts[index]]
        shares = (tolerated, least_tolerance) if here else (1.0, 0.0)
        key = only.tobytes(), (index, *(e.number for e in here)), shares
        if key not in self._covariances:
            if sum(c.covariance.size for c in self._covariances.values()) > CACHED_ENTRIES:
                self._covariances.clear()
            block, both = self.blocks[index], np.ix_(only, only)
            covariance = block.covariance[both].copy()
            prediction = self._prediction(index, here)
            own = [c[only] for name, c in prediction.jacobian.items() if name in self.single_block_nuisances]
            if own:
                covariance += np.transpose(own) @ np.array(own)
            for i, one in enumerate(here):
                change = prediction.mean - self._prediction(index, [*here[:i], *here[i + 1 :]]).mean
                error = max(tolerated * one.effect.form_tolerance, least_tolerance) * change[only]
                if error.any():
                    covariance += error[:, None] * self._correlation_kernels[index][both] * error
            # measurements of the same frames leave directions whose variance rounding could make negative
            covariance[np.diag_indices_from(covariance)] *= 1.0 + ROUNDING
            self._covariances[key] = BlockCovariance(covariance)
        return self._covariances[key]

    # --- what the seen numbers tell ----------------------------------------------------------------------------------
    # `discrepancies` are covariances (m, m) of model discrepancies by the index of their block.

    def weighted_residual(
        self, effects: Effects = (), discrepancies: Mapping[int, FloatArray] | None = None
    ) -> FloatArray:
        """w = C^-1 (y - m) of the seen numbers, zero at the others, (n,). The posterior mean of any part A of the model
        with covariance J P J' is J P J' w."""
        gaussian = self.seen_gaussian(effects)
        for index, kernel in (discrepancies or {}).items():
            seen = self.seen[self.slices[index]]
            gaussian = gaussian.with_discrepancy(index, kernel[np.ix_(seen, seen)])
        found = np.zeros(len(self.value))
        found[self.seen] = gaussian.solve(self.seen_value - gaussian.mean)
        return found

    def nuisance_estimates(
        self, effects: Effects = (), discrepancies: Mapping[int, FloatArray] | None = None
    ) -> dict[str, float]:
        """Posterior means of the nuisance parameters by name, in prior standard deviations from their first guess."""
        weighted = self.weighted_residual(effects, discrepancies)
        return {name: float(column @ weighted) for name, column in self.nuisance_jacobian(effects).items()}

    def discrepancy_mean(self, effects: Effects, discrepancies: Mapping[int, FloatArray]) -> FloatArray:
        """Posterior mean of the model discrepancies, at all numbers, (n,)."""
        mean = np.zeros(len(self.value))
        if discrepancies:
            weighted = self.weighted_residual(effects, discrepancies)
            for index, kernel in discrepancies.items():
                mean[self.slices[index]] = kernel @ weighted[self.slices[index]]
        return mean

    def fitted_mean(self, effects: Effects = (), discrepancies: Mapping[int, FloatArray] | None = None) -> FloatArray:
        """Prediction of all numbers at the posterior means of nuisance parameters and discrepancies, (n,)."""
        found = self.nuisance_estimates(effects, discrepancies)
        moved = sum(found[name] * column for name, column in self.nuisance_jacobian(effects).items())
        return np.asarray(self.mean(effects) + moved + self.discrepancy_mean(effects, discrepancies or {}))

    def stated_mean(self, found: Mapping[str, float]) -> FloatArray:
        """Prediction of all numbers by the baseline alone, (n,), with the nuisance parameters `found` by a better
        model, within `MOST_PRIOR_STD` of their first guesses.

        The posterior means of a baseline that lacks physics are no camera's: nuisance parameters stand in for what is
        missing, some by tens of their prior standard deviations.
        """
        columns = self.nuisance_jacobian()
        near = {n: float(np.clip(v, -MOST_PRIOR_STD, MOST_PRIOR_STD)) for n, v in found.items() if n in columns}
        return np.asarray(self.mean() + sum(value * columns[name] for name, value in near.items()))

    def held_out(
        self,
        effects: Effects = (),
        where: np.ndarray | None = None,
        discrepancies: Mapping[int, FloatArray] | None = None,
    ) -> tuple[float, int]:
        """chi2 and count of the held-out numbers given the seen ones: -2 log p(held out | seen) = chi2(both) -
        chi2(seen).

        `where` (n,) limits which are judged. Discrepancies enter by their posterior means alone: their variance isn't
        added, so that one that predicts wrongly raises chi2.
        """
        out = ~self.seen if where is None else ~self.seen & where
        if not out.any():
            return 0.0, 0
        both = self.seen | out
        value = self.value - self.discrepancy_mean(effects, discrepancies or {})
        all_of = self.gaussian(effects, both).chi2(value[both])
        given = self.seen_gaussian(effects).chi2(value[self.seen])
        return max(all_of - given, 0.0), int(out.sum())
