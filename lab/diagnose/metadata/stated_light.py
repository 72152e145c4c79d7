"""Stated light that the noise fit contradicts: exposures, numbers of photons, and quantum efficiencies above 1."""

from __future__ import annotations

from lab.formats.results import (
    CameraFit,
    InconsistentLevel,
    Unexplained,
)
from lab.formats.results.plausible import FIGURES
from lab.formats.results.words import format_value
from lab.observables.flats.linearity import PHOTON_TRANSFER, misstated_levels
from lab.observables.spectra.light_readings import RADIOMETER_STD
from sim.camera import Side


def misstated_light(side: Side, fit: CameraFit | None, *, levels_are_judged: bool) -> tuple[Unexplained, ...]:
    """One item for each level that the noise fit finds: of a number of photons, and of an exposure where no measurement
    of levels judges it (`levels_are_judged`). Its significance is against the tolerance of a reading of the light."""
    exposures = () if levels_are_judged or fit is None or fit.noise is None else fit.noise.inconsistent_levels
    wrong = (*misstated_levels(fit), *(one for one in exposures if one.light_unit == "s" and one.captures))
    return tuple(_told_light(side, level) for level in wrong)


def impossible_efficiency(side: Side, fit: CameraFit | None) -> tuple[Unexplained, ...]:
    """Return one item where the stated numbers of photons make more electrons than photons: a quantum efficiency above
    1, of the camera or of its best plane, by more than its uncertainty."""
    noise, limits = (None if fit is None else fit.noise), FIGURES["quantum_efficiency"]
    if noise is None:
        return ()
    every = [(noise.quantum_efficiency, noise.quantum_efficiency_std)]
    every += [(one.quantum_efficiency, one.quantum_efficiency_std) for one in noise.emva1288.values()]
    found = [(value, std) for value, std in every if value is not None and std and limits.is_above(value, std)]
    if not found:
        return ()
    value, std = found[0]
    sigma = (value - 1.0) / std
    return (
        Unexplained(
            side=side,
            measurement=PHOTON_TRANSFER.name,
            axis=PHOTON_TRANSFER.axis,
            where=f"quantum efficiency {format_value(value, std)}",
            shape="the stated numbers of photons are fewer than the electrons",
            significance_sigma=round(sigma, 2),
            chi2_before=sigma**2,
            chi2_after=0.0,
            n=1,
            correction="none: the quantum efficiency isn't used",
            check="Correct the numbers of photons (of one pixel in one exposure), or record single raw frames.",
        ),
    )


def _told_light(side: Side, level: InconsistentLevel) -> Unexplained:
    sigma = abs(level.signal_dn / level.expected_signal_dn - 1.0) / RADIOMETER_STD if level.expected_signal_dn else 0.0
    first, last = level.captures[0], level.captures[-1]
    named = f"Captures {first} .. {last}" if first != last else f"Capture {first}"
    what, unit = ("number of photons", "photons a pixel") if level.light_unit == "photons" else ("exposure", "s")
    return Unexplained(
        side=side,
        measurement=PHOTON_TRANSFER.name,
        axis=PHOTON_TRANSFER.axis,
        where=f"{level.signal_dn:.4g} DN above dark, {len(level.captures)} captures",
        shape=f"the stated {what} contradicts the other levels",
        significance_sigma=round(sigma, 2),
        chi2_before=sigma**2,
        chi2_after=0.0,
        n=1,
        captures=level.captures,
        correction="none: the level is left out",
        check=f"{named}: stated with {level.light:.6g} {unit}, but the others have this level at "
        f"{level.expected_light:.6g} "
        f"{unit.split()[0]}: correct the {what.split()[0]}, or the frames are of another level.",
    )
