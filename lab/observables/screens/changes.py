"""What effects on the transfer function and on the screen's light change of the regressions of random patterns
(`bands`): of all coefficients that measurements of patterns read."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lab.observables.dataset import Dataset
from lab.observables.screens.bands import RINGS_CY_PER_PX
from lab.observables.screens.canvas import beyond_reference
from lab.observables.screens.patterns import EVEN_ORDER, EVEN_TERMS, Pattern, patterns
from lab.observables.screens.placement import even_powers
from sim.effects.base import Effects
from sim.point import common_wavelengths, detected_transfer, mix_channels, mixes_colours, transfer_at
from sim.spectrum import FloatArray
from sim.uniform import electron_rate

LEAST_TRANSFER = 1e-3  # of the baseline, below which a band's OTF has no ratio to it
PLACINGS = 4  # Gauss-Newton steps that find an image's shift


@dataclass(frozen=True)
class PatternChanges:
    """The changes of one pattern at one pose of the screen."""

    by: Callable[[Effects], dict[str, FloatArray]]  # by channel: change of the coefficients of `Pattern.mix`


def pattern_changes(dataset: Dataset) -> list[PatternChanges]:
    """Return the changes of each group of `patterns`, made once a dataset (`Dataset.once`)."""
    return [_changes_of(dataset, group) for group in patterns(dataset)]


def _changes_of(dataset: Dataset, group: Sequence[Pattern]) -> PatternChanges:
    sights = {p.channel: p for p in reversed(group)}  # seen and held-out repeats share one prediction
    plain = _transfers(dataset, sights, ())
    weights = {channel: _node_weights(p) for channel, p in sights.items()}

    @lru_cache(maxsize=8)
    def by(effects: Effects) -> dict[str, FloatArray]:
        found = {}
        transfers = zip(_transfers(dataset, sights, effects), plain, strict=True)
        for (channel, p), (otf, before) in zip(sights.items(), transfers, strict=True):
            real, imaginary, outside = weights[channel]
            within = real.shape[1]
            ratio = otf / np.where(np.abs(before) > LEAST_TRANSFER, before, np.inf)
            placed = _in_place(p, ratio[:within])
            change = real @ (np.real(placed) - 1.0) + imaginary @ np.imag(placed)
            found[channel] = change + outside @ np.real(otf - before)[within:] + p.shown_by(effects)[: len(real)]
        return found

    return PatternChanges(by)


def _transfers(dataset: Dataset, sights: Mapping[str, Pattern], effects: Effects) -> NDArray[np.complex128]:
    """OTFs of the channels of one pose, (channels, nodes), at the nodes of all bands and then of the parts beyond the
    bands."""
    camera, first = dataset.camera, next(iter(sights.values()))
    fx = np.concatenate([*(b.fx for b in first.bands), first.beyond[:, 0].ravel()])
    fy = np.concatenate([*(b.fy for b in first.bands), first.beyond[:, 1].ravel()])
    mixing = mixes_colours(camera, effects)
    channels = camera.channels if mixing else tuple(sights)  # neighbours of other colours count
    nodes, shares = common_wavelengths(camera, [(c, first.light) for c in channels], effects, "bernoulli")
    whole = np.array([transfer_at(camera, float(w), fx, fy, effects, moving=not mixing) for w in nodes])
    found = detected_transfer(camera, nodes, shares, whole, fx, fy, effects, first.places_um)
    if not mixing:
        return found
    rates = [1.0 if first.light is None else max(electron_rate(camera, c, first.light), 0.0) for c in channels]
    return mix_channels(camera, found, np.array(rates), fx, fy, effects)[[channels.index(c) for c in sights]]


def _node_weights(p: Pattern) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weights that take a ratio of OTFs to the coefficients of `Pattern.mix`: of its real part and of its imaginary
    part at the bands' nodes, (coefficients, nodes) each; and that take a change of the OTF to them, at the nodes beyond
    the bands, (coefficients, nodes).

    The real part is split into even powers of the frequency, fitted over the nodes by least squares, and a rest. The
    rest, and the imaginary part, enter by their means over the lower and the upper half of each band.
    """
    fx, fy = (np.concatenate([getattr(band, name) for band in p.bands]) for name in ("fx", "fy"))
    halves = np.zeros((2 * len(p.bands), len(fx)))
    start = 0
    for k, band in enumerate(p.bands):
        own = slice(start, start + len(band.fx))
        start += len(band.fx)
        for row, use in zip(halves[2 * k : 2 * k + 2], (~band.upper, band.upper), strict=True):
            share = np.where(use, band.share, 0.0)
            row[own] = share / share.sum() if share.sum() > 0 else band.share
    ends = np.cumsum([EVEN_TERMS, len(halves), len(halves)])
    smooth, by_half, by_phase, by_part = np.split(p.mix, ends, axis=1)
    powers = np.transpose(even_powers(fx, fy, EVEN_ORDER, RINGS_CY_PER_PX[-1]))
    weight = np.sqrt(np.concatenate([band.power * band.share for band in p.bands]))
    fit = np.linalg.pinv(weight[:, None] * powers) * weight
    outside = 0.5 * np.repeat(by_part, 2, axis=1)  # in two quadrants each
    outside /= beyond_reference(p.beyond[:, 0].ravel(), p.beyond[:, 1].ravel())
    return smooth @ fit + by_half @ (halves - halves @ powers @ fit), by_phase @ halves, outside


def _in_place(p: Pattern, ratio: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return a ratio of OTFs without the shift s that the registration would take up.

    s solves sum over nodes of P f Im(ratio exp(-2 pi i f s)) = 0 along both axes, P the power of the pattern, by
    Gauss-Newton steps."""
    if not np.any(np.abs(np.imag(ratio)) > 1e-6):
        return ratio
    turn = 2.0 * np.pi * np.array([np.concatenate([b.fx for b in p.bands]), np.concatenate([b.fy for b in p.bands])])
    weight = np.concatenate([b.power * b.share for b in p.bands])
    for _ in range(PLACINGS):
        slope = (turn * weight * np.maximum(np.real(ratio), 0.0)) @ turn.T
        shift = np.linalg.lstsq(slope, (turn * weight) @ np.imag(ratio), rcond=1e-9)[0]
        ratio = ratio * np.exp(-1j * shift @ turn)
    return ratio
