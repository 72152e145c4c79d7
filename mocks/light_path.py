"""The light before it meets a target: lamp, filter wheel, monochromator and integrating sphere; and the lit screen.

lamp -> filter wheel -> monochromator (zero order at 0 nm) -> shutter -> integrating sphere <- LEDs at a second port"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import constants
from scipy.special import expit

from mocks.conceal import OF_THE_RADIOMETER
from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.wavelength_offset import WavelengthOffset
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import radiance_at_lens

#: The grid on which the bench computes light: finer than what the radiometer reports (1 nm) and the fits use.
WAVELENGTH_NM: FloatArray = np.arange(350.0, 1000.1, 0.5)
#: Reciprocal linear dispersion of the monochromator: FWHM of the slit function in nm = slit width in mm x this.
DISPERSION_NM_PER_MM = 3.16
#: Full widths at half maximum (nm) of the light source's LEDs: those made white by a phosphor, and all others; and the
#: radiance (W sr^-1 m^-2) of the sphere's port by one of them at its brightest.
LED_FWHM_NM, USUAL_LED_FWHM_NM, LED_RADIANCE = {550: 100.0, 580: 80.0}, 22.0, 1.2
#: Long-pass cut-on (nm) of each place of the filter wheel; None: an open place, infinity: a blank.
FILTER_CUT_ON_NM: dict[int, float | None] = {1: None, 2: 375.0, 3: 550.0, 4: 780.0, 5: None, 6: np.inf}


@dataclass(frozen=True)
class LightSettings:
    """How the shared light path is set: what identifies the light in front of the target."""

    wavelength_nm: float = 0.0
    shutter_open: bool = False
    filter_place: int = 1
    slit_um: float = 3000.0
    leds: tuple[tuple[int, float], ...] = ()  # nominal wavelength (nm) and share 0..1 of those that shine

    @property
    def first_order(self) -> bool:
        """Whether light of one wavelength leaves the monochromator, and not all of the lamp's."""
        return self.wavelength_nm > 0 and not self.leds

    @property
    def shines(self) -> bool:
        """Whether any light reaches the sphere."""
        return self.shutter_open or bool(self.leds)


def lamp_radiance(wavelength_nm: FloatArray, temperature_k: float = 3050.0) -> FloatArray:
    """Return the radiance (W sr^-1 m^-2 nm^-1) of the sphere's port in zero order with all filters out.

    wavelength_nm : (m,)
    temperature_k : of the tungsten-halogen lamp

    Planck's law with the emissivity of tungsten falling from 0.47 to 0.33, behind glass that is opaque below 385 nm and
    a heat filter that is opaque above 730 nm (half-way points), scaled to 0.03 at 560 nm.

    >>> lamp_radiance(np.array([560.0])).round(6).tolist()
    [0.03]
    """

    def shape(w: FloatArray) -> FloatArray:
        x = constants.h * constants.c / (w * 1e-9 * constants.k * temperature_k)
        planck = 1.0 / (w**5 * np.expm1(x))
        emissivity = 0.47 - 0.14 * (w - 340.0) / 660.0
        return np.asarray(planck * emissivity * expit((w - 385.0) / 4.0) * expit((730.0 - w) / 4.0))

    return 0.03 * shape(np.asarray(wavelength_nm, float)) / shape(np.array([560.0]))


def led_radiance(wavelength_nm: FloatArray, led_nm: int, share: float) -> FloatArray:
    """Return the radiance (W sr^-1 m^-2 nm^-1) of the sphere's port by one LED.

    wavelength_nm : (m,)
    led_nm : nominal wavelength
    share : of its most, 0..1

    It is a normal line at the nominal wavelength, whose total is `LED_RADIANCE` whatever its width.

    >>> wavelength_nm = np.arange(300.0, 801.0)
    >>> bool(np.isclose(np.trapezoid(led_radiance(wavelength_nm, 550, 0.5), wavelength_nm), 0.5 * LED_RADIANCE))
    True
    """
    std_nm = LED_FWHM_NM.get(led_nm, USUAL_LED_FWHM_NM) / np.sqrt(8.0 * np.log(2.0))
    line = np.exp(-0.5 * np.square((np.asarray(wavelength_nm, float) - led_nm) / std_nm))
    return np.asarray(share * LED_RADIANCE / (np.sqrt(2.0 * np.pi) * std_nm) * line)


def screen_radiance(wavelength_nm: FloatArray) -> FloatArray:
    """Return the radiance (W sr^-1 m^-2 nm^-1) of the lit screen: a blue diode and two phosphors, about 300 cd/m^2.

    wavelength_nm : (m,)

    >>> screen_radiance(np.array([450.0])).round(3).tolist()
    [0.009]
    """
    w = np.asarray(wavelength_nm, float)
    primaries = ((450.0, 9.0, 0.0090), (532.0, 24.0, 0.0042), (612.0, 17.0, 0.0051))
    return np.asarray(sum(peak * np.exp(-0.5 * ((w - centre) / sd) ** 2) for centre, sd, peak in primaries))


