"""Response and variance against the light: linearity, full well, quantum efficiency, and what bends the variance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lab.fit.noise.evaluation import Evaluation, in_electrons
from lab.fit.noise.transfer import CURVE_LIMIT, LINE_LIMIT
from lab.observables.noise.levels import MeasuredLevel
from lab.observables.weighted_lines import Linearity, chi2_factor, least_squares, linearity
from sim.spectrum import FloatArray

# The response to light: linearity, full well, quantum efficiency, drift of the lamp between levels.


LINEARITY_RANGE = (0.05, 0.95)  # of saturation: range of the linearity line of EMVA 1288


def linearity_by_plane(evaluation: Evaluation) -> tuple[dict[str, Linearity], dict[tuple[int, str], float]]:
    """Return the linearity by plane, and the deviation, %, of every (id of level, plane) that has one."""
    lines: dict[str, Linearity] = {}
    deviation: dict[tuple[int, str], float] = {}
    for name in evaluation.levels.names:
        chosen = levels_in_range(evaluation, name, *LINEARITY_RANGE)
        if len({level.light for level in chosen}) < 4:
            continue
        lines[name] = _line(evaluation, name, chosen)
        for level, percent in zip(chosen, lines[name].deviation_percent, strict=True):
            deviation[id(level), name] = float(percent)
    if not lines:
        evaluation.remarks.add(
            "fewer than four levels of one lamp between 5 and 95 % of saturation: the linearity error isn't determined"
        )
    return lines, deviation


def linearity_error(evaluation: Evaluation) -> tuple[float | None, float | None]:
    """Return the mean of the planes' linearity errors, %, and its standard deviation.

    Planes see the same lamp: where it drifts, their errors are fully correlated. So is always what noise adds to a
    modulus.
    """
    errors = list(linearity_by_plane(evaluation)[0].values())
    if not errors:
        return None, None
    independent = 1 if evaluation.light_scatter > 0 else len(errors)
    noise = np.mean([error.error_noise_percent for error in errors]) / np.sqrt(independent)
    bias = np.mean([error.error_bias_percent for error in errors])
    return float(np.mean([error.error_percent for error in errors])), float(np.hypot(noise, bias))


def main_lamp_levels(evaluation: Evaluation) -> list[MeasuredLevel]:
    """Return the flats of the series of the lamp with most levels."""
    lamps = [level.lamp for level in evaluation.consistency.series]
    lamp = max(dict.fromkeys(lamps), key=lamps.count)
    return [level for level in evaluation.consistency.series if level.lamp == lamp]


def levels_in_range(evaluation: Evaluation, name: str, low: float, high: float) -> list[MeasuredLevel]:
    """Return the unsaturated flats of the main lamp with a signal of `low` to `high` of saturation."""
    clipped = dict(zip(map(id, evaluation.levels.flats), evaluation.saturation.clipped[name], strict=True))
    return [
        level
        for level in main_lamp_levels(evaluation)
        if not clipped[id(level)]
        and low
        <= (level.plane[name].mean - evaluation.dark.lines[name].at(level.exposure_s))
        / evaluation.saturation.signal_dn[name]
        <= high
    ]


def response_to_light(
    evaluation: Evaluation, name: str, levels: Sequence[MeasuredLevel]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the light, signal (DN above dark) and its standard deviation, (levels,) each: by noise, and by what the
    levels scatter beyond it; that of the darks isn't in it.
    """
    signal = np.array([level.plane[name].mean - evaluation.dark.mean_dn(name, level.exposure_s) for level in levels])
    noise = np.array([level.plane[name].mean_std for level in levels])
    shot = evaluation.transfer.gain * np.maximum(signal, 0.0) + evaluation.levels.quantisation_dn2
    noise = np.where(np.isfinite(noise), noise, np.sqrt(shot / levels[0].plane[name].pixels))
    beyond = np.maximum(evaluation.light_scatter, [level.light_std for level in levels])
    return np.array([level.light for level in levels]), signal, np.hypot(noise, beyond * signal)


def _line(evaluation: Evaluation, name: str, levels: Sequence[MeasuredLevel]) -> Linearity:
    light, signal, std = response_to_light(evaluation, name, levels)
    of_darks = evaluation.dark.mean_covariance_dn2(name, [level.exposure_s for level in levels])
    return linearity(light, signal, np.diag(std**2) + of_darks)


