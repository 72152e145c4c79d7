"""Contrast of the image of a random pattern, by spatial frequency, orientation and channel."""

from __future__ import annotations

import numpy as np

from lab.errors import NotDetermined
from lab.observables.dataset import Dataset
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import SHOWN
from lab.observables.screens.changes import pattern_changes
from lab.observables.screens.patterns import Pattern, joint_covariance, patterns, place_jacobian
from sim.effects.base import Effects
from sim.point import TRANSFER_AT

LARGEST_STD = 0.04  # relative; bands of a larger standard deviation aren't used
#: Relative standard deviation of a band's contrast beside noise: error of the drawing. Of turned cells it is 1e-4 at
#: low and 5e-4 at high frequencies, of cells of a whole number of pixels that stand square 1e-4 to 4e-3.
CONTRAST_FLOOR = 0.0015
CONTRAST_SCALE_STD = (
    0.01  # prior standard deviation of the contrast's scale, for each channel of seen and held-out repeats
)
SCREEN_BLUR_PX = 0.08  # prior standard deviation of the Gaussian blur of the cells' borders


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
    changes = dataset.once(pattern_changes)

    def predict(effects: Effects) -> Prediction:
        mean = expected.copy()
        if effects:
            # seen and held-out repeats of a pattern share one prediction
            change = [changes[number].by(effects)[p.channel][b] for number, p, b in places]
            mean += reference * np.array(change)
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
