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
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import constants
from scipy.special import expit

from mocks.imaging import SCREEN_OVERSAMPLE, Edge, Imager, Pose, corners_px
from mocks.truth import AIR_C, COLS, DISTANCE_MM, PITCH_UM, ROWS, SELF_HEATING_C, SIDES, Truth, hidden_truth
from sim.camera import Side
from sim.effects.base import Effect
from sim.scene.render import Grid, cells, quadrilateral
from sim.sensor.electrons import sample_from
from sim.sensor.shot import draw_poisson
from sim.spectrum import FloatArray, Spectrum

UInt16Array = NDArray[np.uint16]
UInt8Array = NDArray[np.uint8]

#: The grid on which the bench computes light: finer than what the radiometer reports (1 nm) and the fits use.
WAVELENGTH_NM: FloatArray = np.arange(350.0, 1000.1, 0.5)
#: Reciprocal linear dispersion of the monochromator: FWHM of the slit function in nm = slit width in mm x this.
DISPERSION_NM_PER_MM = 3.16
#: Long-pass cut-on (nm) of each place of the filter wheel; None: an open place, infinity: a blank.
FILTER_CUT_ON_NM: dict[int, float | None] = {1: None, 2: 375.0, 3: 550.0, 4: 780.0, 5: None, 6: np.inf}
#: The screen: rows, columns, distance of neighbouring pixels.
SCREEN_ROWS, SCREEN_COLS, SCREEN_PITCH_MM = 1080, 1920, 0.225
#: What a knife edge's dark side, the screen's dark pixels and a board's black send back of the light.
BLADE_REFLECTANCE, SCREEN_BLACK, BOARD_BLACK, BOARD_WHITE = 0.02, 0.0015, 0.04, 0.88
#: A pixel of the cameras at the targets' distance.
MM_PER_PX = DISTANCE_MM * PITCH_UM * 1e-3 / 6.0

#: The ColorChecker: distance of neighbouring patches, and the share of it that is frame.
CHART_PITCH_MM, CHART_GAP = 36.0, 0.13
_CHART = Pose.of((-103.0, -70.0, DISTANCE_MM), (0.0, 0.0, 0.7))

#: Knife-edge targets: nominal angle of the edge from the vertical; each has an edge in three places of the field.
EDGE_ANGLES_DEG = {"edge-1": 5.2, "edge-2": 94.8, "edge-3": 41.0, "edge-4": -37.0}
EDGE_PLACES_PX = {"centre": (0.0, 0.0), "mid": (-110.0, -165.0), "corner": (158.0, 228.0)}
EDGE_REGION_PX = 120

#: The ChArUco board: squares down and across, and sizes.
BOARD_SQUARES, SQUARE_MM, MARKER_MM, BOARD_DICTIONARY = (6, 9), 20.0, 15.0, "DICT_4X4_50"
#: Centre of the board (mm from where the cameras' axes meet) and turns about its x, y and z (degrees).
BOARD_POSES: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "charuco-01": ((0, 0, 0), (0, 0, 0)),
    "charuco-02": ((-8, -6, 20), (24, 0, 4)),
    "charuco-03": ((8, 6, 20), (-24, 0, -5)),
    "charuco-04": ((-36, 8, 10), (0, 28, 3)),
    "charuco-05": ((36, -8, 10), (0, -28, -4)),
    "charuco-06": ((-34, -28, 30), (16, 16, 6)),
    "charuco-07": ((34, 28, 30), (-16, 16, -6)),
    "charuco-08": ((-34, 28, 30), (16, -16, 10)),
    "charuco-09": ((34, -28, 30), (-16, -16, -10)),
    "charuco-10": ((0, 0, -20), (8, -10, 90)),
    "charuco-11": ((-20, 16, 130), (30, 10, -30)),
    "charuco-12": ((20, -16, -110), (-8, 12, 177)),
}
_TEXEL_MM = 0.5
_SCREEN = Pose.of((1.7, -0.9, DISTANCE_MM), (0.3, -0.4, 0.5))
_MOST_CACHED = 24


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

    def sleep_until(self, moment: float) -> None:
        """Let virtual time pass up to `moment`; nothing if it has come. Two that wait for the same moment wait once."""
        left = moment - self.now()
        if left > 0 and self.real_time_factor > 0:
            time.sleep(left * self.real_time_factor)
        with self._lock:
            self._now_s = max(self._now_s, moment)