def full_well(evaluation: Evaluation) -> tuple[float | None, float | None]:
    """Return the saturation, e, and its standard deviation; None where no flat saturates."""
    seen = [(value, name) for name, value in evaluation.saturation.seen_dn.items() if value is not None]
    if not seen:
        highest = max(
            level.plane[name].mean - evaluation.dark.lines[name].black
            for level in evaluation.levels.flats
            for name in evaluation.levels.names
        ) / (evaluation.levels.white_dn - evaluation.dark.lines[None].black)
        evaluation.remarks.add(
            f"no flat saturates (the brightest reaches {100 * highest:.0f} % of the range): the full well isn't "
            "determined; expose longer"
        )
        return None, None
    value, name = max(seen)
    limit = evaluation.levels.white_dn - evaluation.dark.lines[name].black
    if value >= limit - 0.5 * evaluation.levels.step_dn:
        evaluation.remarks.add(
            f"saturation is the converter's limit ({evaluation.levels.white_dn:g} DN): full_well_e is the signal "
            "there, and the pixel may hold more"
        )
    # The saturated value is rounded to the step of the codes
    return in_electrons(evaluation, value, np.sqrt(evaluation.levels.quantisation_dn2))


def quantum_efficiency(evaluation: Evaluation) -> dict[str, float | None]:
    """Return the quantum efficiency of a MONO camera, its standard deviations and wavelength (nm), by EMVA 1288:
    responsivity over K.

    The responsivity is the slope of the signal against photons, to 70 % of saturation. Empty without a number of
    photons.
    """
    levels = main_lamp_levels(evaluation)
    lamp = levels[0].lamp
    if evaluation.levels.camera.cfa != "MONO" or not (isinstance(lamp, tuple) and lamp[1]):
        return {}
    chosen = levels_in_range(evaluation, "Y", 0.0, LINE_LIMIT)
    chosen = [level for level in chosen if level.light > 0]
    if len({level.light for level in chosen}) < 3:
        return {}
    line = _line(evaluation, "Y", chosen)
    value, std = in_electrons(evaluation, line.slope, line.slope_std)
    calibration = max(level.light_calibration_std for level in chosen)
    return {
        "quantum_efficiency": value,
        "quantum_efficiency_std": std,
        "quantum_efficiency_systematic_std": calibration * value if calibration and value is not None else None,
        "quantum_efficiency_wavelength_nm": lamp[2],
    }


def remark_on_scatter(evaluation: Evaluation) -> None:
    """Report means that differ beyond noise: between the repeats of a level, or else about a smooth response; and
    those of repeated darks, where they differ by more than the noise of a pixel.

    Repeats have the same stated light and the same response: what is left is the light itself, or a dark level that
    moves, which the darks show. Levels differ in all of these, so that no cause is named.
    """
    drift, scatter = evaluation.drift, evaluation.consistency.scatter
    dark_dn = evaluation.dark_scatter_dn([level for level in evaluation.levels.darks if level.drift is None])
    pixel_dn = float(np.sqrt(max(float(np.mean(evaluation.transfer.floor)), evaluation.levels.quantisation_dn2)))
    if dark_dn > pixel_dn:
        evaluation.remarks.add(
            f"the means of repeated dark frames differ by {dark_dn:.2g} DN (rms), more than the noise of one pixel, "
            f"{pixel_dn:.2g} DN: frames may be of another exposure or temperature, or the dark level moved; it is in "
            "the uncertainties of black level, read noise and dark current"
        )
    if drift.relative > 0:
        cause = (
            "the dark level moved"
            if evaluation.dark_drift_dn > 0.5 * drift.std_dn
            else "the lamp drifted, or the time of exposure varied"
        )
        evaluation.remarks.add(
            f"{cause}: the means of repeated flat frames differ by {drift.std_dn:.2g} DN (rms) where noise explains "
            f"{drift.noise_dn:.2g} DN ({100 * drift.relative:.2g} % of the signal)"
        )
    if scatter > 1.5 * drift.relative:
        evaluation.remarks.add(
            f"the means of the levels scatter by {100 * scatter:.2g} % of the signal about a smooth response, where "
            "noise explains "
            f"{100 * evaluation.consistency.noise:.1g} %: it is in the uncertainties; a light that varies, "
            "exposures or photon numbers that are stated wrong and a response with steps all do that"
        )


# What bends the photon-transfer curve: the response, or missing noise (brighter-fatter).


