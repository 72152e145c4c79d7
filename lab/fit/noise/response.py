"""The response to light: linearity, full well, quantum efficiency, drift of the lamp between levels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lab.fit.noise.evaluation import Evaluation, in_electrons
from lab.fit.noise.level_statistics import MeasuredLevel
from lab.fit.noise.photon_transfer import LINE_LIMIT
from lab.fit.rounding import QUANTISATION_DN2
from lab.fit.weighted_lines import Linearity, linearity
from sim.spectrum import FloatArray

LINEARITY_RANGE = (0.05, 0.95)  # of saturation: range of the linearity line of EMVA 1288


def linearity_by_plane(e: Evaluation) -> tuple[dict[str, Linearity], dict[tuple[int, str], float]]:
    """Linearity by plane, and the deviation, %, of every (id of level, plane) that has one."""
    found: dict[str, Linearity] = {}
    deviation: dict[tuple[int, str], float] = {}
    for name in e.levels.names:
        chosen = levels_in_range(e, name, *LINEARITY_RANGE)
        if len({level.light for level in chosen}) < 4:
            continue
        found[name] = _line(e, name, chosen)
        for level, percent in zip(chosen, found[name].deviation_percent, strict=True):
            deviation[id(level), name] = float(percent)
    if not found:
        e.remarks.add(
            "fewer than four levels of one lamp between 5 and 95 % of saturation: the linearity error isn't determined"
        )
    return found, deviation


def linearity_error(e: Evaluation) -> tuple[float | None, float | None]:
    """Mean of the planes' linearity errors, %, and its standard deviation.

    Planes see the same lamp: where it drifts, their errors are fully correlated. So is always what noise adds to a
    modulus.
    """
    errors = list(linearity_by_plane(e)[0].values())
    if not errors:
        return None, None
    independent = 1 if e.light_scatter > 0 else len(errors)
    noise = np.mean([error.error_noise_percent for error in errors]) / np.sqrt(independent)
    bias = np.mean([error.error_bias_percent for error in errors])
    return float(np.mean([error.error_percent for error in errors])), float(np.hypot(noise, bias))


def main_lamp_levels(e: Evaluation) -> list[MeasuredLevel]:
    """Flats of the series of the lamp with most levels."""
    lamps = [level.lamp for level in e.consistency.series]
    lamp = max(dict.fromkeys(lamps), key=lamps.count)
    return [level for level in e.consistency.series if level.lamp == lamp]


def levels_in_range(e: Evaluation, name: str, low: float, high: float) -> list[MeasuredLevel]:
    """Unsaturated flats of the main lamp with a signal of `low` to `high` of saturation."""
    clipped = dict(zip(map(id, e.levels.flats), e.saturation.clipped[name], strict=True))
    return [
        level
        for level in main_lamp_levels(e)
        if not clipped[id(level)]
        and low
        <= (level.plane[name].mean - e.dark.lines[name].at(level.exposure_s)) / e.saturation.signal_dn[name]
        <= high
    ]


def response_to_light(
    e: Evaluation, name: str, levels: Sequence[MeasuredLevel]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Light, signal (DN above dark) and its standard deviation, (levels,) each: by noise, and by what the levels
    scatter beyond it; that of the darks isn't in it.
    """
    signal = np.array([level.plane[name].mean - e.dark.mean_dn(name, level.exposure_s) for level in levels])
    noise = np.array([level.plane[name].mean_std for level in levels])
    shot = e.transfer.gain * np.maximum(signal, 0.0) + QUANTISATION_DN2
    noise = np.where(np.isfinite(noise), noise, np.sqrt(shot / levels[0].plane[name].pixels))
    beyond = np.maximum(e.light_scatter, [level.light_std for level in levels])
    return np.array([level.light for level in levels]), signal, np.hypot(noise, beyond * signal)


def _line(e: Evaluation, name: str, levels: Sequence[MeasuredLevel]) -> Linearity:
    light, signal, std = response_to_light(e, name, levels)
    of_darks = e.dark.mean_covariance_dn2(name, [level.exposure_s for level in levels])
    return linearity(light, signal, np.diag(std**2) + of_darks)


def full_well(e: Evaluation) -> tuple[float | None, float | None]:
    """Saturation, e, and its standard deviation; None where no flat saturates."""
    seen = [(value, name) for name, value in e.saturation.seen_dn.items() if value is not None]
    if not seen:
        highest = max(
            level.plane[name].mean - e.dark.lines[name].black for level in e.levels.flats for name in e.levels.names
        ) / (e.levels.white_dn - e.dark.lines[None].black)
        e.remarks.add(
            f"no flat saturates (the brightest reaches {100 * highest:.0f} % of the range): the full well isn't determined; expose longer"
        )
        return None, None
    value, name = max(seen)
    limit = e.levels.white_dn - e.dark.lines[name].black
    if value >= limit - 0.5:
        e.remarks.add(
            f"saturation is the converter's limit ({e.levels.white_dn:g} DN): full_well_e is the signal there, and the pixel may hold more"
        )
    # The saturated value is rounded to whole DN
    return in_electrons(e, value, np.sqrt(QUANTISATION_DN2))


def quantum_efficiency(e: Evaluation) -> dict[str, float | None]:
    """Quantum efficiency of a MONO camera, its standard deviations and wavelength (nm), by EMVA 1288: responsivity over
    K.

    The responsivity is the slope of the signal against photons, to 70 % of saturation. Empty without a number of
    photons.
    """
    levels = main_lamp_levels(e)
    lamp = levels[0].lamp
    if e.levels.camera.cfa != "MONO" or not (isinstance(lamp, tuple) and lamp[1]):
        return {}
    chosen = levels_in_range(e, "Y", 0.0, LINE_LIMIT)
    chosen = [level for level in chosen if level.light > 0]
    if len({level.light for level in chosen}) < 3:
        return {}
    line = _line(e, "Y", chosen)
    value, std = in_electrons(e, line.slope, line.slope_std)
    calibration = max(level.light_calibration_std for level in chosen)
    return {
        "quantum_efficiency": value,
        "quantum_efficiency_std": std,
        "quantum_efficiency_systematic_std": calibration * value if calibration and value is not None else None,
        "quantum_efficiency_wavelength_nm": lamp[2],
    }


def remark_on_scatter(e: Evaluation) -> None:
    """Report means that differ beyond noise: between the repeats of a level, or else about a smooth response.

    Repeats have the same stated light and the same response: what is left is the light itself, or a dark level that
    moves, which the darks show. Levels differ in all of these, so that no cause is named.
    """
    drift, scatter = e.drift, e.consistency.scatter
    if drift.relative > 0:
        cause = (
            "the dark level moved"
            if e.dark_drift_dn > 0.5 * drift.std_dn
            else "the lamp drifted, or the time of exposure varied"
        )
        e.remarks.add(
            f"{cause}: the means of repeated flat frames differ by {drift.std_dn:.2g} DN (rms) where noise explains "
            f"{drift.noise_dn:.2g} DN ({100 * drift.relative:.2g} % of the signal)"
        )
    if scatter > 1.5 * drift.relative:
        e.remarks.add(
            f"the means of the levels scatter by {100 * scatter:.2g} % of the signal about a smooth response, where noise explains "
            f"{100 * e.consistency.noise:.1g} %: it is in the uncertainties; a light that varies, exposures or photon numbers that are "
            "stated wrong and a response with steps all do that"
        )
