"""Flat levels whose stated number of photons contradicts the others, which the noise fit left out, reported as misstated metadata."""

from __future__ import annotations

from lab.diagnose.measurements.flat_light import misstated_levels
from lab.diagnose.measurements.linearity import PHOTON_TRANSFER, RADIOMETER_STD
from lab.formats.results import CameraFit, InconsistentLevel, Unexplained
from sim.camera import Side


def misstated_light(side: Side, fit: CameraFit | None) -> tuple[Unexplained, ...]:
    """One item for each level that `misstated_levels` finds. Its significance is against the tolerance of a reading of the light."""
    return tuple(_told(side, level) for level in misstated_levels(fit))


def _told(side: Side, level: InconsistentLevel) -> Unexplained:
    sigma = abs(level.signal_dn / level.expected_signal_dn - 1.0) / RADIOMETER_STD if level.expected_signal_dn else 0.0
    first, last = level.captures[0], level.captures[-1]
    named = f"Captures {first} .. {last}" if first != last else f"Capture {first}"
    return Unexplained(
        side=side,
        measurement=PHOTON_TRANSFER.name,
        axis=PHOTON_TRANSFER.axis,
        where=f"{level.signal_dn:.4g} DN above dark, {len(level.captures)} captures",
        shape="the stated number of photons contradicts the other levels",
        significance_sigma=round(sigma, 2),
        chi2_before=sigma**2,
        chi2_after=0.0,
        n=1,
        captures=level.captures,
        correction="none: the level is left out",
        check=f"{named}: stated with {level.light:.6g} photons a pixel, but the others have this level at {level.expected_light:.6g} "
        "photons: correct the number, or the frames are of another level.",
    )