LARGEST_MISFIT = 1.0  # of what a bend brings: a law that leaves more than that doesn't describe the means
LARGEST_SCATTER = 0.05  # of the signal: beyond it, errors of the stated light make a bend where there is none
LARGEST_BEND_STD = 0.5  # of saturation: a bend that is less certain says nothing
#: Planes that the pixels of a plane adjoin along rows and columns.
ADJACENT = {"Y": ("Y",), "R": ("G1", "G2"), "B": ("G1", "G2"), "G1": ("R", "B"), "G2": ("R", "B")}


def variance_curvature_figures(evaluation: Evaluation) -> dict[str, float]:
    """Return, in per cent at saturation with standard deviations, the curvature of the response, of the variance, what
    the variance lacks beyond three times that of the response, and the covariance of neighbours. Reports what bends the
    variance. Empty where no level is near saturation (`LEAST_REACH`).
    """
    t = evaluation.transfer
    if not evaluation.reaches_saturation:
        return {}
    figures = {
        "variance_bend_percent": 100.0 * t.relative_curvature,
        "variance_bend_percent_std": 100.0 * t.relative_curvature_std,
    }
    shared = neighbour_covariance(evaluation)
    if shared is not None:
        figures["neighbour_covariance_percent"] = 100.0 * shared[0]
        figures["neighbour_covariance_percent_std"] = 100.0 * shared[1]
    response = response_curvature(evaluation)
    if response is None:
        return figures
    figures["response_bend_percent"], figures["response_bend_percent_std"] = 100.0 * response[0], 100.0 * response[1]
    # v = K (dy/de)^2 e: a response of curvature b at saturation gives the variance a curvature of 3 b
    missing = 3.0 * response[0] - t.relative_curvature
    missing_std = float(np.hypot(3.0 * response[1], t.relative_curvature_std))
    if missing_std > LARGEST_BEND_STD:
        return figures
    figures["brighter_fatter_percent"], figures["brighter_fatter_percent_std"] = 100.0 * missing, 100.0 * missing_std
    causes = []
    if abs(response[0]) > 4.0 * response[1] and abs(3.0 * response[0]) > 2.0 * missing_std:
        causes.append(f"a response that bends by {100 * response[0]:+.2g} +- {100 * response[1]:.1g} %")
    if missing > 4.0 * missing_std:
        seen = shared is not None and shared[0] > 4.0 * shared[1]
        where = (
            "and it is seen in the neighbours' covariances" if seen else "which the neighbours' covariances don't show"
        )
        causes.append(
            f"{100 * missing:.2g} +- {100 * missing_std:.1g} % of the noise that is missing beyond that "
            f"(brighter-fatter, {where})"
        )
    if causes and abs(t.relative_curvature) > 2.0 * t.relative_curvature_std:
        evaluation.remarks.add(f"at saturation, the variance bends by {' and '.join(causes)}")
    return figures