@dataclass(frozen=True)
class LightSettings:
    """How the shared light path is set: what identifies the light in front of the target."""

    wavelength_nm: float = 0.0
    shutter_open: bool = False
    filter_place: int = 1
    slit_um: float = 3000.0


def lamp_radiance(wavelength_nm: FloatArray, temperature_k: float = 3050.0) -> FloatArray:
    """Radiance (W sr^-1 m^-2 nm^-1) of the sphere's port in zero order with all filters out: a tungsten-halogen lamp.

    Planck's law with the emissivity of tungsten falling from 0.47 to 0.33, behind glass that is opaque below 385 nm and a
    heat filter that is opaque above 730 nm (half-way points), scaled to 0.03 at 560 nm.
    """

    def shape(w: FloatArray) -> FloatArray:
        x = constants.h * constants.c / (w * 1e-9 * constants.k * temperature_k)
        planck = 1.0 / (w**5 * np.expm1(x))
        emissivity = 0.47 - 0.14 * (w - 340.0) / 660.0
        return np.asarray(planck * emissivity * expit((w - 385.0) / 4.0) * expit((730.0 - w) / 4.0))

    return 0.03 * shape(np.asarray(wavelength_nm, float)) / shape(np.array([560.0]))


def screen_radiance(wavelength_nm: FloatArray) -> FloatArray:
    """Radiance (W sr^-1 m^-2 nm^-1) of the lit screen: a blue diode and two phosphors, about 300 cd/m^2."""
    w = np.asarray(wavelength_nm, float)
    primaries = ((450.0, 9.0, 0.0090), (532.0, 24.0, 0.0042), (612.0, 17.0, 0.0051))
    return np.asarray(sum(peak * np.exp(-0.5 * ((w - centre) / sd) ** 2) for centre, sd, peak in primaries))


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


@dataclass(frozen=True, eq=False)
class _Shown:
    """What the display shows: 0/1 cells, each `cell_px` screen pixels wide, centred; None: all dark."""

    pattern: UInt8Array | None = None
    cell_px: int = 1
    serial: int = 0

    def origin_px(self) -> tuple[int, int]:
        """Row and column of the screen pixel at which the pattern begins."""
        rows, cols = (0, 0) if self.pattern is None else self.pattern.shape
        return (SCREEN_ROWS - rows * self.cell_px) // 2, (SCREEN_COLS - cols * self.cell_px) // 2


@cache
def _board_texture() -> FloatArray:
    """The ChArUco board as it is printed, with a white rim of one square: 0..1, `_TEXEL_MM` a sample."""
    rows, cols = BOARD_SQUARES
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, BOARD_DICTIONARY))
    board = cv2.aruco.CharucoBoard((cols, rows), SQUARE_MM, MARKER_MM, dictionary)
    rim = round(SQUARE_MM / _TEXEL_MM)
    size = (cols + 2) * rim, (rows + 2) * rim
    return np.asarray(board.generateImage(size, marginSize=rim), float) / 255.0


def _edges(name: str) -> tuple[Edge, ...]:
    """The edges of one knife-edge target, each a little off the middle of its place, as blades are."""
    angle = EDGE_ANGLES_DEG[name]
    off = {"centre": (0.31, -0.52), "mid": (-0.77, 0.28), "corner": (0.55, 0.93)}
    return tuple(
        Edge(
            (across * MM_PER_PX, down * MM_PER_PX),
            ((across + off[place][0]) * MM_PER_PX, (down + off[place][1]) * MM_PER_PX),
            angle + 0.15,
        )
        for place, (down, across) in EDGE_PLACES_PX.items()
    )


