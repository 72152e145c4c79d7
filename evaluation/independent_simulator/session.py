"""Sessions of a concealed camera: which captures it takes, in which order, and the data that come out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from evaluation.independent_simulator.camera import STEP_S, ConcealedCamera
from evaluation.independent_simulator.law import WAVELENGTH_NM, Array
from evaluation.independent_simulator.scenes import TURN_DEG, BoardPose, board, chart, edge, pattern

Lamp = Literal["halogen", "led", "tungsten"]
BEGIN = datetime(2026, 3, 2, 9, tzinfo=UTC)
LINE_SIGMA_NM = 4.2466  # a full width of 10 nm
FLAT_LEVELS = (0.05, 0.12, 0.22, 0.35, 0.5, 0.65, 0.8, 0.92)
EDGE_ANGLES_DEG = (5.0, 95.0, -40.0, 2.6)
BOARD_TILTS_DEG = (
    (0, 0, 0), (35, 0, 3), (-35, 0, -4), (0, 35, 5), (0, -35, 2), (25, 25, -6), (-25, 25, 4), (25, -25, 8), (-25, -25,
    -3), (10, -15, 20),
)  # fmt: skip
DARK_SIDE = 0.08  # of an edge
SCREEN_BLACK = 0.0035  # of its white


@dataclass(frozen=True)
class Plan:
    """Which captures a session takes.

    lights      edges in two narrowband lights, too
    warm        darks at two higher temperatures, too
    dark_again  darks after the flats, too, of an exposure of their own
    shuttle     flats up and down again
    exposures   edges at a quarter of the exposure in four times the light, too
    screen_cell_px, screen_turn_deg   the size of a screen's cells in the camera, and how far the screen is turned
    lamp        of flats, chart and edges; exposures are those of the first lamp at its level
    light       factor on that lamp, chart_light: on the chart's
    longer      factor on the exposures of darks
    chart   maps wavelengths and published reflectances (patches, wavelengths) to the chart's own
    reading maps a light's radiance to what the radiometer reads
    temperature_c   of the sensor, in all captures; None: 25, and those of `warm`
    gain_db     that is stated of the captures
    """

    kinds: tuple[str, ...] = ("dark", "flat", "narrowband", "chart", "slanted_edge", "screen")
    lights: bool = False
    warm: bool = False
    dark_again: bool = False
    shuttle: bool = False
    exposures: bool = False
    repeats: int = 3
    screen_cell_px: float = 4.0
    screen_turn_deg: float = TURN_DEG
    lamp: Lamp = "halogen"
    light: float = 1.0
    chart_light: float = 0.3
    longer: float = 1.0
    temperature_c: float | None = None
    gain_db: float | None = None
    chart: Callable[[Array, Array], Array] | None = None
    reading: Callable[[Array], Array] = np.copy


WHOLE_SESSION = Plan()


@dataclass(frozen=True)
class DrawnSession:
    """What a session hands out, as plain data: the manifest of a recording set (docs/reference/recording-set.md) and
    the files that it names.

    Frames are raw DN, spectra values at WAVELENGTH_NM, targets cells of a screen.
    """

    manifest: dict[str, Any]
    frames: Mapping[str, NDArray[np.uint16]]
    spectra: Mapping[str, NDArray[np.float64]]
    targets: Mapping[str, NDArray[np.uint8]]


def record(camera: ConcealedCamera, plan: Plan = WHOLE_SESSION, name: str = "camera") -> DrawnSession:
    """Take a session. What is requested (exposures, order, names) doesn't depend on the laws."""
    return _Recorder(camera).session(plan, name)


def record_pair(left: ConcealedCamera, right: ConcealedCamera, plan: Plan, name: str = "pair") -> DrawnSession:
    """Both cameras' sessions in one; screen targets are the left one's."""
    one, two = record(left, plan, name), record(right, plan, name)
    manifest = {
        "name": name,
        "cameras": one.manifest["cameras"] | two.manifest["cameras"],
        "captures": [*one.manifest["captures"], *two.manifest["captures"]],
    }
    return DrawnSession(manifest, {**one.frames, **two.frames}, {**one.spectra, **two.spectra}, one.targets)


def lamp(kind: Lamp = "halogen") -> Array:
    """Spectral radiance of the flats, W sr^-1 m^-2 nm^-1: a filtered halogen lamp, a white LED (a line of the chip and
    the phosphor's band), a tungsten filament at 2856 K (Planck)."""
    w = WAVELENGTH_NM
    if kind == "led":
        return 0.05 * (np.exp(-0.5 * ((w - 452) / 10) ** 2) + 0.7 * np.exp(-0.5 * ((w - 570) / 55) ** 2) + 0.01)
    if kind == "tungsten":
        return 0.05 * (560.0 / w) ** 5 * np.expm1(1.4388e7 / (560 * 2856)) / np.expm1(1.4388e7 / (w * 2856))
    return 0.05 * np.exp((w - 560) / 400) * (1 + 0.1 * np.sin(w / 60))


