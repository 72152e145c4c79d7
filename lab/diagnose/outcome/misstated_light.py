"""Flat levels whose stated light contradicts the others, which the noise fit left out, reported as misstated
metadata."""

from __future__ import annotations

from lab.diagnose.measurements.flat_light import misstated_levels
from lab.diagnose.measurements.linearity import PHOTON_TRANSFER, RADIOMETER_STD
from lab.formats.results import CameraFit, InconsistentLevel, Unexplained
from sim.camera import Side


def misstated_light(side: Side, fit: CameraFit | None, *, levels_are_judged: bool) -> tuple[Unexplained, ...]:
    """One item for each level that the noise fit finds: of a number of photons, and of an exposure where no measurement
    of levels judges it (`levels_are_judged`). Its significance is against the tolerance of a reading of the light."""
    exposures = () if levels_are_judged or fit is None or fit.noise is None else fit.noise.inconsistent_levels
    wrong = (*misstated_levels(fit), *(one for one in exposures if one.light_unit == "s" and one.captures))
    return tuple(_told(side, level) for level in wrong)


def _told(side: Side, level: InconsistentLevel) -> Unexplained:
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