def _board_pose(name: str) -> Pose:
    (x, y, z), turns = BOARD_POSES[name]
    return Pose.of((float(x), float(y), DISTANCE_MM + z), turns)


class Bench:
    """The light path, the stage and both cameras; see the module's docstring.

    `seed` fixes the hidden truth and the noise; `concealed` replaces what the cameras conceal (default:
    `mocks.truth.CONCEALED`). Every public method may be called from any thread.
    """

    def __init__(
        self,
        seed: int = 1,
        real_time_factor: float = 0.0,
        concealed: Mapping[Side, tuple[Effect, ...]] | None = None,
    ) -> None:
        self._lock = threading.RLock()
        self._truth: Truth = hidden_truth(seed, concealed)
        self._radiometer_rng = np.random.default_rng([seed, 100])
        self._noise = {side: np.random.default_rng([seed, 101 + k]) for k, side in enumerate(SIDES)}
        self._camera_locks = {side: threading.Lock() for side in SIDES}
        self._imagers: dict[Side, Imager] = {}
        self._rates: OrderedDict[tuple[object, ...], FloatArray] = OrderedDict()
        self.clock = Clock(real_time_factor=real_time_factor)
        self._started_s = self.clock.now()
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
        with self._lock:
            self._light = replace(self._light, wavelength_nm=float(nm))

    def set_shutter(self, opened: bool) -> None:
        """Open or close the monochromator's shutter. The screen has its own light."""
        with self._lock:
            self._light = replace(self._light, shutter_open=bool(opened))

    def set_filter(self, place: int) -> None:
        """Turn the filter wheel to place 1..6 (`FILTER_CUT_ON_NM`)."""
        if place not in FILTER_CUT_ON_NM:
            raise BenchError(
                f"filter {place} isn't on the wheel: it has {min(FILTER_CUT_ON_NM)}..{max(FILTER_CUT_ON_NM)}"
            )
        with self._lock:
            self._light = replace(self._light, filter_place=int(place))

    def set_slit_um(self, width_um: float) -> None:
        """Set entrance and exit slits (um, 4..3000); FWHM in nm = width in mm x `DISPERSION_NM_PER_MM`."""
        if not 4.0 <= width_um <= 3000.0:
            raise BenchError(f"slit width {width_um} um is outside 4..3000 um")
        with self._lock:
            self._light = replace(self._light, slit_um=float(width_um))

    def _drift(self, at_s: float) -> float:
        """Factor on the lamp at a virtual time: a slow swing of 0.04 %."""
        return 1.0 + 4e-4 * float(np.sin(2 * np.pi * (at_s - self._started_s) / 2400.0))

    def radiance(self) -> Spectrum:
        """What a spectroradiometer aimed at the target measures (350..1000 nm by 1, W sr^-1 m^-2 nm^-1, with its noise).

        Of the sphere's port; of a white diffuser beside the chart or board; of the lit half of a knife edge; of the
        screen's centre (a spot of 10 mm); dark under the cap. Noise: 0.15 % of the value and 2e-9 W sr^-1 m^-2 nm^-1.
        """
        with self._lock:
            true = self._radiance_in_front() * self._drift(self.clock.now())
            w, value = WAVELENGTH_NM[::2], true[::2].copy()
            value *= 1.0 + 1.5e-3 * self._radiometer_rng.standard_normal(value.size)
            value += 2e-9 * self._radiometer_rng.standard_normal(value.size)
        return Spectrum.of(w, np.maximum(value, 0.0))

    def _radiance_in_front(self) -> FloatArray:
        if self._placed == "cap":
            return np.zeros_like(WAVELENGTH_NM)
        if self._placed == "screen":
            return screen_radiance(WAVELENGTH_NM) * (SCREEN_BLACK + (1.0 - SCREEN_BLACK) * self._lit_share())
        return sphere_radiance(self._light, WAVELENGTH_NM)

    def _lit_share(self) -> float:
        """Share of lit pixels in the radiometer's spot at the screen's centre."""
        shown, half = self._shown, round(5.0 / SCREEN_PITCH_MM)
        if shown.pattern is None:
            return 0.0
        top, left = shown.origin_px()
        share = []
        for origin, middle, cell_count in (
            (top, SCREEN_ROWS // 2, shown.pattern.shape[0]),
            (left, SCREEN_COLS // 2, shown.pattern.shape[1]),
        ):
            pixel = np.arange(middle - half, middle + half)
            cell = (pixel - origin) // shown.cell_px
            share.append((cell, (cell >= 0) & (cell < cell_count)))
        (rows, rows_in), (cols, cols_in) = share
        lit = shown.pattern[np.ix_(rows[rows_in], cols[cols_in])].sum()
        return float(lit) / (rows.size * cols.size)

    # --- stage and screen -------------------------------------------------------------------------------------------

    @property
    def targets(self) -> tuple[str, ...]:
        """Names that `place` takes."""
        return ("cap", "sphere", "colorchecker", *EDGE_ANGLES_DEG, "screen", *BOARD_POSES)

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
            serial = self._shown.serial + 1
            if pattern is None:
                self._shown = _Shown(serial=serial)
                return
            cells = (np.asarray(pattern) != 0).astype(np.uint8)
            if cells.ndim != 2 or cells.shape[0] * cell_px > SCREEN_ROWS or cells.shape[1] * cell_px > SCREEN_COLS:
                raise BenchError(
                    f"a pattern of {cells.shape} cells x {cell_px} px doesn't fit the screen of {SCREEN_ROWS} x {SCREEN_COLS} px"
                )
            self._shown = _Shown(cells, int(cell_px), serial)

    # --- cameras ----------------------------------------------------------------------------------------------------

    @property
    def temperature_c(self) -> float:
        """Air temperature at the bench: 23 degrees, within 0.1."""
        return AIR_C + 0.1 * float(np.sin(2 * np.pi * (self.clock.now() - self._started_s) / 5400.0))

    def sensor_temperature_c(self, side: Side) -> float:
        """Temperature of one camera's sensor, as the camera itself reports it."""
        return self.temperature_c + SELF_HEATING_C[side]

    def sensor(self, side: Side) -> tuple[int, int, float]:
        """What a camera's own registers say of its sensor: rows, columns, distance of neighbouring pixels (um)."""
        return ROWS, COLS, PITCH_UM

    def compile_loops(self) -> None:
        """Those that patterns, charts and shot noise are drawn with: on a new installation that takes as long as a camera's driver waits
        for its first frame. No frame changes by it."""
        square = np.array([0.0, 0.0, 1.0, 1.0]), np.array([0.0, 1.0, 1.0, 0.0])
        cells(np.ones((2, 2)), _SCREEN.warp(self._truth.cameras["left"]), Grid(4, 4, 1, 0), 0.0)
        quadrilateral(np.arange(2.0), np.arange(2.0), 1.0, *square)
        draw_poisson(np.ones((2, 2), np.float32), np.random.default_rng(0))

    def expose(self, side: Side, exposure_s: float, gain_db: float = 0.0, start_s: float | None = None) -> UInt16Array:
        """One raw frame, (rows, cols) DN, of what stands in front now.

        `start_s`: the virtual time at which it began (a pair triggered together shares it), None: now. Afterwards the
        clock stands at least at the exposure's end.
        """
        if side not in self._truth.cameras:
            raise BenchError(f"no camera {side!r} on this bench: it has {', '.join(self._truth.cameras)}")
        camera = self._truth.cameras[side]
        begin_s = self.clock.now() if start_s is None else start_s
        rate = self._light_rate(side) * self._drift(begin_s + 0.5 * exposure_s)
        dark = camera.dark_current_e_per_s(self.sensor_temperature_c(side)) * exposure_s
        with self._camera_locks[side]:
            frame = sample_from(
                rate * exposure_s + dark,
                camera.model,
                self._noise[side],
                camera.pattern,
                dark_electrons=dark,
                gain_db=gain_db,
            )
        self.clock.sleep_until(begin_s + exposure_s)
        return frame

    def _light_rate(self, side: Side) -> FloatArray:
        """Electrons a second that light makes in every pixel, kept for the scenes seen last."""
        with self._lock:
            placed, light, shown = self._placed, self._light, self._shown
        key: tuple[object, ...] = (side, placed, shown.serial if placed == "screen" else light)
        if placed == "cap" or (placed != "screen" and not light.shutter_open):
            key = (side, "dark")
        with self._camera_locks[side]:
            with self._lock:
                if key in self._rates:
                    self._rates.move_to_end(key)
                    return self._rates[key]
            rate = self._draw(side, placed, light, shown) if key[1] != "dark" else np.zeros((ROWS, COLS))
            with self._lock:
                self._rates[key] = rate
                while len(self._rates) > _MOST_CACHED:
                    self._rates.popitem(last=False)
            return rate

    def _draw(self, side: Side, placed: str, light: LightSettings, shown: _Shown) -> FloatArray:
        camera = self._truth.cameras[side]
        imager = self._imagers.setdefault(side, Imager(camera))
        name = repr(light)
        radiance = sphere_radiance(light, WAVELENGTH_NM)

        def shine(share: float) -> Spectrum:
            return Spectrum.of(WAVELENGTH_NM, radiance * share)

        if placed == "colorchecker":
            return imager.chart(_CHART.warp(camera, CHART_PITCH_MM), CHART_GAP, shine(1.0), name)
        if placed in EDGE_ANGLES_DEG:
            return imager.edges(_edges(placed), shine(BLADE_REFLECTANCE), shine(1.0))
        if placed in BOARD_POSES:
            rows, cols = BOARD_SQUARES
            corner = -(cols / 2 + 1) * SQUARE_MM, -(rows / 2 + 1) * SQUARE_MM
            warp = _board_pose(placed).warp(camera, _TEXEL_MM, corner)
            return imager.pattern(_board_texture(), warp, shine(BOARD_BLACK), shine(BOARD_WHITE), name, surround=1.0)
        if placed == "screen":
            white = screen_radiance(WAVELENGTH_NM)
            dark, lit = Spectrum.of(WAVELENGTH_NM, white * SCREEN_BLACK), Spectrum.of(WAVELENGTH_NM, white)
            if shown.pattern is None:
                return imager.uniform(dark)
            row, col = shown.origin_px()
            corner = (col - SCREEN_COLS / 2) * SCREEN_PITCH_MM, (row - SCREEN_ROWS / 2) * SCREEN_PITCH_MM
            warp = _SCREEN.warp(camera, SCREEN_PITCH_MM * shown.cell_px, corner)
            return imager.pattern(shown.pattern.astype(float), warp, dark, lit, "screen", oversample=SCREEN_OVERSAMPLE)
        return imager.uniform(shine(1.0))

    # --- what a lab knows -------------------------------------------------------------------------------------------

    def station_targets(self) -> dict[str, Any]:
        """Nominal layout of the targets in the frames, for the station file's `[targets]`: as good as a hand that places them
        and an eye that reads them off a first picture (corners to half a pixel, regions to the pixel). Keys by target:

        - all: `kind` ("cap" "sphere" "colorchecker" "slanted_edge" "screen" "charuco")
        - colorchecker: `chart`; `[targets.colorchecker.left]` `corners` (4 x [row, col], as in the recording set)
        - edge-N: `angle_deg`; `[[targets."edge-1".left.regions]]` `name` ("centre" "mid" "corner"), `region`
          [row0, col0, row1, col1], `angle_deg`, `field_mm` [row, col]
        - screen: `rows`, `cols`, `pixel_mm`; `[targets.screen.left]` `camera_px_per_screen_px`,
          `visible` [row0, col0, row1, col1] in screen pixels (what surely lies inside the frame)
        - charuco-NN: `dictionary`, `squares` [rows, cols], `square_mm`, `marker_mm`, `pose`
        """
        targets: dict[str, Any] = {"cap": {"kind": "cap"}, "sphere": {"kind": "sphere"}}
        targets["colorchecker"] = {"kind": "colorchecker", "chart": "ColorChecker24"} | self._by_side(
            self._chart_layout
        )
        for name, angle_deg in EDGE_ANGLES_DEG.items():
            targets[name] = {"kind": "slanted_edge", "angle_deg": angle_deg}
            targets[name] |= self._by_side(partial(self._edge_layout, name))
        targets["screen"] = {
            "kind": "screen",
            "rows": SCREEN_ROWS,
            "cols": SCREEN_COLS,
            "pixel_mm": SCREEN_PITCH_MM,
        } | self._by_side(self._screen_layout)
        for name in BOARD_POSES:
            targets[name] = {
                "kind": "charuco",
                "dictionary": BOARD_DICTIONARY,
                "squares": list(BOARD_SQUARES),
                "square_mm": SQUARE_MM,
                "marker_mm": MARKER_MM,
                "pose": name,
            }
        return targets

    def _by_side(self, layout: Callable[[Side], dict[str, Any]]) -> dict[str, Any]:
        return {side: layout(side) for side in SIDES}

    def _chart_layout(self, side: Side) -> dict[str, Any]:
        warp = _CHART.warp(self._truth.cameras[side], CHART_PITCH_MM)
        corners = corners_px(warp, 6.0 - CHART_GAP, 4.0 - CHART_GAP)
        return {"corners": (np.round(corners * 2.0) / 2.0).tolist()}

    def _edge_layout(self, name: str, side: Side) -> dict[str, Any]:
        regions = []
        for place, (down_px, across_px) in EDGE_PLACES_PX.items():
            row, col = (ROWS - 1) / 2 + down_px, (COLS - 1) / 2 + across_px
            half = EDGE_REGION_PX // 2
            top, left = round(row) - half, round(col) - half
            regions.append(
                {
                    "name": place,
                    "region": [top, left, top + 2 * half, left + 2 * half],
                    "angle_deg": EDGE_ANGLES_DEG[name],
                    "field_mm": [round(down_px * PITCH_UM * 1e-3, 4), round(across_px * PITCH_UM * 1e-3, 4)],
                }
            )
        return {"regions": regions}

    def _screen_layout(self, side: Side) -> dict[str, Any]:
        camera = self._truth.cameras[side]
        warp = _SCREEN.warp(
            camera, SCREEN_PITCH_MM, (-SCREEN_COLS / 2 * SCREEN_PITCH_MM, -SCREEN_ROWS / 2 * SCREEN_PITCH_MM)
        )
        edge = np.array([12.0, ROWS - 13.0, 12.0, COLS - 13.0])
        u, v = warp.to_pattern(np.repeat(edge[:2], 2), np.tile(edge[2:], 2))
        visible = [max(v[0], v[1]), max(u[0], u[2]), min(v[2], v[3]), min(u[1], u[3])]
        return {
            "camera_px_per_screen_px": round(SCREEN_PITCH_MM / MM_PER_PX, 3),
            "visible": [
                int(np.ceil(value / 2)) * 2 if k < 2 else int(value // 2) * 2 for k, value in enumerate(visible)
            ],
        }

    def station_cameras(self) -> dict[str, Any]:
        """What the maker says of each camera, for `[cameras.left.datasheet]`: the keys of the recording set's `Camera`,
        with `quantum_efficiency.R = {wavelength_nm = [...], value = [...]}` inline."""
        return {side: dict(camera.datasheet) for side, camera in self._truth.cameras.items()}