def grating_efficiency(wavelength_nm: FloatArray) -> FloatArray:
    """Return the share of the light that a 1200 l/mm grating blazed at 500 nm sends into its first order.

    wavelength_nm : (m,)

    >>> grating_efficiency(np.array([500.0])).tolist()
    [0.62]
    """
    w = np.asarray(wavelength_nm, float)
    return np.asarray(0.62 * np.exp(-0.5 * (np.log(w / 500.0) / 0.42) ** 2))


def filter_transmittance(place: int, wavelength_nm: FloatArray) -> FloatArray:
    """Return the transmittance of one place of the wheel: a long-pass with an edge 6 nm wide, 0.91 above it, 1e-5
    below.

    place : 1..6; an empty place transmits everything
    wavelength_nm : (m,)

    >>> filter_transmittance(1, np.array([500.0])).tolist()
    [1.0]
    """
    cut_on = FILTER_CUT_ON_NM[place]
    w = np.asarray(wavelength_nm, float)
    if cut_on is None:
        return np.ones_like(w)
    if not np.isfinite(cut_on):
        return np.zeros_like(w)
    return np.asarray(1e-5 + 0.91 / (1.0 + np.exp(-np.clip((w - cut_on) / 2.5, -200, 200))))


def slit_function(wavelength_nm: FloatArray, centre_nm: float, fwhm_nm: float) -> FloatArray:
    """Return the transmittance (1 at the centre) of equal entrance and exit slits.

    wavelength_nm : (m,)
    centre_nm, fwhm_nm : of the triangle, which aberrations round to sigma 0.25 nm

    >>> slit_function(np.array([545.0, 555.0]), 550.0, 10.0).round(2).tolist()
    [0.5, 0.5]
    """
    w = np.asarray(wavelength_nm, float)
    offsets = np.linspace(-0.75, 0.75, 13)
    weights = np.exp(-0.5 * (offsets / 0.25) ** 2)
    shape = sum(
        weight * np.clip(1.0 - np.abs(w - centre_nm - offset) / fwhm_nm, 0.0, None)
        for weight, offset in zip(weights / weights.sum(), offsets, strict=True)
    )
    return np.asarray(shape)


def sphere_radiance(light: LightSettings, wavelength_nm: FloatArray) -> FloatArray:
    """Return the radiance (W sr^-1 m^-2 nm^-1) of the sphere's port for a setting of the light path.

    Zero order passes all wavelengths. In first order at w the second order of w/2 leaves the slit at the same angle,
    with half the width in wavelength: only the filter wheel keeps it out. Stray light: 1e-6 of zero order. LEDs add
    theirs, whatever the shutter does.
    """
    w = np.asarray(wavelength_nm, float)
    leds = np.sum([led_radiance(w, *led) for led in light.leds], axis=0) if light.leds else np.zeros_like(w)
    return np.asarray(_by_monochromator(light, w) + leds)


def _by_monochromator(light: LightSettings, w: FloatArray) -> FloatArray:
    """Return the part of the sphere's radiance that comes through the monochromator's shutter."""
    if not light.shutter_open:
        return np.zeros_like(w)
    lamp = lamp_radiance(w) * filter_transmittance(light.filter_place, w)
    if not light.first_order:
        return lamp
    fwhm_nm = light.slit_um * 1e-3 * DISPERSION_NM_PER_MM
    width = light.slit_um / 3000.0  # a narrower entrance slit lets less light in
    first = slit_function(w, light.wavelength_nm, fwhm_nm) * grating_efficiency(w)
    second = slit_function(w, light.wavelength_nm / 2, fwhm_nm / 2) * 0.2 * grating_efficiency(2 * w)
    return np.asarray(lamp * width * (first + second + 1e-6))


# ----------------------------------------------------------------------------------------------------------------------
# What the bench's spectroradiometer makes of the light before it: noise, and the errors that a bench may conceal in
# it.


#: Steps towards the level at which a radiometer that isn't linear reads; each leaves a few per cent of the error before
#: it.
LEVEL_STEPS = 40


def misread(camera: CameraModel, radiance: Spectrum, effects: Sequence[Effect], kind: str) -> Spectrum:
    """Return what a radiometer with `effects` reads of `radiance`: the reading from which the forward model gets that
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
            at_lens = radiance_at_lens(camera, Spectrum.of(wavelength_nm, value * level), [effect], kind)
            level *= peak / max(at_lens.value)
        radiance = Spectrum.of(wavelength_nm, value * level)
    return radiance