def response_curvature(evaluation: Evaluation) -> tuple[float, float] | None:
    """Return the departure of the response from its slope at zero, relative, at saturation: from means against light,
    all planes together.

    x = o + S l + q l^2, with an offset for light that the clock of the exposure doesn't count; the result is q x_sat /
    S^2. None, and a remark, where the means don't follow this law.
    """
    if evaluation.consistency.scatter > LARGEST_SCATTER:
        evaluation.remarks.add(
            f"the levels scatter by {100.0 * evaluation.consistency.scatter:.2g} % of the signal about every smooth "
            "response: the curvature of the response isn't given"
        )
        return None
    values, weights, highest = [], [], max(evaluation.saturation.signal_dn.values())
    for name in evaluation.levels.names:
        levels = levels_in_range(evaluation, name, 0.0, CURVE_LIMIT)
        if len({level.light for level in levels}) < 5:
            continue
        light, signal, std = response_to_light(evaluation, name, levels)
        # The response depends on all charge, with that of the dark current: as light, below / slope
        below = np.array(
            [evaluation.dark.mean_dn(name, level.exposure_s) - evaluation.dark.lines[name].black for level in levels]
        )
        slope = float(np.sum(light * signal) / np.sum(light * light))
        for _ in range(2):
            charge = light + below / slope
            basis = np.stack([np.ones_like(light), charge, charge**2], axis=1)
            solution, covariance, chi2 = least_squares(basis, signal + below, std)
            slope = float(solution[1])
        # Share of the signal's rms that the law leaves, and that which its bend brings beyond a straight line
        rest = _rms((signal + below - basis @ solution) / std)
        straight, _, _ = least_squares(basis[:, :2], basis[:, 2] * solution[2], std)
        brought = _rms((basis[:, 2] * solution[2] - basis[:, :2] @ straight) / std)
        factor = chi2_factor(chi2, len(levels) - 3)
        covariance *= factor
        if factor > 1.0 and rest > LARGEST_MISFIT * brought:
            evaluation.remarks.add(
                "the means of the levels don't follow a response that bends like a parabola: they depart from it by "
                f"{rest:.2g} times "
                f"their noise, its bend brings {brought:.2g} times; no curvature of the response is given"
            )
            return None
        _, slope, square = solution
        gradient = highest * np.array([0.0, -2.0 * square / slope**3, 1.0 / slope**2])
        values.append(float(square * highest / slope**2))
        weights.append(1.0 / float(gradient @ covariance @ gradient))
    if not values:
        return None
    mean = float(np.average(values, weights=weights))
    chi2 = float(np.sum(np.array(weights) * (np.array(values) - mean) ** 2))
    mean_std = float(np.sqrt(chi2_factor(chi2, len(values) - 1) / np.sum(weights)))
    if mean_std > LARGEST_BEND_STD:
        evaluation.remarks.add(
            f"the levels leave the curvature of the response uncertain to {100.0 * mean_std:.2g} % at saturation: it "
            "isn't given"
        )
        return None
    return mean, mean_std


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def neighbour_covariance(evaluation: Evaluation) -> tuple[float, float] | None:
    """Return the temporal covariance of a pixel with its eight neighbours as a share of the variance of its shot noise,
    at saturation.

    4 (adjacent + diagonal) less that of the darks = share K x x_beside / x_sat, x_beside the mean of the planes that
    it adjoins.
    """
    highest, gain = max(evaluation.saturation.signal_dn.values()), evaluation.transfer.gain
    rows: list[tuple[float, float, float]] = []
    dark: dict[str, tuple[float, float]] = {}
    for name in evaluation.levels.names:
        dark_planes = [
            level.plane[name] for level in evaluation.levels.darks if np.isfinite(level.plane[name].covariance_std)
        ]
        if dark_planes:
            weight = np.array([1.0 / max(plane.covariance_std, 1e-9) ** 2 for plane in dark_planes])
            both = np.array([4.0 * (plane.adjacent_covariance + plane.diagonal_covariance) for plane in dark_planes])
            dark[name] = float(np.average(both, weights=weight)), float(np.sqrt(32.0 / weight.sum()))
    for level, name in evaluation.points:
        plane = level.plane[name]
        signal = plane.mean - evaluation.dark.lines[name].black
        if (
            level.lamp == "dark"
            or not np.isfinite(plane.covariance_std)
            or signal > CURVE_LIMIT * evaluation.saturation.signal_dn[name]
        ):
            continue
        adjacent = [level.plane[n].mean - evaluation.dark.lines[n].black for n in ADJACENT[name]]
        number = evaluation.levels.flats.index(level)
        if any(
            evaluation.saturation.clipped[n][number] or value > CURVE_LIMIT * evaluation.saturation.signal_dn[n]
            for n, value in zip(ADJACENT[name], adjacent, strict=True)
        ):
            continue
        beside = float(np.mean(adjacent))
        below, below_std = dark.get(name, (0.0, 0.0))
        value = 4.0 * (plane.adjacent_covariance + plane.diagonal_covariance) - below
        # Noise of the neighbours and of the pixel
        std_of_both = np.sqrt(32.0 * max(beside / max(signal, 1e-9), 0.1)) * plane.covariance_std
        rows.append((gain * signal * beside / highest, value, float(np.hypot(std_of_both, below_std))))
    if len(rows) < 3:
        return None
    x, y, std = np.array(rows).T
    norm = float(np.sum((x / std) ** 2))
    product = float(np.sum(x * y / std**2)) / norm
    chi2, freedom = float(np.sum(((y - product * x) / std) ** 2)), len(rows) - 1
    # In a colour mosaic each pair is counted in both its planes
    counted = 1.0 if evaluation.levels.camera.cfa == "MONO" else 2.0
    return product, float(np.sqrt(counted * chi2_factor(chi2, freedom) / norm))
