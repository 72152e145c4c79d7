"""What bends the photon-transfer curve: the response, or missing noise (brighter-fatter)."""

from __future__ import annotations

import numpy as np

from lab.fit.noise.evaluation import Evaluation
from lab.fit.noise.photon_transfer import CURVE_LIMIT
from lab.fit.noise.response import levels_in_range, response_to_light
from lab.fit.weighted_lines import chi2_factor, least_squares
from sim.spectrum import FloatArray

LARGEST_MISFIT = 1.0  # of what a bend brings: a law that leaves more than that doesn't describe the means
LARGEST_SCATTER = 0.05  # of the signal: beyond it, errors of the stated light make a bend where there is none
LARGEST_BEND_STD = 0.5  # of saturation: a bend that is less certain says nothing
#: Planes that the pixels of a plane adjoin along rows and columns.
ADJACENT = {"Y": ("Y",), "R": ("G1", "G2"), "B": ("G1", "G2"), "G1": ("R", "B"), "G2": ("R", "B")}


def variance_curvature_figures(e: Evaluation) -> dict[str, float]:
    """Percent at saturation, with standard deviations: curvature of the response, of the variance, what the variance
    lacks beyond three times that of the response, and the covariance of neighbours. Reports what bends the variance.
    Empty where no level is near saturation (`LEAST_REACH`).
    """
    t = e.transfer
    if not e.reaches_saturation:
        return {}
    found = {
        "variance_bend_percent": 100.0 * t.relative_curvature,
        "variance_bend_percent_std": 100.0 * t.relative_curvature_std,
    }
    shared = neighbour_covariance(e)
    if shared is not None:
        found["neighbour_covariance_percent"] = 100.0 * shared[0]
        found["neighbour_covariance_percent_std"] = 100.0 * shared[1]
    response = response_curvature(e)
    if response is None:
        return found
    found["response_bend_percent"], found["response_bend_percent_std"] = 100.0 * response[0], 100.0 * response[1]
    # v = K (dy/de)^2 e: a response of curvature b at saturation gives the variance a curvature of 3 b
    missing = 3.0 * response[0] - t.relative_curvature
    missing_std = float(np.hypot(3.0 * response[1], t.relative_curvature_std))
    if missing_std > LARGEST_BEND_STD:
        return found
    found["brighter_fatter_percent"], found["brighter_fatter_percent_std"] = 100.0 * missing, 100.0 * missing_std
    causes = []
    if abs(response[0]) > 4.0 * response[1] and abs(3.0 * response[0]) > 2.0 * missing_std:
        causes.append(f"a response that bends by {100 * response[0]:+.2g} +- {100 * response[1]:.1g} %")
    if missing > 4.0 * missing_std:
        seen = shared is not None and shared[0] > 4.0 * shared[1]
        where = (
            "and it is seen in the neighbours' covariances" if seen else "which the neighbours' covariances don't show"
        )
        causes.append(
            f"{100 * missing:.2g} +- {100 * missing_std:.1g} % of the noise that is missing beyond that (brighter-fatter, {where})"
        )
    if causes and abs(t.relative_curvature) > 2.0 * t.relative_curvature_std:
        e.remarks.add(f"at saturation, the variance bends by {' and '.join(causes)}")
    return found


def response_curvature(e: Evaluation) -> tuple[float, float] | None:
    """Departure of the response from its slope at zero, relative, at saturation: from means against light, all planes
    together.

    x = o + S l + q l^2, with an offset for light that the clock of the exposure doesn't count; the result is q x_sat /
    S^2. None, and a remark, where the means don't follow this law.
    """
    if e.consistency.scatter > LARGEST_SCATTER:
        e.remarks.add(
            f"the levels scatter by {100.0 * e.consistency.scatter:.2g} % of the signal about every smooth response: the curvature of the "
            "response isn't given"
        )
        return None
    values, weights, highest = [], [], max(e.saturation.signal_dn.values())
    for name in e.levels.names:
        levels = levels_in_range(e, name, 0.0, CURVE_LIMIT)
        if len({level.light for level in levels}) < 5:
            continue
        light, signal, std = response_to_light(e, name, levels)
        # The response depends on all charge, with that of the dark current: as light, below / slope
        below = np.array([e.dark.mean_dn(name, level.exposure_s) - e.dark.lines[name].black for level in levels])
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
            e.remarks.add(
                f"the means of the levels don't follow a response that bends like a parabola: they depart from it by {rest:.2g} times "
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
        e.remarks.add(
            f"the levels leave the curvature of the response uncertain to {100.0 * mean_std:.2g} % at saturation: it isn't given"
        )
        return None
    return mean, mean_std


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def neighbour_covariance(e: Evaluation) -> tuple[float, float] | None:
    """Temporal covariance of a pixel with its eight neighbours as a share of the variance of its shot noise, at
    saturation.

    4 (adjacent + diagonal) less that of the darks = share K x x_beside / x_sat, x_beside the mean of the planes that
    it adjoins.
    """
    highest, gain = max(e.saturation.signal_dn.values()), e.transfer.gain
    rows: list[tuple[float, float, float]] = []
    dark: dict[str, tuple[float, float]] = {}
    for name in e.levels.names:
        own = [level.plane[name] for level in e.levels.darks if np.isfinite(level.plane[name].covariance_std)]
        if own:
            weight = np.array([1.0 / max(plane.covariance_std, 1e-9) ** 2 for plane in own])
            both = np.array([4.0 * (plane.adjacent_covariance + plane.diagonal_covariance) for plane in own])
            dark[name] = float(np.average(both, weights=weight)), float(np.sqrt(32.0 / weight.sum()))
    for level, name in e.points:
        plane = level.plane[name]
        signal = plane.mean - e.dark.lines[name].black
        if (
            level.lamp == "dark"
            or not np.isfinite(plane.covariance_std)
            or signal > CURVE_LIMIT * e.saturation.signal_dn[name]
        ):
            continue
        adjacent = [level.plane[n].mean - e.dark.lines[n].black for n in ADJACENT[name]]
        number = e.levels.flats.index(level)
        if any(
            e.saturation.clipped[n][number] or value > CURVE_LIMIT * e.saturation.signal_dn[n]
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
    counted = 1.0 if e.levels.camera.cfa == "MONO" else 2.0
    return product, float(np.sqrt(counted * chi2_factor(chi2, freedom) / norm))
