"""The stated light of flats: a measured radiance, or a number of photons a pixel."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lab.capture_kinds.flat import FlatCapture
from lab.formats.results import CameraFit, InconsistentLevel
from lab.measure.stated_light import stated_light
from sim.spectrum import Spectrum
from sim.uniform import electron_rate

if TYPE_CHECKING:
    from lab.measure.study import Study


@dataclass(frozen=True)
class FlatLight:
    """One statement of the light: a radiometer's reading, or a number of photons in an exposure."""

    name: str
    lamp: Hashable  # equal for readings of the same lamp
    path: str | None = None  # of the spectrum that the radiometer read
    photons_per_s: float = 0.0  # a pixel, where no spectrum is stated


def reading(study: Study, flat: FlatCapture) -> FlatLight | None:
    """Return the stated light of a flat; None where nothing is stated, or where exposure or photon number is 0."""
    if flat.radiance is not None:
        return FlatLight(flat.radiance, study.lamps[flat.radiance], flat.radiance)
    light = stated_light(flat)
    if light.unit != "photons" or flat.exposure_s <= 0 or light.amount <= 0:
        return None
    name = f"{light.amount:.9g} photons in {flat.exposure_s:.9g} s"
    return FlatLight(name, light.lamp, None, light.amount / flat.exposure_s)


def relative_rates(study: Study, readings: Sequence[FlatLight]) -> Mapping[tuple[str, str], float]:
    """(reading, channel) -> electron rate (photon rate, where photons are stated) over that by the first reading of the
    same lamp."""
    first: dict[Hashable, FlatLight] = {}
    for one in readings:
        first.setdefault(one.lamp, one)
    found = {}
    for channel in study.channels:
        rate = {one.name: _rate(study, one, channel) for one in readings}
        for one in readings:
            found[one.name, channel] = rate[one.name] / max(rate[first[one.lamp].name], 1e-300)
    return found


def _rate(study: Study, one: FlatLight, channel: str) -> float:
    if one.path is None:
        return one.photons_per_s
    spectrum: Spectrum = study.spectrum(one.path)
    return electron_rate(study.camera, channel, spectrum)


def misstated_levels(fit: CameraFit | None) -> tuple[InconsistentLevel, ...]:
    """Levels whose stated number of photons contradicts the others, as found by the noise fit
    (`lab.fit.noise.evaluation`)."""
    if fit is None or fit.noise is None:
        return ()
    return tuple(level for level in fit.noise.inconsistent_levels if level.light_unit == "photons" and level.captures)
