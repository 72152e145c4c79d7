"""Black level, read noise, and the dark current at each temperature."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lab.errors import NotDetermined
from lab.fit.noise.evaluation import Evaluation, in_electrons, transfer_of
from lab.formats.results import DarkCurrentLaws
from lab.observables.flats.level_lines import mean_and_std
from lab.observables.weighted_lines import chi2_factor, dark_line, least_squares
from sim.parameters import Frozen

# The law of the dark current against temperature.


BOLTZMANN_EV_PER_K = 8.617333262e-5
ZERO_C_K = 273.15
#: Rise in temperature that doubles the dark current of silicon, where no fit tells it: ln 2 k T^2 / E at 300 K with an
#: activation energy between that of diffusion, 1.12 eV, and that of generation amid the band gap, 0.56 eV (Widenhorn et
#: al. 2002, Proc. SPIE 4669, 193):
#: 4.8 to 9.6 K, of uniform probability.
DOUBLING_C, DOUBLING_C_STD = 7.2, 1.4
#: Standard deviation of the temperature of a sensor that states none: a laboratory's air of 18 to 26 degrees, and a
#: camera that is between cold and warmed up by 12 degrees, both of uniform probability: hypot(8, 12) / sqrt(12).
UNKNOWN_C_STD = 4.2
#: Standard deviation of a reading of the sensor's own thermometer against itself: a resolution of 0.125 degrees, and
#: its noise.
THERMOMETER_C_STD = 0.1


class SensorTemperature(Frozen):
    """At which temperature a dark current was measured (None: not known), and by how much a rise doubles it."""

    temperature_c: float | None = None
    doubling_c: float = DOUBLING_C
    doubling_c_std: float = DOUBLING_C_STD

    @property
    def text(self) -> str:
        """The temperature as it stands behind the name of a dark current."""
        return "at an unknown temperature" if self.temperature_c is None else f"at {self.temperature_c:.1f} °C"

    def doublings(self, reference: SensorTemperature) -> tuple[float, float]:
        """Return by how many doublings a dark current at the reference's temperature is larger than at this one, and
        the standard deviation.

        The doubling temperature is the better known of both. Where a temperature isn't known, the number is 0 and its
        standard deviation that of the temperatures that a laboratory's sensors have.
        """
        law = min(self, reference, key=lambda sensor_law: sensor_law.doubling_c_std)
        if self.temperature_c is None or reference.temperature_c is None:
            unknown = (self.temperature_c is None) + (reference.temperature_c is None)
            return 0.0, math.sqrt(unknown) * UNKNOWN_C_STD / law.doubling_c
        rise_c = reference.temperature_c - self.temperature_c
        of_law = rise_c * law.doubling_c_std / law.doubling_c**2
        return rise_c / law.doubling_c, math.hypot(of_law, math.sqrt(2.0) * THERMOMETER_C_STD / law.doubling_c)


def temperature_law(rates: Sequence[tuple[float, float, float]], gain_error: float = 0.0) -> DarkCurrentLaws:
    """Fit the Arrhenius law and the doubling temperature of EMVA 1288 to dark currents.

        ln I = ln I_ref - E / k (1/T - 1/T_ref),    ln I = a + ln 2 (T - T_ref) / T_d

    Weighted lines, T_ref the coldest temperature.

    rates : (temperature in deg C, dark current in e/s, its standard deviation) of each measurement; only currents above
        three standard deviations are used, at two temperatures or more
    gain_error : relative error of the gain, common to all

    Returns the measurements alone where fewer than two temperatures have a significant current.

    >>> law = temperature_law([(20.0, 10.0, 0.1), (27.0, 20.0, 0.1), (34.0, 40.0, 0.1)])
    >>> round(law.doubling_temperature_c, 2)
    7.0
    """
    listed = np.array(rates, float)
    plain = DarkCurrentLaws(
        temperature_c=tuple(listed[:, 0]),
        dark_current_e_per_s=tuple(listed[:, 1]),
        dark_current_e_per_s_std=tuple(float(std) for std in np.hypot(listed[:, 2], gain_error * listed[:, 1])),
    )
    temperature, current, std = listed[listed[:, 1] > 3.0 * listed[:, 2]].T
    if np.unique(temperature).size < 2:
        return plain
    reference = float(temperature.min())
    inverse = 1.0 / (temperature + ZERO_C_K) - 1.0 / (reference + ZERO_C_K)
    fits = []
    for axis in (-inverse / BOLTZMANN_EV_PER_K, np.log(2.0) * (temperature - reference)):
        basis = np.stack([np.ones_like(axis), axis], axis=1)
        solution, covariance, chi2 = least_squares(basis, np.log(current), std / current)
        covariance *= chi2_factor(chi2, temperature.size - 2)
        fits.append((solution, covariance))
    (arrhenius, arrhenius_covariance), (doubling, doubling_covariance) = fits
    at_reference = float(np.exp(arrhenius[0]))
    update: dict[str, float] = {
        "activation_energy_ev": float(arrhenius[1]),
        "activation_energy_ev_std": float(np.sqrt(arrhenius_covariance[1, 1])),
        "reference_temperature_c": reference,
        "reference_current_e_per_s": at_reference,
        "reference_current_e_per_s_std": at_reference
        * float(np.hypot(np.sqrt(arrhenius_covariance[0, 0]), gain_error)),
    }
    if doubling[1] > 3.0 * np.sqrt(doubling_covariance[1, 1]):
        update["doubling_temperature_c"] = 1.0 / float(doubling[1])
        update["doubling_temperature_c_std"] = float(np.sqrt(doubling_covariance[1, 1]) / doubling[1] ** 2)
    return plain.model_copy(update=update)


# Read noise and black level from the darks, and whether rounding hides them.


def read_noise(evaluation: Evaluation) -> tuple[float | None, float | None]:
    """Read noise, e, and its standard deviation: sqrt(floor - s^2 / 12) / K with the step s of the codes, the floor a
    weighted mean over the planes. The floor is the darks' variance less the shot noise of their mean above black, so
    that an error of the black level is one of K times it.

    None where darks have no repeats, or where rounding hides the noise.
    """
    t = evaluation.transfer
    if not any(level.lamp == "dark" for level, _ in evaluation.points):
        if any(level.repeats > 1 for level in evaluation.levels.darks):
            evaluation.remarks.add(
                "repeated dark frames are all alike: rounding hides the read noise, which is below "
                f"{0.4 * evaluation.levels.step_dn / t.gain:.2f} e"
            )
        return None, None
    count = t.floor.size
    floor_covariance = t.covariance[2:, 2:]
    weight = 1.0 / np.diag(floor_covariance)
    weight /= weight.sum()
    floor = float(weight @ t.floor)
    if floor < evaluation.levels.hidden_dn2:
        evaluation.remarks.add(
            f"the temporal noise of dark frames is {np.sqrt(max(floor, 0)):.2f} DN, where rounding hides it: the read "
            "noise is below "
            f"{0.4 * evaluation.levels.step_dn / t.gain:.2f} e; a higher gain would show it"
        )
        return None, None
    between = float(np.sum((t.floor - floor) ** 2 / np.diag(floor_covariance)))
    gradient = np.zeros(2 + count)
    noise = float(np.sqrt(floor - evaluation.levels.quantisation_dn2))
    gradient[0] = -noise / t.gain**2
    gradient[2:] = weight / (2.0 * noise * t.gain)
    widened = t.covariance.copy()
    widened[2:, 2:] *= chi2_factor(between, count - 1)
    black = 0.5 * float(np.sqrt(evaluation.dark.lines[None].covariance[0, 0])) / noise
    return noise / t.gain, float(np.hypot(np.sqrt(gradient @ widened @ gradient), black))


def black_level(evaluation: Evaluation) -> tuple[float | None, float | None]:
    """Return the black level, DN, and its standard deviation: the dark line at no exposure. The standard deviation
    includes the fixed pattern as a sample of the camera.
    """
    if not evaluation.levels.darks:
        return None, None
    line, patterns = evaluation.dark.lines[None], []
    for name in evaluation.levels.names:
        plane = evaluation.levels.darks[0].plane[name]
        if plane.every_pixel is not None and np.isfinite(plane.temporal_variance):  # one frame can't tell it from noise
            patterns.append(plane.every_pixel.mean_std(plane.shape))
    pattern = float(np.sqrt(np.sum(np.square(patterns)))) / max(len(patterns), 1)
    return line.black, float(np.hypot(np.sqrt(line.covariance[0, 0]), pattern))


def dark_signal_hidden(evaluation: Evaluation) -> bool:
    """Return whether rounding hides the dark signal; reported where it does.

    Where neither noise nor pattern spreads the values over codes, their means don't follow the signal.
    """
    spread = min(level.plane[name].spread for level in evaluation.levels.darks for name in evaluation.levels.names)
    if spread >= evaluation.levels.hidden_dn2:
        return False
    evaluation.remarks.add(
        f"noise and pattern of the darks spread over {np.sqrt(spread):.2f} DN only, so rounding decides their means: "
        "dark current "
        "and DSNU aren't determined, and the black level to its rounding; a higher gain would show them"
    )
    return True


# Dark current: from the dark means, from the dark variances, and against temperature.


def dark_current(evaluation: Evaluation) -> tuple[float | None, float | None]:
    """Return the dark current, e/s, and its standard deviation: slope of the dark mean against exposure over K."""
    if not evaluation.levels.darks:
        return None, None
    line = evaluation.dark.lines[None]
    if line.rate is None:
        evaluation.remarks.add(
            "all darks have one exposure: the dark current isn't determined; capture darks of a longer one"
        )
        return None, None
    if dark_signal_hidden(evaluation):
        return None, None
    return in_electrons(evaluation, line.rate, float(np.sqrt(line.covariance[1, 1])))


def dark_current_from_variance(evaluation: Evaluation) -> tuple[float | None, float | None]:
    """Return the dark current, e/s, and its standard deviation: slope of the dark variance against exposure over K^2,
    all planes together.

    K is that of the flats: the photon transfer of the darks themselves contains the same slope.
    """
    repeated = [level for level in evaluation.levels.darks if level.repeats > 1]
    exposure = np.array([level.exposure_s for level in repeated])
    if np.unique(exposure).size < 3 or dark_signal_hidden(evaluation):
        return None, None
    rates, weights = [], []
    for name in evaluation.levels.names:
        planes = [level.plane[name] for level in repeated]
        variance = np.array([plane.temporal_variance for plane in planes])
        std = np.array([plane.temporal_variance_std for plane in planes])
        # a charge that drifts changes the shot noise by the gain times its change
        std = np.hypot(std, evaluation.transfer.gain * np.array([level.drift_std_dn for level in repeated]))
        if variance.min() < evaluation.levels.hidden_dn2:
            return None, None
        line = dark_line(exposure, variance, std)
        if line.rate is not None:
            rates.append(line.rate)
            weights.append(1.0 / line.covariance[1, 1])
    try:
        flats = transfer_of(
            evaluation.levels,
            evaluation.dark,
            evaluation.saturation,
            [level for level in repeated if level.exposure_s == exposure.min()],
            evaluation.consistency.series,
        )[0]
    except NotDetermined:
        return None, None
    rate = float(np.average(rates, weights=weights))
    relative = 2.0 * flats.gain_std / flats.gain
    std_of_rate = float(np.hypot(np.sum(weights) ** -0.5, rate * relative))
    return rate / flats.gain**2, std_of_rate / flats.gain**2


def dark_temperature_c(evaluation: Evaluation) -> float | None:
    """Return the sensor temperature (deg C) at which the dark currents were measured; None where the darks don't state
    it.

    It is the mean over the darks, weighted by exposure: a dark moves the slope of signal against exposure the more, the
    longer it is."""
    darks = [
        (level.exposure_s, level.temperature_c if level.sensor_c is None else level.sensor_c)
        for level in evaluation.levels.darks
    ]
    known = [(exposure_s, sensor_c) for exposure_s, sensor_c in darks if sensor_c is not None]
    total_s = sum(exposure_s for exposure_s, _ in known)
    return sum(exposure_s * sensor_c for exposure_s, sensor_c in known) / total_s if total_s > 0 else None


def remark_on_temperatures(evaluation: Evaluation) -> None:
    """Remark on flats that were taken at another temperature than the darks that are subtracted: more than a degree
    apart, to which levels are grouped, and where a dark current that is significant (three standard deviations) would
    change a mean by more than three of its own, the scatter of the light included."""
    dark_c = dark_temperature_c(evaluation)
    if dark_c is None:
        return
    changes: list[tuple[float, float, float]] = []
    for level in evaluation.levels.flats:
        rise_c = 0.0 if level.temperature_c is None else level.temperature_c - dark_c
        for name, plane in level.plane.items():
            line = evaluation.dark.lines[name]
            if abs(rise_c) <= 1.0 or line.rate is None or line.rate < 3.0 * math.sqrt(line.covariance[1, 1]):
                continue
            signal_dn = plane.mean - line.black
            std_dn = math.hypot(
                0.0 if math.isnan(plane.mean_std) else plane.mean_std, evaluation.light_scatter * signal_dn
            )
            change_dn = line.rate * level.exposure_s * (2.0 ** (rise_c / DOUBLING_C) - 1.0)
            if abs(change_dn) > 3.0 * std_dn and signal_dn > 0.0:
                changes.append((abs(change_dn) / signal_dn, change_dn, dark_c + rise_c))
    if changes:
        share, change_dn, flat_c = max(changes)
        evaluation.remarks.add(
            f"flats at {flat_c:.1f} °C have darks at {dark_c:.1f} °C subtracted: their own dark signal differs by "
            f"{change_dn:+.2g} DN, {100.0 * share:.2g} % of the signal, if it doubles every {DOUBLING_C:g} °C; "
            "take darks at the temperature of the flats"
        )


def dark_current_temperature(evaluation: Evaluation) -> DarkCurrentLaws | None:
    """Return the dark current at every temperature with darks of two exposures, and the laws through those
    significantly above 0.
    """
    rates: list[tuple[float, float, float]] = []
    temperatures = {level.temperature_c for level in evaluation.levels.all_darks if level.temperature_c is not None}
    for temperature in sorted(temperatures):
        darks = [level for level in evaluation.levels.all_darks if level.temperature_c == temperature]
        line = dark_line(np.array([level.exposure_s for level in darks]), *mean_and_std(darks, evaluation.levels.names))
        if line.rate is not None:
            std = float(np.sqrt(line.covariance[1, 1]))
            rates.append((temperature, line.rate / evaluation.transfer.gain, std / evaluation.transfer.gain))
    if not rates:
        return None
    laws = temperature_law(rates, evaluation.transfer.gain_std / evaluation.transfer.gain)
    columns = (laws.temperature_c, laws.dark_current_e_per_s, laws.dark_current_e_per_s_std)
    for temperature, current, std in zip(*columns, strict=True):
        own_value = ", the value given" if temperature == evaluation.levels.temperature_c else ""
        evaluation.remarks.add(f"the dark current at {temperature:g} deg C is {current:.4g} ± {std:.2g} e/s{own_value}")
    return laws
