"""Dark current: from the dark means, from the dark variances, and against temperature."""

from __future__ import annotations

import numpy as np

from lab.errors import NotDetermined
from lab.fit.noise.dark_signal import mean_and_std
from lab.fit.noise.evaluation import Evaluation, in_electrons, transfer_of
from lab.fit.noise.read_noise import dark_signal_hidden
from lab.fit.noise.temperature_law import temperature_law
from lab.fit.rounding import HIDDEN_DN2
from lab.fit.weighted_lines import dark_line
from lab.formats.results import DarkCurrentLaws


def dark_current(e: Evaluation) -> tuple[float | None, float | None]:
    """Dark current, e/s, and its standard deviation: slope of the dark mean against exposure over K."""
    if not e.levels.darks:
        return None, None
    line = e.dark.lines[None]
    if line.rate is None:
        e.remarks.add("all darks have one exposure: the dark current isn't determined; capture darks of a longer one")
        return None, None
    if dark_signal_hidden(e):
        return None, None
    return in_electrons(e, line.rate, float(np.sqrt(line.covariance[1, 1])))


def dark_current_from_variance(e: Evaluation) -> tuple[float | None, float | None]:
    """Dark current, e/s, and its standard deviation: slope of the dark variance against exposure over K^2, all planes
    together.

    K is that of the flats: the photon transfer of the darks themselves contains the same slope.
    """
    repeated = [level for level in e.levels.darks if level.repeats > 1]
    exposure = np.array([level.exposure_s for level in repeated])
    if np.unique(exposure).size < 3 or dark_signal_hidden(e):
        return None, None
    rates, weights = [], []
    for name in e.levels.names:
        own = [level.plane[name] for level in repeated]
        variance = np.array([plane.temporal_variance for plane in own])
        std = np.array([plane.temporal_variance_std for plane in own])
        if variance.min() < HIDDEN_DN2:
            return None, None
        line = dark_line(exposure, variance, std)
        if line.rate is not None:
            rates.append(line.rate)
            weights.append(1.0 / line.covariance[1, 1])
    try:
        flats = transfer_of(
            e.levels,
            e.dark,
            e.saturation,
            [level for level in repeated if level.exposure_s == exposure.min()],
            e.consistency.series,
        )[0]
    except NotDetermined:
        return None, None
    rate = float(np.average(rates, weights=weights))
    relative = 2.0 * flats.gain_std / flats.gain
    std_of_rate = float(np.hypot(np.sum(weights) ** -0.5, rate * relative))
    return rate / flats.gain**2, std_of_rate / flats.gain**2


def dark_temperature_c(e: Evaluation) -> float | None:
    """Sensor temperature (deg C) at which the dark currents were measured; None where the darks don't state it.

    It is the mean over the darks, weighted by exposure: a dark moves the slope of signal against exposure the more, the longer it is.
    """
    darks = [
        (level.exposure_s, level.temperature_c if level.sensor_c is None else level.sensor_c)
        for level in e.levels.darks
    ]
    known = [(exposure_s, sensor_c) for exposure_s, sensor_c in darks if sensor_c is not None]
    total_s = sum(exposure_s for exposure_s, _ in known)
    return sum(exposure_s * sensor_c for exposure_s, sensor_c in known) / total_s if total_s > 0 else None


def dark_current_temperature(e: Evaluation) -> DarkCurrentLaws | None:
    """Dark current at every temperature with darks of two exposures, and the laws through those significantly above
    0.
    """
    found: list[tuple[float, float, float]] = []
    temperatures = {level.temperature_c for level in e.levels.all_darks if level.temperature_c is not None}
    for temperature in sorted(temperatures):
        own = [level for level in e.levels.all_darks if level.temperature_c == temperature]
        line = dark_line(np.array([level.exposure_s for level in own]), *mean_and_std(own, e.levels.names))
        if line.rate is not None:
            std = float(np.sqrt(line.covariance[1, 1]))
            found.append((temperature, line.rate / e.transfer.gain, std / e.transfer.gain))
            own_value = ", the value given" if temperature == e.levels.temperature_c else ""
            e.remarks.add(f"the dark current at {temperature:g} deg C is {found[-1][1]:.4g} e/s{own_value}")
    return temperature_law(found, e.transfer.gain_std / e.transfer.gain) if found else None
