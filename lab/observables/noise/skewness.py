"""The skewness of flats' temporal noise: it tells electrons that are multiplied at random from a conversion gain.

The slope of variance over mean is K F^2 and no more. The third central moment k3 of n electrons that are multiplied by
a random number g (read noise has none) is K^3 n E g^3, so that k3 mu / (variance - read noise's)^2 = E g^3 / (E g^2)^2
doesn't hold the gain: 1 of single electrons, 1.5 of exponentially distributed g.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lab.capture_kinds.flat import FlatCapture
from lab.errors import NotDetermined
from lab.observables.dataset import CLIPPED_SHARE, Dataset, held_out_flats
from lab.observables.flats.noise import behind
from lab.observables.noise.temporal import ENOUGH, OUTLIER
from lab.observables.observable import LEVEL_REACH, Label, Measurement, Observable, Prediction
from lab.observables.plane_means import channel_pixels
from sim.effects.base import Effects
from sim.uniform import Uniform

LEAST_REPEATS = 3  # of an unbiased third moment
MOST_STD = 1.0  # of a number beside chance: brighter levels tell less
HIGHEST_SHARE = 0.3  # of saturation: above, bends of the response and of the converter have a skewness of their own
LEAST_DN2 = 1.0  # variance, of codes of a step of 1 DN, below which rounding has a third moment
SKEWNESS_FLOOR = 0.04  # beside chance: small bends of the converter, pixels that are left out


@dataclass(frozen=True)
class _Skewness:
    """k3 mu / (variance - read noise's)^2 of one channel in the repeats of a level."""

    channel: str
    signal_dn: float
    value: float
    std: float
    setting: str
    gain: float  # factor on the dataset's conversion gain
    gain_db: float
    captures: tuple[str, ...]
    held_out: bool


def _of_repeats(dataset: Dataset, captures: Sequence[FlatCapture], held_out: bool) -> list[_Skewness]:
    """Return the numbers of one level's repeats by channel.

    k3 = n / ((n - 1)(n - 2)) sum (x - <x>)^3 is unbiased. Of normal noise s^2 its variance is 6 n s^6 / ((n - 1)(n -
    2)) a pixel. Frames are brought to one level by factors; pixels beyond `OUTLIER` standard deviations are left out.
    """
    cfa, noise, found = dataset.camera.cfa, dataset.noise, []
    first = dataset.recordings.frame(captures[0])
    use = list(captures)[: max(LEAST_REPEATS, int(np.ceil(ENOUGH / first.size)))]
    n, gain_db = len(use), captures[0].gain_db or 0.0
    gain = 10.0 ** ((gain_db - dataset.usual_gain_db) / 20.0)
    frames = [dataset.recordings.frame(c) for c in use]
    for channel in dataset.channels:
        planes = np.array([channel_pixels(frame, cfa, channel) for frame in frames], np.float64)
        if float(np.mean((planes >= dataset.saturation_dn) | (planes <= 0))) >= 0.1 * CLIPPED_SHARE:
            continue
        planes -= noise.black
        means = planes.reshape(n, -1).mean(axis=1)
        signal = float(means.mean())
        if not 0.0 < signal < HIGHEST_SHARE * (dataset.saturation_dn - noise.black):
            continue
        planes *= (signal / means).reshape(-1, *(1,) * (planes.ndim - 1))
        away = planes - planes.mean(axis=0)
        squares = np.sum(np.square(away), axis=0) / (n - 1)
        kept = np.max(np.abs(away), axis=0) < OUTLIER * np.sqrt(float(squares.mean()))
        pixels = int(np.count_nonzero(kept))
        variance = float(squares[kept].mean())
        shot = variance - (noise.read_dn * gain) ** 2
        if shot < 0.2 * variance or variance < LEAST_DN2 * dataset.step_dn**2:
            continue
        factor = n / ((n - 1.0) * (n - 2.0))
        third = factor * float(np.sum(np.einsum("k...,k...,k...->...", away, away, away)[kept])) / pixels
        std = np.sqrt(6.0 * factor / pixels) * variance**1.5 * signal / shot**2
        if std < MOST_STD:
            found.append(
                _Skewness(
                    channel, signal, third * signal / shot**2, float(std), f"{captures[0].exposure_s:.4g} s",
                    gain, gain_db, tuple(c.id for c in use), held_out,
                )
            )  # fmt: skip
    return found


def measure_noise_skewness(dataset: Dataset) -> Observable:
    """k3 mu / (variance - read noise's)^2 of faint flats by channel: 1 of single electrons.

    Raises NotDetermined where no faint flat is repeated `LEAST_REPEATS` times.
    """
    out = dataset.once(held_out_flats)
    points: list[_Skewness] = []
    for group in dataset.flat_levels():
        for part in ([c for c in group if c.id not in out], [c for c in group if c.id in out]):
            if len(part) >= LEAST_REPEATS:
                points += _of_repeats(dataset, part, part[0].id in out)
    if not points:
        raise NotDetermined(
            "noise_skewness",
            f"no flat below {HIGHEST_SHARE:.0%} of saturation with {LEAST_REPEATS} repeats whose noise's skewness has "
            f"a standard deviation below {MOST_STD:g}",
        )
    points.sort(key=lambda p: p.signal_dn)
    signal = np.array([p.signal_dn for p in points])
    std = np.array([p.std for p in points])

    def predict(effects: Effects) -> Prediction:
        model = Uniform(dataset.camera, effects)
        return Prediction(np.array([_predicted(dataset, model, effects, p) for p in points]), {})

    return Observable(
        measurement=NOISE_SKEWNESS, reach=LEVEL_REACH, along=np.log(np.maximum(signal, 1.0)),
        value=np.array([p.value for p in points]), covariance=np.diag(np.square(std) + SKEWNESS_FLOOR**2),
        labels=tuple(Label(p.signal_dn, p.channel, p.setting, p.captures, p.held_out) for p in points),
        reads=frozenset({"charge.excess", "charge.variance_e2", "signal.response", "signal.filters"}),
        predict=predict, scale=np.ones(len(points)),
    )  # fmt: skip


def _predicted(dataset: Dataset, model: Uniform, effects: Effects, p: _Skewness) -> float:
    """Multiplications by g leave E g^3 / (E g^2)^2. A response r adds 3 r r'' / r'^2, as
    normal noise gets skewed; what scales the noise by s leaves s^3 of the third moment over s^4; a filter k of a plane
    leaves sum k^3 / (sum k^2)^2."""
    excess = model.excess_factor(p.gain_db)
    value = model.multiplied_skewness(p.gain_db)
    gain = dataset.noise.gain * p.gain
    electrons, _ = behind(np.array([p.signal_dn / gain]), np.ones(1), effects, dataset)
    e = float(electrons[0, 0])
    ratio = float(model.shot_e2(np.array([e]), p.gain_db)[0]) / (excess * e)
    value /= np.sqrt(max(ratio, 1e-3))
    if not model.is_linear:
        step = 0.01 * e
        low, middle, high = (float(v) for v in model.response(np.array([e - step, e, e + step])))
        slope, bend = (high - low) / (2.0 * step), (high - 2.0 * middle + low) / step**2
        value += 3.0 * middle * bend / slope**2
    kernel = model.filter_kernel()
    if kernel is not None:
        value *= float(np.sum(kernel**3) / np.sum(np.square(kernel)) ** 2)
    return value


NOISE_SKEWNESS = Measurement(
    "noise_skewness",
    title="skewness of the noise",
    order=225,
    axis="level",
    unit="DN",
    make=measure_noise_skewness,
    quantity="third moment x mean / (shot noise's variance)²",
    of_variances=True,
)