def line(centre_nm: float, peak: Array) -> Array:
    """Return a monochromator's line of 10 nm."""
    return peak * np.exp(-0.5 * ((WAVELENGTH_NM - centre_nm) / LINE_SIGMA_NM) ** 2)


class _Recorder:
    """One camera's captures in the order in which they are taken."""

    def __init__(self, camera: ConcealedCamera) -> None:
        self.camera = camera
        self.prefix = "" if camera.side == "left" else "right-"
        self.frames: dict[str, Any] = {}
        self.spectra: dict[str, Any] = {}
        self.targets: dict[str, Any] = {}
        self.captures: list[dict[str, Any]] = []
        self.plan = WHOLE_SESSION

    def lamp(self) -> Array:
        """Return the plan's lamp. Lamps fill the camera alike, by its stated curves, so that exposures are the same."""
        first, own = lamp("led"), lamp(self.plan.lamp)
        alike = self.camera.nominal_rate(first) / self.camera.nominal_rate(own) if self.plan.lamp == "tungsten" else 1.0
        return self.plan.light * alike * own

    def session(self, plan: Plan, name: str) -> DrawnSession:
        camera, self.plan = self.camera, plan
        curves = {c: self.noted(q) for c, q in camera.stated_efficiency.items()}
        steps = {
            "dark": self.darks, "flat": self.flats, "narrowband": self.sweep, "chart": self.chart,
            "slanted_edge": self.edges,
            "charuco": self.boards, "screen": self.screen,
        }  # fmt: skip
        for kind in plan.kinds:
            steps[kind](plan)
        stated = {
            "rows": camera.rows, "cols": camera.cols, "pixel_pitch_um": camera.pitch_um,
            "fill_factor": camera.fill_factor, "cfa": camera.cfa,
            "bit_depth": camera.bit_depth, "black_level_dn": camera.black_level_dn,
            "white_level_dn": camera.full_code_dn, "f_number": camera.f_number,
            "focal_length_mm": camera.focal_length_mm, "lens_transmittance": camera.lens_transmittance,
            "quantum_efficiency": curves,
        }  # fmt: skip
        manifest = {"name": name, "cameras": {camera.side: stated}, "captures": self.captures}
        return DrawnSession(manifest, self.frames, self.spectra, self.targets)

    def take(
        self, kind: str, images: dict[str, Array] | None, exposure_s: float, repeats: int = 1,
        temperature_c: float = 25.0, **more: Any
    ) -> None:  # fmt: skip
        """Expose and note `repeats` frames; `more`: what this kind of capture states besides."""
        plan = self.plan
        temperature_c = temperature_c if plan.temperature_c is None else plan.temperature_c
        more |= {} if plan.gain_db is None else {"gain_db": plan.gain_db}
        for law in self.camera.laws:
            images = images and {c: image * law.scene_factor(kind) for c, image in images.items()}
        for _ in range(repeats):
            k = len(self.captures)
            path = f"frames/{self.prefix}{k:04d}.npy"
            self.frames[path] = self.camera.expose(images, exposure_s, k, temperature_c)
            when = BEGIN + timedelta(seconds=STEP_S * k)
            self.captures.append(
                {"id": f"{self.prefix}c{k:04d}", "kind": kind, "side": self.camera.side, "frame": path,
                "exposure_s": exposure_s,
                 "temperature_c": temperature_c, "time": when.isoformat(), **more}
            )  # fmt: skip

    def read(self, light: Array) -> str:
        """Return the file in which the radiometer's reading of a light is kept."""
        return self.noted(self.plan.reading(light))

    def noted(self, spectrum: Array) -> str:
        """Return the file in which a spectrum is kept: a reading of the radiometer, or a stated curve."""
        path = f"spectra/{self.prefix}{len(self.spectra):03d}.csv"
        self.spectra[path] = spectrum
        return path

    def darks(self, plan: Plan) -> None:
        for exposure_s in (0.001, 0.5, 2.0):
            self.take("dark", None, plan.longer * exposure_s, max(plan.repeats, 3))
        for warmer_c in (35.0, 45.0) if plan.warm else ():
            self.take("dark", None, plan.longer * 2.0, max(plan.repeats, 3), warmer_c)

    def flats(self, plan: Plan) -> None:
        light = self.lamp()
        path, images = self.read(light), self.camera.uniform(light)
        levels = (*FLAT_LEVELS, *FLAT_LEVELS[::-1]) if plan.shuttle else FLAT_LEVELS
        repeats = 2 if plan.shuttle else max(plan.repeats, 3)
        for level in levels:
            self.take("flat", images, self.camera.exposure_for(light, level), repeats, radiance=path)
        if plan.dark_again:
            self.take("dark", None, plan.longer * 1.0, 6)

    def sweep(self, plan: Plan) -> None:
        def light(centre_nm: float) -> Array:
            return line(centre_nm, 0.004 * np.exp((centre_nm - 560) / 300))

        exposure_s = min(self.camera.exposure_for(light(w), 0.8) for w in range(400, 721, 20))
        for w in range(400, 721, 10):
            images = self.camera.uniform(light(w), "narrowband")
            path = self.read(light(w))
            self.take("narrowband", images, exposure_s, wavelength_nm=w, bandwidth_nm=10, radiance=path)

    def chart(self, plan: Plan) -> None:
        camera, light = self.camera, plan.chart_light * self.lamp()
        box = round(0.14 * camera.rows), round(0.12 * camera.cols), round(0.86 * camera.rows), round(0.88 * camera.cols)
        row0, col0, row1, col1 = box
        corners = [[row0, col0], [row0, col1], [row1, col1], [row1, col0]]
        images, exposure_s = chart(camera, light, box, plan.chart), camera.exposure_for(0.9 * light, 0.8)
        path = self.read(light)
        self.take("chart", images, exposure_s, 2, chart="ColorChecker24", corners=corners, radiance=path)

    def edges(self, plan: Plan) -> None:
        camera, light = self.camera, self.lamp()
        half = min(100, min(camera.rows, camera.cols) // 2 - 4)
        region = [camera.rows // 2 - half, camera.cols // 2 - half, camera.rows // 2 + half, camera.cols // 2 + half]
        lights = [light]
        if plan.lights:
            lights += [line(w, 0.05) for w in (460.0, 640.0)]
        if plan.exposures:
            lights += [4.0 * light]
        for light in lights:
            path, exposure_s = self.read(light), camera.exposure_for(light, 0.8)
            for angle in EDGE_ANGLES_DEG:
                self.take("slanted_edge", edge(camera, angle, light, DARK_SIDE), exposure_s, 2, region=region,
                angle_deg=angle,
                          light_radiance=path, field_mm=[0.0, 0.0])  # fmt: skip

    def boards(self, plan: Plan) -> None:
        """A ChArUco board of 6 x 8 squares of 9 mm in ten poses, tilted to all sides."""
        camera = self.camera
        charuco = cv2.aruco.CharucoBoard((8, 6), 9.0, 6.0, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
        texture = np.asarray(charuco.generateImage((8 * 18, 6 * 18), marginSize=0, borderBits=1)) / 255.0
        light = 0.6 * lamp()
        # at this distance the board covers three quarters of the frame
        distance = 9.0 * max(8 / camera.cols, 6 / camera.rows) / 0.75 * camera.focal_length_px
        x = 0.1 * distance * camera.cols / camera.focal_length_px
        y = 0.1 * distance * camera.rows / camera.focal_length_px
        for k, tilt in enumerate(BOARD_TILTS_DEG):
            centre = (x * ((k * 7) % 5 - 2) / 2, y * ((k * 3) % 5 - 2) / 2, distance * (1 + 0.03 * (k % 4)))
            if camera.pair_middle_mm:
                centre = (centre[0] + camera.pair_middle_mm, centre[1], centre[2])
            images = board(camera, texture, 0.5, BoardPose(centre, tilt), light)
            self.take("charuco", images, camera.exposure_for(light, 0.7), dictionary="DICT_4X4_50", squares=[6, 8],
                      square_mm=9.0, marker_mm=6.0, pose=f"b{k}")  # fmt: skip

    def screen(self, plan: Plan) -> None:
        """White, black, a checkerboard and Bernoulli noise on a screen."""
        camera, light = self.camera, 0.1 * lamp()
        path = self.read(light)
        checkerboard = np.kron(np.indices((10, 13)).sum(0) % 2, np.ones((8, 8), int)).astype(np.uint8)
        noise = np.zeros((80, 104), np.uint8)
        noise[4:-4, 4:-4] = np.random.default_rng([camera.seed, 4]).integers(0, 2, (72, 96))
        exposure_s = camera.exposure_for(light, 0.8)
        as_placed = plan.screen_cell_px, plan.screen_turn_deg
        where: Any = {"screen": {"pose": "p0", "cell_camera_px": plan.screen_cell_px, "radiance": path}}
        self.take("white", pattern(camera, np.ones((80, 104)), light, SCREEN_BLACK, *as_placed), exposure_s, 3, **where)
        self.take(
            "black", pattern(camera, np.zeros((80, 104)), light, SCREEN_BLACK, *as_placed), exposure_s, 3, **where
        )
        self.targets |= {"targets/0.npy": checkerboard, "targets/1.npy": noise}
        for kind, (file, target) in zip(("checkerboard", "bernoulli"), self.targets.items(), strict=True):
            self.take(
                kind, pattern(camera, target, light, SCREEN_BLACK, *as_placed), exposure_s, 3, target=file, **where
            )
