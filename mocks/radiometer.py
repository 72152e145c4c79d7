"""What the bench's spectroradiometer makes of the light before it: noise, and the errors that a bench may conceal in
it."""

from __future__ import annotations

from collections.abc import Sequence

from mocks.conceal import OF_THE_RADIOMETER
from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.wavelength_offset import WavelengthOffset
from sim.spectrum import Spectrum
from sim.uniform import radiance_at_lens

#: Steps towards the level at which a radiometer that isn't linear reads; each leaves a few per cent of the error before
#: it.
LEVEL_STEPS = 40


def misread(camera: CameraModel, radiance: Spectrum, effects: Sequence[Effect], kind: str) -> Spectrum:
    """Return what a radiometer with `effects` says of `radiance`: the reading from which the forward model gets that
    light.

    A scale that is shifted by d reads the light of w + d at w. One that isn't linear reads the shape at a level s that
    the forward model takes back to 1: s <- s / (peak that it makes of s / true peak).
    """
    for effect in reversed([e for e in effects if e.name in OF_THE_RADIOMETER]):
        if isinstance(effect, WavelengthOffset):
            back = effect.replace_fields(offset_nm=-effect.offset_nm)
            radiance = radiance_at_lens(camera, radiance, [back], kind)
            continue
        wavelength_nm, value = radiance.arrays
        peak, level = float(value.max()), 1.0
        for _ in range(LEVEL_STEPS if peak > 0 else 0):
            seen = radiance_at_lens(camera, Spectrum.of(wavelength_nm, value * level), [effect], kind)
            level *= peak / max(seen.value)
        radiance = Spectrum.of(wavelength_nm, value * level)
    return radiance
