"""Light for a mock that stands alone, without a bench: a lamp that a radiometer can look at, and what the eye makes of
it."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from functools import cache
from importlib.resources import files

import numpy as np
from scipy.interpolate import CubicSpline

from mocks.wire import MockClock
from sim.spectrum import FloatArray, Spectrum

#: cd/m2 of what a photometer sees per W sr^-1 m^-2 weighted by V(lambda).
LUMINOUS_EFFICACY_LM_PER_W = 683.0


class LampClock:
    """Virtual seconds; `real_time_factor` of each sleep is really slept."""

    def __init__(self, real_time_factor: float = 0.0) -> None:
        self._now_s = 0.0
        self._lock = threading.Lock()
        self.real_time_factor = real_time_factor

    def now(self) -> float:
        with self._lock:
            return self._now_s

    def sleep(self, seconds: float) -> None:
        with self._lock:
            self._now_s += seconds
        time.sleep(seconds * self.real_time_factor)


class Lamp:
    """A standing lamp (CIE illuminant A, 2856 K) on a white surface of `luminance_cd_m2`; it doesn't heed a
    monochromator."""

    def __init__(self, luminance_cd_m2: float = 100.0, clock: MockClock | None = None) -> None:
        wavelength_nm = np.arange(340.0, 1100.5, 1.0)
        x = 1.435e7 / (2848.0 * wavelength_nm)  # as CIE defines it: 2848 K on the c2 of 1931, 2856 K on today's
        shape = Spectrum.of(wavelength_nm, (560.0 / wavelength_nm) ** 5 / np.expm1(x))
        scale = luminance_cd_m2 / tristimulus(shape)[1]
        self._radiance = Spectrum.of(wavelength_nm, scale * np.asarray(shape.value))
        self.clock: MockClock = clock or LampClock()
        self.placed = "cap"
        self.targets: tuple[str, ...] = ("cap", "sphere", "colorchecker", "screen")

    def radiance(self) -> Spectrum:
        """Return the spectral radiance (W sr^-1 m^-2 nm^-1) of the white surface, 340..1100 nm."""
        return self._radiance

    def set_wavelength(self, nm: float) -> None:
        """Do nothing: no monochromator stands in its light."""

    def set_shutter(self, opened: bool) -> None:
        """Do nothing: it burns on."""

    def set_filter(self, place: int) -> None:
        """Do nothing: there is no wheel."""

    def set_slit_um(self, width_um: float) -> None:
        """Do nothing: there is no slit."""

    def set_leds(self, shares: Mapping[int, float]) -> None:
        """Do nothing: there is no sphere that they could light."""

    def place(self, name: str) -> None:
        """Remember what was placed; raises `ValueError` for a name that isn't among the targets."""
        if name not in self.targets:
            raise ValueError(f"no target {name!r} here: there are {', '.join(self.targets)}")
        self.placed = name

    def show(self, pattern: object, cell_px: int = 1) -> None:
        """Do nothing: there is no screen."""


@cache
def _colour_matching(first_nm: float, last_nm: float) -> FloatArray:
    """Rows x, y, z of the colour matching functions at every nm, by a cubic spline through the table."""
    text = (files("mocks") / "cie1931.csv").read_text(encoding="utf-8")
    table = np.array([[float(v) for v in line.split(",")] for line in text.splitlines()[2:]])
    return np.asarray(CubicSpline(table[:, 0], table[:, 1:])(np.arange(first_nm, last_nm + 0.5, 1.0)).T)


def tristimulus(radiance: Spectrum) -> tuple[float, float, float]:
    """Return X, Y, Z (CIE 1931, Y in cd/m^2) of a radiance in W sr^-1 m^-2 nm^-1: 683 x sum of L times each function.

    >>> from sim.scene.light import illuminant
    >>> abs(tristimulus(illuminant("D65", 100.0))[1] - 100.0) < 1.0
    True
    """
    light = radiance.at(np.arange(360.0, 830.5, 1.0))
    x, y, z = (LUMINOUS_EFFICACY_LM_PER_W * float(np.sum(light * row)) for row in _colour_matching(360.0, 830.0))
    return x, y, z
