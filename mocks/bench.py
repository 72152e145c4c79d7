"""The mock bench: one shared light path, the targets in front of it, and two cameras that look at them.

    lamp -> filter wheel -> monochromator (zero order at 0 nm) -> shutter -> integrating sphere -> target -> cameras
                                                             light source (LEDs) -----^      screen ----^

Every mock instrument asks this object for light, and nothing else connects them: the monochromator's mock turns the
wheel, the radiometer's mock reads `Bench.radiance()`, the cameras' mocks call `Bench.expose()`. All of it is
thread-safe, for each instrument answers in its own thread. Time is virtual: an exposure of 2 s moves the clock by 2 s
and takes none, unless `real_time_factor` asks for it.

Frames are the forward model's (`sim.frame`), of the scenes of `mocks.targets`, so that any effect of the library can be
concealed. Effects of lamp, monochromator, screen and room change the light that reaches the cameras and not what the
radiometer says; effects of the radiometer (`mocks.conceal.OF_THE_RADIOMETER`) change what it says and not the light.

What a lab would know of the bench (where a target's corners lie in the frame to within a pixel, what the data sheet
says) is written to the station file by `station_targets()` and `station_cameras()`. What it wouldn't know, the hidden
truth, is in `mocks.truth` and stays in this process.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mocks.conceal import SIDES, Concealed
from mocks.light_path import FILTER_CUT_ON_NM, WAVELENGTH_NM, LightSettings, misread, screen_radiance, sphere_radiance
from mocks.targets import (
    NOMINAL_STOP,
    SCREEN_BLACK,
    SCREEN_COLS,
    SCREEN_POSE,
    SCREEN_ROWS,
    STOPS,
    TARGETS,
    TEMPERATURES_C,
    TURNS_DEG,
    ShownCells,
    UInt8Array,
    scene,
    station_targets,
)
from mocks.truth import AIR_C, COLS, ROWS, SELF_HEATING_C, HiddenCamera, Truth, hidden_truth
from sim.camera import Side
from sim.frame import (
    EMPTY,
    Exposure,
    Kept,
    KeptTransfers,
    SceneLight,
    collect_electrons,
    dark_electrons,
    pair_gain_factor,
    read_electrons,
    read_out,
    scene_light,
    unsteady_source,
)
from sim.memory import return_freed_memory
from sim.scene import Scene, ScreenPattern, UniformField
from sim.scene.render import Grid, cells, quadrilateral
from sim.sensor.electrons import sample_from
from sim.sensor.margins import NO_MARGINS, Margins
from sim.sensor.shot import draw_poisson
from sim.spectrum import FloatArray, Spectrum
from sim.stop_down import at_f_number, effects_at_f_number

UInt16Array = NDArray[np.uint16]

#: Samples a pixel that scenes are drawn on, screens and others, and pixels around the frame.
SCREEN_OVERSAMPLE, OVERSAMPLE, MARGIN_PX = 4, 3, 16
#: Time (s) after which a sensor that warms up has done so by 63 %.
WARMING_S = 60.0
_MOST_CACHED = 24


class BenchError(Exception):
    """Something that can't be done on this bench (an unknown target, a filter place that isn't there)."""


class Clock:
    """Seconds since the epoch that only `sleep` moves; `real_time_factor` of each sleep is really slept (0: none, 1:
    all)."""

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


class Bench:
    """The light path, the stage and both cameras; see the module's docstring.

    `seed` fixes the hidden truth and the noise; `concealed` replaces what the cameras conceal (default:
    `mocks.truth.CONCEALED`). `shape` is that of the area that sees light, and `margins` surround it in the frames.
    `warm_up_c`: by how much the sensors get warmer after the
    bench was switched on. `session_clock` (s) is the one that a session dates its frames with: effects of time follow
    it; None: the virtual clock. Every public method may be called from any thread. Raises `mocks.conceal.ConcealError`
    for what it can't show."""

    def __init__(
        self,
        seed: int = 1,
        real_time_factor: float = 0.0,
        concealed: Concealed | None = None,
        *,
        shape: tuple[int, int] = (ROWS, COLS),
        margins: Margins = NO_MARGINS,
        warm_up_c: float = 0.0,
        session_clock: Callable[[], float] | None = None,
    ) -> None:
        self._lock = threading.RLock()
        self._truth: Truth = hidden_truth(seed, concealed, shape, margins)
        self._radiometer_rng = np.random.default_rng([seed, 100])
        self._noise = {side: np.random.default_rng([seed, 101 + k]) for k, side in enumerate(SIDES)}
        self._camera_locks = {side: threading.Lock() for side in SIDES}
        #: Of the cameras at the present stop: 74 MB, which a change of the stop frees.
        self._transfers = {side: KeptTransfers() for side in SIDES}
        self._kept: dict[Side, Kept] = dict.fromkeys(SIDES, EMPTY)
        self._lights: OrderedDict[tuple[object, ...], tuple[Scene, SceneLight]] = OrderedDict()
        self.clock = Clock(real_time_factor=real_time_factor)
        self._started_s = self.clock.now()
        self._warm_up_c = warm_up_c
        self._session_clock = session_clock
        self._first_exposure_s: float | None = None
        self._light = LightSettings()
        self._placed = "cap"
        self._stop = NOMINAL_STOP
        self._turn_deg, self._sensor_c = 0.0, TEMPERATURES_C["usual"]
        self._stopped: dict[tuple[Side, str], HiddenCamera] = {}
        self._shown = ShownCells()

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

    def set_leds(self, shares: Mapping[int, float]) -> None:
        """Light the LEDs at the sphere's second port: share 0..1 by nominal wavelength (nm); all others are dark."""
        lit = tuple(sorted((int(nm), float(share)) for nm, share in shares.items() if share > 0.0))
        with self._lock:
            self._light = replace(self._light, leds=lit)

    def _drift(self, at_s: float) -> float:
        """Factor on the lamp at a virtual time: a slow swing of 0.04 %."""
        return 1.0 + 4e-4 * float(np.sin(2 * np.pi * (at_s - self._started_s) / 2400.0))

    def radiance(self) -> Spectrum:
        """Return what a spectroradiometer aimed at the target measures (350..1000 nm by 1, W sr^-1 m^-2 nm^-1, with its
        noise).

        Of the sphere's port; of a white diffuser beside the chart or board; of the lit half of a knife edge; of the
        screen's centre (a spot of 10 mm); dark under the cap. Noise: 0.15 % of the value and 2e-9 W sr^-1 m^-2 nm^-1.
        """
        with self._lock:
            first_order = self._placed != "screen" and self._light.first_order
            there = Spectrum.of(WAVELENGTH_NM, self._radiance_in_front() * self._drift(self.clock.now()))
            effects = self._truth.cameras["left"].effects  # the radiometer's are the same on both sides
            w, true = misread(
                self._truth.cameras["left"].model, there, effects, "narrowband" if first_order else "flat"
            ).arrays
            w, value = w[::2], true[::2].copy()
            value *= 1.0 + 1.5e-3 * self._radiometer_rng.standard_normal(value.size)
            value += 2e-9 * self._radiometer_rng.standard_normal(value.size)
        return Spectrum.of(w, np.maximum(value, 0.0))

    def _radiance_in_front(self) -> FloatArray:
        if self._placed == "cap":
            return np.zeros_like(WAVELENGTH_NM)
        if self._placed == "screen":
            return screen_radiance(WAVELENGTH_NM) * (SCREEN_BLACK + (1.0 - SCREEN_BLACK) * self._shown.lit_share())
        return sphere_radiance(self._light, WAVELENGTH_NM)

    # --- stage and screen -------------------------------------------------------------------------------------------

    @property
    def targets(self) -> tuple[str, ...]:
        """Names that `place` takes."""
        return TARGETS

    @property
    def placed(self) -> str:
        """The target in front of the cameras."""
        with self._lock:
            return self._placed

    def place(self, name: str) -> None:
        """Put a target in front of both cameras, turn their aperture rings to a stop of `STOPS`, the edges' holder, or
        heat the sensors. Raises `BenchError` for a name that isn't in `targets`."""
        if name not in self.targets:
            raise BenchError(f"no target {name!r} on this bench: it has {', '.join(self.targets)}")
        with self._lock:
            if name in STOPS:
                if name != self._stop:
                    self._transfers = {side: KeptTransfers() for side in SIDES}
                self._stop = name
            elif name in TURNS_DEG:
                self._turn_deg = TURNS_DEG[name]
            elif name in TEMPERATURES_C:
                self._sensor_c = TEMPERATURES_C[name]
            else:
                self._placed = name
        return_freed_memory()  # of what the scenes before were drawn with

    def show(self, pattern: UInt8Array | None, cell_px: int = 1) -> None:
        """Show 0/1 cells on the screen (0 dark, anything else lit), each `cell_px` screen pixels square, the whole
        centred.

        The rest of the screen is dark. None: all dark. One value per screen pixel with `cell_px=1` is what a page that
        paints its canvas pixel by pixel amounts to. Raises `BenchError` if the pattern is larger than the screen.
        """
        with self._lock:
            serial = self._shown.serial + 1
            if pattern is None:
                self._shown = ShownCells(serial=serial)
                return
            lit = (np.asarray(pattern) != 0).astype(np.uint8)
            if lit.ndim != 2 or lit.shape[0] * cell_px > SCREEN_ROWS or lit.shape[1] * cell_px > SCREEN_COLS:
                raise BenchError(
                    f"a pattern of {lit.shape} cells x {cell_px} px doesn't fit the screen of {SCREEN_ROWS} x "
                    f"{SCREEN_COLS} px"
                )
            self._shown = ShownCells(lit, int(cell_px), serial)

    # --- cameras ----------------------------------------------------------------------------------------------------

    @property
    def temperature_c(self) -> float:
        """Air temperature at the bench: 23 degrees, within 0.1."""
        return AIR_C + 0.1 * float(np.sin(2 * np.pi * (self.clock.now() - self._started_s) / 5400.0))

    def sensor_temperature_c(self, side: Side, at_s: float | None = None) -> float:
        """Temperature of one camera's sensor at a virtual time, None: now, as the camera itself reports it."""
        if self._sensor_c is not None:
            return self._sensor_c
        since_s = (self.clock.now() if at_s is None else at_s) - self._started_s
        warmer = -self._warm_up_c * float(np.expm1(-since_s / WARMING_S))
        return self.temperature_c + SELF_HEATING_C[side] + warmer

    def sensor(self, side: Side) -> tuple[int, int, float]:
        """Return what a camera's own registers say of its sensor: rows and columns of a frame, distance of
        neighbouring pixels (um)."""
        camera = self._truth.cameras[side]
        rows, cols = camera.margins.frame_shape(camera.model.rows, camera.model.cols)
        return rows, cols, camera.model.pixel_pitch_um

    def compile_loops(self) -> None:
        """Those that patterns, charts, moved light and shot noise are drawn with: on a new installation that takes as
        long as a camera's driver waits for its first frame. No frame changes by it."""
        from sim.scene.displace import displace_drawing

        square = np.array([0.0, 0.0, 1.0, 1.0]), np.array([0.0, 1.0, 1.0, 0.0])
        cells(np.ones((2, 2)), SCREEN_POSE.warp(self._truth.cameras["left"]), Grid(4, 4, 1, 0), 0.0)
        quadrilateral(np.arange(2.0), np.arange(2.0), 1.0, *square)
        draw_poisson(np.ones((2, 2), np.float32), np.random.default_rng(0))
        displace_drawing(np.ones((2, 2)), np.zeros((4, 4)), np.zeros((4, 4)), 1)

    def expose(self, side: Side, exposure_s: float, gain_db: float = 0.0, start_s: float | None = None) -> UInt16Array:
        """One raw frame, (rows, cols) DN with the margins, of what stands in front now.

        `start_s`: the virtual time at which it began (a pair triggered together shares it), None: now. Afterwards the
        clock stands at least at the exposure's end.
        """
        if side not in self._truth.cameras:
            raise BenchError(f"no camera {side!r} on this bench: it has {', '.join(self._truth.cameras)}")
        begin_s = self.clock.now() if start_s is None else start_s
        camera, placed_scene, light = self._seen(side)
        source = self._drift(begin_s + 0.5 * exposure_s)
        if side == "right" and not (isinstance(placed_scene, UniformField) and placed_scene.kind != "black"):
            source *= pair_gain_factor(camera.model, camera.acting)
        exposure = Exposure(
            placed_scene,
            exposure_s,
            gain_db,
            self.sensor_temperature_c(side, begin_s + 0.5 * exposure_s),
            elapsed_s=self._elapsed_s(begin_s),
        )
        with self._camera_locks[side]:
            source *= unsteady_source(camera.model, camera.acting, exposure.elapsed_s)
            held = collect_electrons(
                light, camera.model, exposure, camera.acting, source=source, margins=camera.margins
            )
            read, self._kept[side] = read_electrons(held, camera.model, exposure, camera.acting, self._kept[side])
            frame = sample_from(
                read,
                camera.model,
                self._noise[side],
                camera.pattern,
                dark_electrons=dark_electrons(camera.model, exposure, camera.acting, camera.margins),
                gain_db=gain_db,
                read_out=read_out(camera.model, exposure, camera.acting, camera.margins),
            )
        self.clock.sleep_until(begin_s + exposure_s)
        return frame

    def _elapsed_s(self, begin_s: float) -> float:
        """Time since the first exposure, by the clock that the session has."""
        at_s = begin_s if self._session_clock is None else self._session_clock()
        with self._lock:
            if self._first_exposure_s is None:
                self._first_exposure_s = at_s
            return max(at_s - self._first_exposure_s, 0.0)

    def _seen(self, side: Side) -> tuple[HiddenCamera, Scene, SceneLight]:
        """Return a camera as its ring stands, what stands before it now, and the electrons a second that its light
        makes, kept for the scenes seen last."""
        with self._lock:
            placed, light, shown, stop = self._placed, self._light, self._shown, self._stop
            turn_deg, transfers = self._turn_deg, self._transfers[side]
        camera = self._camera(side, stop)
        if not light.shines and placed not in ("cap", "screen"):
            placed, light = "sphere", LightSettings()
        key: tuple[object, ...] = (
            side,
            stop,
            turn_deg,
            placed,
            {"cap": None, "screen": shown.serial}.get(placed, light),
        )
        with self._camera_locks[side]:
            with self._lock:
                kept = self._lights.get(key)
                if kept is not None:
                    self._lights.move_to_end(key)
                    return camera, *kept
            before_camera = scene(camera, placed, light, shown, turn_deg)
            drawn = scene_light(
                camera.model,
                before_camera,
                camera.acting,
                oversample=SCREEN_OVERSAMPLE if isinstance(before_camera, ScreenPattern) else OVERSAMPLE,
                margin_px=MARGIN_PX,
                transfers=transfers,
            )
            with self._lock:
                self._lights[key] = before_camera, drawn
                while len(self._lights) > _MOST_CACHED:
                    self._lights.popitem(last=False)
        if isinstance(before_camera, ScreenPattern):
            return_freed_memory()  # many follow each other, and each takes 200 MB for a moment
        return camera, before_camera, drawn

    def _camera(self, side: Side, stop: str) -> HiddenCamera:
        """Return a camera with its lens at a stop of `STOPS`."""
        hidden = self._truth.cameras[side]
        if stop == NOMINAL_STOP:
            return hidden
        with self._lock:
            if (side, stop) not in self._stopped:
                f_number = STOPS[stop]
                effects = effects_at_f_number(hidden.effects, hidden.model.lens.f_number, f_number)
                model = at_f_number(hidden.model, f_number)
                self._stopped[side, stop] = replace(hidden, model=model, effects=effects)
            return self._stopped[side, stop]

    def _light_rate(self, side: Side) -> FloatArray:
        """Electrons a second that light makes in every pixel."""
        light = self._seen(side)[2]
        return light.scene + light.room

    # --- what a lab knows -------------------------------------------------------------------------------------------

    def station_targets(self) -> dict[str, Any]:
        """`mocks.targets.station_targets` of this bench's cameras."""
        return station_targets(self._truth.cameras)

    def station_cameras(self) -> dict[str, Any]:
        """Return what the maker says of each camera, for `[cameras.left.datasheet]`: the keys of the recording set's
        `Camera`, with `quantum_efficiency.R = {wavelength_nm = [...], value = [...]}` inline."""
        return {side: dict(camera.datasheet) for side, camera in self._truth.cameras.items()}
