"""The light of flats that nobody states absolutely: its rate as the fitted flats show it, for levels relative to
theirs.

The mean of flats is linear in the rate of each lamp and channel. With y the fitted flats' means, A their Jacobian by
the rates, J that by the parameters p that the model's posterior knows, at p0 (generalised least squares, weights W)

    rate(p) = a + B (p - p0) + noise,   a = (A' W A)^-1 A' W (y - m(p0)),   B = -(A' W A)^-1 A' W J

so that the error of a parameter, and of the rate that was read with it, go together into the levels to come.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.outcome.model_posterior import coordinate_name, effect_jacobian, with_unnamed
from lab.errors import InputError, NotDetermined
from lab.formats.model_posterior import ModelPosterior
from lab.inference.coordinates import coordinates
from lab.observables.dataset import Dataset
from lab.observables.flats.linearity import measure_photon_transfer, reading
from lab.observables.observable import Observable
from sim.effects.base import Effects
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import electron_rate

#: Beginning of the names of the rates, and their prior relative standard deviation, one unit of the Jacobian.
RATE, RATE_STD = "rate:", 0.05
#: The light that stands for one of which only the photons are known.
EVEN = Spectrum.of((380.0, 780.0), (0.01, 0.01))


@dataclass(frozen=True)
class RelativeLight:
    """The rates of n lamps and channels, DN for a unit of dose (`doses`), relative to `per_dose` in units of
    `RATE_STD`: `value` (n,), its derivatives `by` (n, k) by the parameters `parameters`, and the covariance (n, n) of
    the rest."""

    per_dose: Mapping[str, float]
    value: FloatArray
    parameters: tuple[str, ...]
    by: FloatArray
    covariance: FloatArray

    def dn_per_dose(self) -> float:
        """Return the rate of the brightest lamp and channel, DN."""
        return max(base * (1.0 + RATE_STD * z) for base, z in zip(self.per_dose.values(), self.value, strict=True))

    def about(self, per_dose: Mapping[str, float]) -> RelativeLight:
        """Return the same relative to other rates. Raises InputError for a lamp that the fitted flats haven't seen."""
        unknown = [name for name in per_dose if name not in self.per_dose]
        if unknown:
            raise InputError(
                f"plan: the fitted flats show no light {unknown[0].removeprefix(RATE)}; plan flats in their light"
            )
        at = [list(self.per_dose).index(name) for name in per_dose]
        ratio = np.array([self.per_dose[name] / base for name, base in per_dose.items()])
        value = (ratio * (1.0 + RATE_STD * self.value[at]) - 1.0) / RATE_STD
        covariance = self.covariance[np.ix_(at, at)] * np.outer(ratio, ratio)
        return RelativeLight(dict(per_dose), value, self.parameters, self.by[at] * ratio[:, None], covariance)


def relative_light(dataset: Dataset, effects: Effects, posterior: ModelPosterior) -> RelativeLight:
    """Return the light of the flats of `dataset`, the recordings that the model was fitted to, about whose figures it
    is linear.

    Raises InputError where their levels can't be compared.
    """
    try:
        block = measure_photon_transfer(dataset)
    except NotDetermined as refused:
        raise InputError(
            f"--fitted {dataset.recordings.source}: {refused.reason}; give the fitted recordings"
        ) from refused
    model = MeasurementModel((block,), dataset.camera, gain_is_known=True, noise=dataset.noise)
    columns = dict(model.nuisance_jacobian(effects))
    rates = {name: columns.pop(name) for name in [*columns] if name.startswith(RATE)}
    acting = with_unnamed(effects, posterior)
    coords = coordinates(acting, model.camera)
    by_effect = effect_jacobian(model, acting, coords).T
    known = {name: columns.pop(name) for name in [*columns] if name in posterior.names}
    known |= {
        name: column
        for c, column in zip(coords, by_effect, strict=True)
        if (name := coordinate_name(acting, c)) in posterior.names
    }
    mean, _ = posterior.select(list(known))
    jacobian = np.column_stack([*known.values(), np.zeros((len(block.value), 0))])
    noise = block.covariance + sum((np.outer(c, c) for c in columns.values()), np.zeros_like(block.covariance))
    of_rates = np.column_stack(list(rates.values()))
    weighted = np.linalg.solve(noise, of_rates).T
    covariance = np.asarray(np.linalg.inv(weighted @ of_rates), float)
    value = covariance @ weighted @ (block.value - model.mean(effects) - jacobian @ mean)
    return RelativeLight(
        rates_per_dose(dataset, block), value, tuple(known), -covariance @ weighted @ jacobian, covariance
    )


def rates_per_dose(dataset: Dataset, block: Observable) -> dict[str, float]:
    """Return DN for a unit of dose, in the baseline's linear response, by the name of each rate."""
    dose = doses(dataset, block)
    rates = {}
    for name, column in block.predict(()).jacobian.items():
        if name.startswith(RATE) and column.any():
            mine = column != 0.0
            rates[name] = float(np.median(column[mine] / RATE_STD / dose[mine]))
    return rates


def doses(dataset: Dataset, block: Observable) -> FloatArray:
    """Return the dose (n,) of the flats' means: photons a pixel, or electrons by the stated radiance and curves."""
    dose = []
    for label in block.labels:
        capture = dataset.recordings.capture(label.captures[0])
        light = reading(dataset, capture)  # type: ignore[arg-type]
        assert light is not None  # the block leaves out flats without it
        rate = light.photons_per_s
        if light.path is not None:
            rate = electron_rate(dataset.camera, label.channel, dataset.spectrum(light.path))
        dose.append(rate * capture.exposure_s)
    return np.array(dose)
