"""Contrast of the image of a random pattern, by spatial frequency, orientation and channel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lab.errors import NotDetermined
from lab.observables.dataset import Dataset
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import SHOWN
from lab.observables.screens.bands import RINGS_CY_PER_PX
from lab.observables.screens.canvas import beyond_reference
from lab.observables.screens.patterns import (
    EVEN_ORDER,
    EVEN_TERMS,
    Pattern,
    joint_covariance,
    patterns,
    place_jacobian,
)
from lab.observables.screens.placement import even_powers
from sim.effects.base import Effects
from sim.point import TRANSFER_AT, common_wavelengths, detected_transfer, mix_channels, mixes_colours, transfer_at
from sim.spectrum import FloatArray
from sim.uniform import electron_rate

LARGEST_STD = 0.04  # relative; bands of a larger standard deviation aren't used
#: Relative standard deviation of a band's contrast beside noise: error of the drawing. Of turned cells it is 1e-4 at
#: low and 5e-4 at high frequencies, of cells of a whole number of pixels that stand square 1e-4 to 4e-3.
CONTRAST_FLOOR = 0.0015
CONTRAST_SCALE_STD = (
    0.01  # prior standard deviation of the contrast's scale, for each channel of seen and held-out repeats
)
SCREEN_BLUR_PX = 0.08  # prior standard deviation of the Gaussian blur of the cells' borders
LEAST_TRANSFER = 1e-3  # of the baseline, below which a band's OTF has no ratio to it
PLACINGS = 4  # Gauss-Newton steps that find an image's shift


def measure_bernoulli(dataset: Dataset) -> Observable:
    """Contrast of a random pattern's image over that of the pattern, by frequency, orientation and channel: the bands'
    coefficients of `bands`.

    Nuisance parameters: the contrast's scale, and a blur of the screen's cells. Raises NotDetermined where no band is
    known to `LARGEST_STD`.
    """
    found = patterns(dataset)
    labels: list[Label] = []
    places: list[tuple[int, Pattern, int]] = []
    for number, group in enumerate(found):
        for p in group:
            spread = np.sqrt(np.diag(p.shown + p.common))
            for b, band in enumerate(p.bands):
                if spread[b] < LARGEST_STD * p.value[b] and b > 0:  # the lowest is that of white and black levels
                    places.append((number, p, b))
                    labels.append(Label(band.frequency, p.channel, f"{band.angle_deg:.0f} deg", p.captures, p.held_out))
    if not places:
        raise NotDetermined("bernoulli", "the patterns are too noisy, or too few of their cells are in view")
    reference = np.array([p.bands[b].reference for _, p, b in places])
    value = reference * np.array([p.value[b] for _, p, b in places])
    expected = reference * np.array([p.baseline[b] for _, p, b in places])
    frequency = np.array([label.x for label in labels])
    covariance = np.outer(reference, reference) * joint_covariance(places) + np.diag((CONTRAST_FLOOR * expected) ** 2)
    by_place = place_jacobian([(g, r * p.by_place[b]) for (g, p, b), r in zip(places, reference, strict=True)])
    scales = [f"pattern:{number}:{p.channel}:{p.held_out}" for number, p, _ in places]
    # seen and held-out repeats of a pattern share one prediction
    poses: list[dict[str, tuple[Pattern, list[int], list[int]]]] = [{} for _ in found]
    for k, (number, p, b) in enumerate(places):
        _, members, parts = poses[number].setdefault(p.channel, (p, [], []))
        members.append(k)
        parts.append(b)
    poses = [sights for sights in poses if sights]
    plain = [_transfers(dataset, sights, ()) for sights in poses]
    weights = [[_node_weights(p) for p, *_ in sights.values()] for sights in poses]

    def predict(effects: Effects) -> Prediction:
        mean = expected.copy()
        if effects:
            for sights, of_nodes, before in zip(poses, weights, plain, strict=True):
                after = _transfers(dataset, sights, effects)
                for (p, members, parts), (real, imaginary, outside), otf, plain_otf in zip(
                    sights.values(), of_nodes, after, before, strict=True
                ):
                    within = real.shape[1]
                    ratio = otf / np.where(np.abs(plain_otf) > LEAST_TRANSFER, plain_otf, np.inf)
                    placed = _in_place(p, ratio[:within])
                    change = real @ (np.real(placed) - 1.0) + imaginary @ np.imag(placed)
                    change = change + outside @ np.real(otf - plain_otf)[within:] + p.shown_by(effects)[: len(real)]
                    mean[members] += reference[members] * change[parts]
            mean = np.where(np.isfinite(mean), mean, expected)
        jacobian = by_place | {"pattern:blur": -2.0 * np.square(np.pi * SCREEN_BLUR_PX * frequency) * mean}
        for name in dict.fromkeys(scales):
            jacobian[name] = CONTRAST_SCALE_STD * mean * np.array([s == name for s in scales])
        return Prediction(mean, jacobian)

    return Observable(
        measurement=BERNOULLI, reach=0.2, value=value, covariance=covariance,
        labels=tuple(labels), reads=TRANSFER_AT | SHOWN | {"image.transmittance"}, predict=predict,
        scale=np.abs(expected),
    )  # fmt: skip


def _transfers(
    dataset: Dataset, sights: dict[str, tuple[Pattern, list[int], list[int]]], effects: Effects
) -> NDArray[np.complex128]:
    """OTFs of the channels of one pose, (channels, nodes), at the nodes of all bands and then of the parts beyond the
    bands."""
    camera, first = dataset.camera, next(iter(sights.values()))[0]
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
    """Weights that take a ratio of OTFs to the bands' coefficients: of its real part and of its imaginary part at the
    bands' nodes, (bands, nodes) each; and that take a change of the OTF to them, at the nodes beyond the bands, (bands,
    nodes).

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


BERNOULLI = Measurement(
    "bernoulli",
    title="contrast of random patterns",
    order=410,
    axis="spatial_frequency",
    unit="cy/px",
    make=measure_bernoulli,
    quantity="contrast",
    conditions="orientation",
    conditions_words="bands at",
)
