"""The light of flats, by what is stated of it: a measured radiance, or a number of photons."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lab.capture_kinds.flat import FlatCapture
from lab.fit.noise.stated_light import stated_light
from lab.formats.results import CameraFit, InconsistentLevel
from sim.spectrum import Spectrum
from sim.uniform import electron_rate

if TYPE_CHECKING:
    from lab.diagnose.measurements.study import Study


@dataclass(frozen=True)
class FlatLight:
    """One statement of the light: of a radiometer (`path` of the spectrum), or of a number of photons in an exposure."""

    name: str
    lamp: Hashable
    path: str | None = None
    photons_per_s: float = 0.0


def reading(study: Study, flat: FlatCapture) -> FlatLight | None:
    """What is stated of a flat's light; None where nothing is, or where no time was exposed."""
    if flat.radiance is not None:
        return FlatLight(flat.radiance, study.lamps[flat.radiance], flat.radiance)
    light = stated_light(flat)
    if light.unit != "photons" or flat.exposure_s <= 0 or light.amount <= 0:
        return None
    name = f"{light.amount:.9g} photons in {flat.exposure_s:.9g} s"
    return FlatLight(name, light.lamp, None, light.amount / flat.exposure_s)


def relative_rates(study: Study, readings: Sequence[FlatLight]) -> Mapping[tuple[str, str], float]:
    """Rate of light in each channel by (reading, channel), over that of the first reading of its lamp."""
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
    """Levels whose number of photons contradicts the others, as the noise fit finds them (`lab.fit.noise.level_consistency`)."""
    if fit is None or fit.noise is None:
        return ()
    return tuple(level for level in fit.noise.inconsistent_levels if level.light_unit == "photons" and level.captures)
