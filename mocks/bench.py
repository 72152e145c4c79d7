"""The mock bench: one shared light path, the targets in front of it, and two cameras that look at them.

    lamp -> filter wheel -> monochromator (zero order at 0 nm) -> shutter -> integrating sphere -> target -> cameras
                                                                                screen ------------------^

Every mock instrument asks this object for light, and nothing else connects them: the monochromator's mock turns the
wheel, the radiometer's mock reads `Bench.radiance()`, the cameras' mocks call `Bench.expose()`. All of it is
thread-safe, for each instrument answers in its own thread. Time is virtual: an exposure of 2 s moves the clock by 2 s
and takes none, unless `real_time_factor` asks for it.

What a lab would know of the bench (where a target's corners lie in the frame to within a pixel, what the data sheet
says) is written to the station file by `station_targets()` and `station_cameras()`. What it wouldn't know, the hidden
truth, is in `mocks.truth` and stays in this process.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import constants

from sim.camera import Side
from sim.spectrum import FloatArray, Spectrum

UInt16Array = NDArray[np.uint16]
UInt8Array = NDArray[np.uint8]

#: The grid on which the bench computes light: finer than what the radiometer reports (1 nm) and the fits use.
WAVELENGTH_NM: FloatArray = np.arange(340.0, 1000.1, 0.5)
#: Reciprocal linear dispersion of the monochromator: FWHM of the slit function in nm = slit width in mm x this.
DISPERSION_NM_PER_MM = 3.16
#: Long-pass cut-on (nm) of each place of the filter wheel; None: an open place, infinity: a blank.
FILTER_CUT_ON_NM: dict[int, float | None] = {1: None, 2: 375.0, 3: 550.0, 4: 780.0, 5: None, 6: np.inf}
#: The screen: rows, columns, distance of neighbouring pixels.
SCREEN_ROWS, SCREEN_COLS, SCREEN_PITCH_MM = 1080, 1920, 0.225


class BenchError(Exception):
    """Something that can't be done on this bench (an unknown target, a filter place that isn't there)."""


class Clock:
    """Seconds since the epoch that only `sleep` moves; `real_time_factor` of each sleep is really slept (0: none, 1: all)."""

    def __init__(self, start_s: float = 1_780_000_000.0, real_time_factor: float = 0.0) -> None:
        self._now_s = start_s
        self._lock = threading.Lock()
        self.real_time_factor = real_time_factor

    def now(self) -> float:
        """Virtual time, seconds since the epoch."""
        with self._lock:
            return self._now_s

    def sleep(self, seconds: float) -> None:
        """Let `seconds` of virtual time pass."""
        if seconds <= 0:
            return
        with self._lock:
            self._now_s += seconds
        if self.real_time_factor > 0:
            time.sleep(seconds * self.real_time_factor)


@dataclass(frozen=True)
class LightSettings:
    """How the shared light path is set: what identifies the light in front of the target."""

    wavelength_nm: float = 0.0
    shutter_open: bool = False
    filter_place: int = 1
    slit_um: float = 3000.0


def lamp_radiance(wavelength_nm: FloatArray, temperature_k: float = 3050.0) -> FloatArray:
    """Radiance (W sr^-1 m^-2 nm^-1) of the sphere's port in zero order with all filters out: a tungsten-halogen lamp.

    Planck's law with the emissivity of tungsten falling from 0.47 to 0.33, times a smooth throughput of lamp house,
    grating's zero order and sphere coating, scaled to 0.03 at 560 nm.
    """

    def shape(w: FloatArray) -> FloatArray:
        x = constants.h * constants.c / (w * 1e-9 * constants.k * temperature_k)
        planck = 1.0 / (w**5 * np.expm1(x))
        emissivity = 0.47 - 0.14 * (w - 340.0) / 660.0
        throughput = 1.0 / (1.0 + np.exp(-(w - 372.0) / 14.0)) * (1.0 - 0.25 * ((w - 620.0) / 380.0) ** 2)
        return np.asarray(planck * emissivity * throughput)

    return 0.03 * shape(np.asarray(wavelength_nm, float)) / shape(np.array([560.0]))


def grating_efficiency(wavelength_nm: FloatArray) -> FloatArray:
    """Share of the light that a 1200 l/mm grating blazed at 500 nm sends into its first order."""
    w = np.asarray(wavelength_nm, float)
    return np.asarray(0.62 * np.exp(-0.5 * (np.log(w / 500.0) / 0.42) ** 2))


def filter_transmittance(place: int, wavelength_nm: FloatArray) -> FloatArray:
    """Transmittance of one place of the wheel: a long-pass with an edge 6 nm wide, 0.91 above it, 1e-5 below."""
    cut_on = FILTER_CUT_ON_NM[place]
    w = np.asarray(wavelength_nm, float)
    if cut_on is None:
        return np.ones_like(w)
    if not np.isfinite(cut_on):
        return np.zeros_like(w)
    return np.asarray(1e-5 + 0.91 / (1.0 + np.exp(-np.clip((w - cut_on) / 2.5, -200, 200))))


def slit_function(wavelength_nm: FloatArray, centre_nm: float, fwhm_nm: float) -> FloatArray:
    """Transmittance (1 at the centre) of equal entrance and exit slits: a triangle, rounded by aberrations to sigma 0.25 nm."""
    w = np.asarray(wavelength_nm, float)
    offsets = np.linspace(-0.75, 0.75, 13)
    weights = np.exp(-0.5 * (offsets / 0.25) ** 2)
    shape = sum(
        weight * np.clip(1.0 - np.abs(w - centre_nm - offset) / fwhm_nm, 0.0, None)
        for weight, offset in zip(weights / weights.sum(), offsets, strict=True)
    )
    return np.asarray(shape)


def sphere_radiance(light: LightSettings, wavelength_nm: FloatArray) -> FloatArray:
    """Radiance (W sr^-1 m^-2 nm^-1) of the sphere's port for a setting of the light path.

    Zero order passes all wavelengths. In first order at w the second order of w/2 leaves the slit at the same angle,
    with half the width in wavelength: only the filter wheel keeps it out. Stray light: 1e-6 of zero order.
    """
    w = np.asarray(wavelength_nm, float)
    if not light.shutter_open:
        return np.zeros_like(w)
    lamp = lamp_radiance(w) * filter_transmittance(light.filter_place, w)
    if light.wavelength_nm <= 0:
        return lamp
    fwhm_nm = light.slit_um * 1e-3 * DISPERSION_NM_PER_MM
    width = light.slit_um / 3000.0  # a narrower entrance slit lets less light in
    first = slit_function(w, light.wavelength_nm, fwhm_nm) * grating_efficiency(w)
    second = slit_function(w, light.wavelength_nm / 2, fwhm_nm / 2) * 0.2 * grating_efficiency(2 * w)
    return np.asarray(lamp * width * (first + second + 1e-6))


@dataclass
class _Shown:
    """What the display shows: 0/1 cells, each `cell_px` screen pixels wide, centred; None: all dark."""

    pattern: UInt8Array | None = None
    cell_px: int = 1
    serial: int = field(default=0)


class Bench:
    """The light path, the stage and both cameras; see the module's docstring.

    `seed` fixes the hidden truth and the noise. Every public method may be called from any thread.
    """

    def __init__(self, seed: int = 1, real_time_factor: float = 0.0) -> None:
        self._lock = threading.RLock()
        self._rng = np.random.default_rng([seed, 7])
        self.clock = Clock(real_time_factor=real_time_factor)
        self._light = LightSettings()
        self._placed = "cap"
        self._shown = _Shown()

    # --- light path -------------------------------------------------------------------------------------------------

    @property
    def light(self) -> LightSettings:
        """How the light path is set now."""
        with self._lock:
            return self._light

    def set_wavelength(self, nm: float) -> None:
        """Turn the grating: 0 is zero order (white light). Raises `BenchError` outside 0..1400 nm."""
        if not 0.0 <= nm <= 1400.0:
            raise BenchError(f"wavelength {nm} nm is outside 0..1400 nm of this grating")
        self._change(wavelength_nm=float(nm))

    def set_shutter(self, opened: bool) -> None:
        """Open or close the monochromator's shutter. The screen has its own light."""
        self._change(shutter_open=bool(opened))

    def set_filter(self, place: int) -> None:
        """Turn the filter wheel to place 1..6 (`FILTER_CUT_ON_NM`)."""
        if place not in FILTER_CUT_ON_NM:
            raise BenchError(
                f"filter {place} is not on the wheel: it has {min(FILTER_CUT_ON_NM)}..{max(FILTER_CUT_ON_NM)}"
            )
        self._change(filter_place=int(place))

    def set_slit_um(self, width_um: float) -> None:
        """Set entrance and exit slits (um, 4..3000); FWHM in nm = width in mm x `DISPERSION_NM_PER_MM`."""
        if not 4.0 <= width_um <= 3000.0:
            raise BenchError(f"slit width {width_um} um is outside 4..3000 um")
        self._change(slit_um=float(width_um))

    def _change(self, **settings: float | bool | int) -> None:
        with self._lock:
            self._light = LightSettings(**{**self._light.__dict__, **settings})  # type: ignore[arg-type]

    def radiance(self) -> Spectrum:
        """What a spectroradiometer aimed at the target measures (350..1000 nm by 1, W sr^-1 m^-2 nm^-1, with its noise).

        Of the sphere's port; of a white diffuser beside the chart or board; of the lit half of a knife edge; of the
        screen's centre; dark under the cap.
        """
        raise NotImplementedError

    # --- stage and screen -------------------------------------------------------------------------------------------

    @property
    def targets(self) -> tuple[str, ...]:
        """Names that `place` takes."""
        return (
            "cap",
            "sphere",
            "colorchecker",
            *(f"edge-{n}" for n in range(1, 5)),
            "screen",
            *(f"charuco-{n:02d}" for n in range(1, 13)),
        )

    @property
    def placed(self) -> str:
        """The target in front of the cameras."""
        with self._lock:
            return self._placed

    def place(self, name: str) -> None:
        """Put a target in front of both cameras. Raises `BenchError` for a name that isn't in `targets`."""
        if name not in self.targets:
            raise BenchError(f"no target {name!r} on this bench: it has {', '.join(self.targets)}")
        with self._lock:
            self._placed = name

    def show(self, pattern: UInt8Array | None, cell_px: int = 1) -> None:
        """Show 0/1 cells on the screen (0 dark, anything else lit), each `cell_px` screen pixels square, the whole centred.

        The rest of the screen is dark. None: all dark. One value per screen pixel with `cell_px=1` is what a page that
        paints its canvas pixel by pixel amounts to. Raises `BenchError` if the pattern is larger than the screen.
        """
        with self._lock:
            if pattern is None:
                self._shown = _Shown(serial=self._shown.serial + 1)
                return
            cells = (np.asarray(pattern) != 0).astype(np.uint8)
            if cells.ndim != 2 or cells.shape[0] * cell_px > SCREEN_ROWS or cells.shape[1] * cell_px > SCREEN_COLS:
                raise BenchError(
                    f"a pattern of {cells.shape} cells x {cell_px} px doesn't fit the screen of {SCREEN_ROWS} x {SCREEN_COLS} px"
                )
            self._shown = _Shown(cells, int(cell_px), self._shown.serial + 1)

    # --- cameras ----------------------------------------------------------------------------------------------------

    @property
    def temperature_c(self) -> float:
        """Air temperature at the bench."""
        return 23.0

    def sensor_temperature_c(self, side: Side) -> float:
        """Temperature of one camera's sensor, as the camera itself reports it."""
        raise NotImplementedError

    def expose(self, side: Side, exposure_s: float, gain_db: float = 0.0, start_s: float | None = None) -> UInt16Array:
        """One raw frame, (rows, cols) DN. `start_s`: when it began (a pair triggered together shares it); the clock then
        stands at least at its end."""
        raise NotImplementedError

    # --- what a lab knows -------------------------------------------------------------------------------------------

    def station_targets(self) -> dict[str, object]:
        """Nominal layout of the targets in the frames, for the station file's `[targets]`. Keys by target:

        - all: `kind` ("cap" "sphere" "colorchecker" "slanted_edge" "screen" "charuco")
        - colorchecker: `chart`; `[targets.colorchecker.left]` `corners` (4 x [row, col], as in the recording set)
        - edge-N: `angle_deg`; `[[targets."edge-1".left.regions]]` `name` ("centre" "mid" "corner"), `region`
          [row0, col0, row1, col1], `angle_deg`, `field_mm` [row, col]
        - screen: `rows`, `cols`, `pixel_mm`; `[targets.screen.left]` `camera_px_per_screen_px`,
          `visible` [row0, col0, row1, col1] in screen pixels (what surely lies inside the frame)
        - charuco-NN: `dictionary`, `squares` [rows, cols], `square_mm`, `marker_mm`, `pose`
        """
        raise NotImplementedError

    def station_cameras(self) -> dict[str, object]:
        """What the maker says of each camera, for `[cameras.left.datasheet]`: the keys of the recording set's `Camera`,
        with `quantum_efficiency.R = {wavelength_nm = [...], value = [...]}` inline."""
        raise NotImplementedError
