"""A reference session of a stereo pair with every kind of capture, drawn by the forward model without any effect.

`visibility.py` derives from it which measurements show each effect. Frames are small, and conditions wide: darks at
three temperatures, flats up and down again, a sweep into the near infrared, edges in several directions, lights, places
and exposures, screens and boards.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

import cv2
import numpy as np

from lab.formats.recording_set import Manifest, RecordingSet
from sim.camera import CameraModel, Geometry, Lens, Side, StereoRig
from sim.frame import Exposure, dark_electrons, expected_electrons, read_out
from sim.scene.scenes import (
    Darkness,
    EdgeRegion,
    KnifeEdge,
    PlanarTarget,
    ReflectanceChart,
    Scene,
    ScreenPattern,
    UniformField,
)
from sim.scene.warp import Warp
from sim.sensor import electrons as sensor
from sim.sensor.margins import NO_MARGINS, Margins
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import electron_rate

ROWS, COLS, PITCH_UM, FOCAL_LENGTH_MM = 240, 320, 4.0, 3.0
WAVELENGTH_NM = np.arange(380.0, 1001.0)
BEGIN = datetime(2026, 3, 2, 9, tzinfo=UTC)
#: Time between captures (s), no multiple of a mains period; and between boards, which move meanwhile.
STEP_S, BOARD_STEP_S = 20.0137, 0.31
DARKS = ((0.001, 25.0), (0.5, 25.0), (2.0, 25.0), (2.0, 35.0), (2.0, 45.0))  # exposure (s), temperature (C)
DARK_AFTER_LIGHT_S = 1.0  # exposure of darks after the flats: what light leaves in the pixels fades in them
LEVELS = (0.05, 0.12, 0.22, 0.35, 0.5, 0.65, 0.8, 0.92)  # share of the full well
ANGLES_DEG = (5.0, 50.0, 95.0, 140.0)
EDGE_SIDE_PX, EDGE_PLACES = (
    120,
    ((0.5, 0.5), (0.25, 0.2)),
)  # side of a region; its middle (row, column), as shares of the frame
DARK_SIDE, SCREEN_BLACK = 0.08, 0.0035  # radiance of an edge's dark side, and of the dark screen, over the lit one
CELL_PX = 4.0  # side of a screen's cells
SCREEN_SAMPLES = 8  # samples a pixel of a screen's drawing: up to 4 cy/px, beyond the cutoff of f/2.8
#: By how much the screen's cells lie right of and below the pixels' borders, px: 1/2 - 1/sqrt(12) of a sample. Cells of
#: a whole number of pixels alias alike all over the frame. Of a drawing by area with s samples a pixel, and borders of
#: cells at the share p of a sample, aliases change an amplitude at f cy/px by 2 (pi f / s)^2 (p^2 - p + 1/6) along each
#: axis. Where p is 0, 3 samples a pixel make the contrast of green pixels 1.5 % too high at 0.3 cy/px. Here p is a root
#: of the polynomial.
SCREEN_OFFSET_PX = (0.5 - 12.0**-0.5) / SCREEN_SAMPLES
TILTS_DEG = (
    (0, 0, 0),
    (30, 0, 3),
    (-30, 0, -4),
    (0, 30, 5),
    (0, -30, 2),
    (20, 20, -6),
    (-20, 20, 4),
    (20, -20, 8),
    (-20, -20, -3),
    (8, -12, 20),
)


def reference_study(
    seed: int = 1,
    camera: CameraModel | None = None,
    *,
    reflectances: tuple[Spectrum, ...] | None = None,
    reading: Callable[[FloatArray], FloatArray] = np.copy,
    margins: Margins = NO_MARGINS,
) -> RecordingSet:
    """Return the recording set of the session, of both sides. `seed`: of its noise and of the random pattern; `camera`:
    on both sides, None: `reference_camera()`. `reflectances`: of the chart's patches, None: the published ones;
    `reading`: what the radiometer reads of a radiance; `margins`: of all frames."""
    rig = _rig(camera or reference_camera())
    frames: dict[str, Any] = {}
    spectra: dict[str, Spectrum] = {}
    captures: list[dict[str, Any]] = []
    checkerboard = np.kron(np.indices((10, 13)).sum(0) % 2, np.ones((6, 6), int)).astype(np.uint8)
    noise = np.zeros((60, 78), np.uint8)
    noise[4:-4, 4:-4] = np.random.default_rng(seed).integers(0, 2, (52, 70))
    targets = {"targets/checkerboard.npy": checkerboard, "targets/bernoulli.npy": noise}
    pair: tuple[tuple[Side, CameraModel], ...] = (("left", rig.left), ("right", rig.right))
    cameras = {}
    for side, own in pair:
        rng = np.random.default_rng([seed, side == "right"])
        drawn = _SideSession(rig, own, side, rng, reflectances, reading, margins)
        drawn.session(targets)
        cameras[side] = drawn.stated()
        frames |= drawn.frames
        spectra |= drawn.spectra
        captures += drawn.captures
    manifest = Manifest.model_validate({"name": "reference study", "cameras": cameras, "captures": captures})
    return RecordingSet(manifest, frames, spectra, targets, source="reference study")


def reference_camera() -> CameraModel:
    """Return a camera with a sensor that sees into the near infrared, so that a grating's second order shows."""

    def curve(peak: float, centre_nm: float, width_nm: float) -> Spectrum:
        visible = np.exp(-0.5 * ((WAVELENGTH_NM - centre_nm) / width_nm) ** 2) + 0.04
        infrared = 0.35 / (1.0 + np.exp((800.0 - WAVELENGTH_NM) / 20.0)) * (1.1 - WAVELENGTH_NM / 1000.0) * 2.0
        return Spectrum.of(WAVELENGTH_NM, np.clip(peak * visible + infrared, 0.0, 0.95))

    focal_px = FOCAL_LENGTH_MM * 1000.0 / PITCH_UM
    matrix = ((focal_px, 0.0, 0.5 * (COLS - 1)), (0.0, focal_px, 0.5 * (ROWS - 1)), (0.0, 0.0, 1.0))
    return CameraModel(
        rows=ROWS, cols=COLS, pixel_pitch_um=PITCH_UM, fill_factor=0.9, cfa="RGGB", bit_depth=12, black_level_dn=64.0,
        white_level_dn=4095.0,
        conversion_gain_dn_per_e=0.38, full_well_e=10500.0, read_noise_e=2.4, dark_current_e_per_s=5.0,
        dark_current_reference_c=25.0,
        dark_current_doubling_c=7.0, dsnu_e=0.8, prnu_percent=0.6,
        quantum_efficiency={"R": curve(0.48, 605.0, 45.0), "G": curve(0.58, 530.0, 38.0), "B": curve(0.52, 455.0,
        33.0)},
        lens=Lens(f_number=4.0, focal_length_mm=FOCAL_LENGTH_MM), geometry=Geometry(camera_matrix=matrix),
    )  # fmt: skip


def _rig(camera: CameraModel) -> StereoRig:
    """Return two cameras 10 mm apart."""
    straight = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    return StereoRig(left=camera, right=camera, rotation=straight, translation_mm=(-10.0, 0.0, 0.0))


def screen_pattern(pattern: np.ndarray, shape: tuple[int, int], light: Spectrum, kind: str) -> ScreenPattern:
    """Return a screen with a pattern of cells (rows, cols), in the middle of a frame of `shape` (rows, cols) px, pixel
    rows along the camera's. `light`: radiance of its lit cells. Drawn with `SCREEN_SAMPLES` a pixel, its image is true
    to 2e-4 of the contrast
    up to 0.45 cy/px at f/4, and to 4e-4 at f/2.8."""
    across, down = (
        0.5 * (pixels - 1 - cells * CELL_PX) + SCREEN_OFFSET_PX
        for pixels, cells in zip(shape[::-1], pattern.shape[::-1], strict=True)
    )
    to_camera = Warp.of(((CELL_PX, 0, across), (0, CELL_PX, down), (0, 0, 1)))
    return ScreenPattern(pattern, to_camera, light.scale(SCREEN_BLACK), light, kind)


class _SideSession:
    """One side's captures, drawn in the order in which a session takes them."""

    def __init__(
        self,
        rig: StereoRig,
        camera: CameraModel,
        side: Side,
        rng: np.random.Generator,
        reflectances: tuple[Spectrum, ...] | None,
        reading: Callable[[FloatArray], FloatArray],
        margins: Margins,
    ) -> None:
        self.margins = margins
        self.rig, self.camera, self.side, self.rng = rig, camera, side, rng
        self.reflectances, self.reading = reflectances, reading
        self.pattern = sensor.FixedPattern.draw(camera, rng).surrounded(margins)
        self.frames: dict[str, Any] = {}
        self.spectra: dict[str, Spectrum] = {}
        self.captures: list[dict[str, Any]] = []
        self.elapsed_s = 0.0
        self.lamp = Spectrum.of(WAVELENGTH_NM, 0.02 * (1.0 + 0.1 * np.sin(WAVELENGTH_NM / 60.0)))

    def stated(self) -> dict[str, Any]:
        """Return the camera's entry in the manifest."""
        names = (
            "rows",
            "cols",
            "pixel_pitch_um",
            "fill_factor",
            "cfa",
            "bit_depth",
            "black_level_dn",
            "white_level_dn",
        )
        curves = {c: self.noted(q) for c, q in self.camera.quantum_efficiency.items()}
        lens = self.camera.lens
        return {name: getattr(self.camera, name) for name in names} | {
            "f_number": lens.f_number,
            "focal_length_mm": lens.focal_length_mm,
            "lens_transmittance": lens.transmittance,
            "quantum_efficiency": curves,
            "margins": self.margins,
        }

    def session(self, targets: dict[str, Any]) -> None:
        """Draw all captures."""
        for exposure_s, temperature_c in DARKS:
            self.take("dark", Darkness(), exposure_s, 3, temperature_c)
        lamp = self.read(self.lamp)
        flat = UniformField(self.lamp)
        full_s = self.exposure_for(self.lamp, 1.0)
        for level in (*LEVELS, *LEVELS[::-1]):
            self.take("flat", flat, level * full_s, 2, radiance=lamp)
        self.take("dark", Darkness(), DARK_AFTER_LIGHT_S, 6)
        self.sweep()
        light = self.lamp.scale(0.3)
        corners = ((30.0, 40.0), (30.0, 280.0), (210.0, 280.0), (210.0, 40.0))
        scene = ReflectanceChart(corners, light, reflectances=self.reflectances)
        self.take(
            "chart",
            scene,
            self.exposure_for(light, 0.7),
            2,
            chart="ColorChecker24",
            corners=corners,
            radiance=self.read(light),
        )
        self.edges()
        self.screen(targets)
        self.boards()

    def sweep(self) -> None:
        """Narrowband light at one exposure, every 20 nm."""
        lines = {
            w: Spectrum.of(WAVELENGTH_NM, 0.004 * np.exp(-0.5 * ((WAVELENGTH_NM - w) / 4.2466) ** 2))
            for w in np.arange(400.0, 981.0, 20.0)
        }
        exposure_s = min(self.exposure_for(light, 0.8) for light in lines.values())
        for w, light in lines.items():
            self.take(
                "narrowband",
                UniformField(light, "narrowband"),
                exposure_s,
                1,
                wavelength_nm=w,
                bandwidth_nm=10.0,
                radiance=self.read(light),
            )

    def edges(self) -> None:
        """White light in the middle and off the axis, narrowband light, and a quarter of the exposure, at four angles
        each."""
        line = {
            w: Spectrum.of(WAVELENGTH_NM, 0.05 * np.exp(-0.5 * ((WAVELENGTH_NM - w) / 4.2466) ** 2))
            for w in (460.0, 640.0)
        }
        lights = [
            (self.lamp, EDGE_PLACES[0]),
            (self.lamp, EDGE_PLACES[1]),
            *((one, EDGE_PLACES[0]) for one in line.values()),
        ]
        for light, (down, across) in [*lights, (self.lamp.scale(4.0), EDGE_PLACES[0])]:
            half = EDGE_SIDE_PX // 2
            row, col = max(int(down * ROWS), half), max(int(across * COLS), half)
            region = (row - half, col - half, row + half, col + half)
            place = (row - 0.5 * ROWS) * PITCH_UM * 1e-3, (col - 0.5 * COLS) * PITCH_UM * 1e-3
            path, exposure_s = self.read(light), self.exposure_for(light, 0.7)
            for angle in ANGLES_DEG:
                scene = KnifeEdge((EdgeRegion(region, angle),), light.scale(DARK_SIDE), light)
                self.take(
                    "slanted_edge",
                    scene,
                    exposure_s,
                    2,
                    region=region,
                    angle_deg=angle,
                    light_radiance=path,
                    field_mm=place,
                )

    def screen(self, targets: dict[str, Any]) -> None:
        """White, black, checkerboard and Bernoulli patterns."""
        light = self.lamp.scale(0.2)
        cells = np.ones((ROWS // int(CELL_PX), COLS // int(CELL_PX)), np.uint8)
        shown = {"white": cells, "black": 0 * cells} | dict(
            zip(("checkerboard", "bernoulli"), targets.values(), strict=True)
        )
        files = dict(zip(("checkerboard", "bernoulli"), targets, strict=True))
        where: dict[str, Any] = {"screen": {"pose": "p0", "cell_camera_px": CELL_PX, "radiance": self.read(light)}}
        exposure_s = self.exposure_for(light, 0.7)
        for kind, pattern in shown.items():
            scene = screen_pattern(pattern, (ROWS, COLS), light, kind)
            more: dict[str, Any] = {"target": files[kind]} if kind in files else {}
            self.take(kind, scene, exposure_s, 3, samples=SCREEN_SAMPLES, **where, **more)

    def boards(self) -> None:
        """A ChArUco board of 6 x 8 squares in ten poses before both cameras."""
        board = cv2.aruco.CharucoBoard((8, 6), 9.0, 6.0, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
        texture = np.asarray(board.generateImage((8 * 18, 6 * 18), marginSize=0, borderBits=1)) / 255.0
        assert self.camera.geometry is not None
        light = self.lamp.scale(0.6)
        focal_px = self.camera.geometry.camera_matrix[0][0]
        distance = 9.0 * 8 / COLS / 0.7 * focal_px
        for k, tilt in enumerate(TILTS_DEG):
            turn = cv2.Rodrigues(np.deg2rad(np.array(tilt, float)))[0]
            middle = np.array(
                [5.0 + 3.0 * ((k * 7) % 5 - 2), 2.0 * ((k * 3) % 5 - 2), distance * (1.1 + 0.03 * (k % 4))]
            )
            corner = middle - turn @ np.array([36.0, 27.0, 0.0])
            target = PlanarTarget(
                texture, 0.5, _matrix(turn), _vector(corner), self.camera.geometry, light.scale(0.05), light, 1.0
            )
            scene = target.pose_for_rig(self.rig)[self.side == "right"]
            self.take("charuco", scene, self.exposure_for(light, 0.6), 1, dictionary="DICT_4X4_50", squares=(6, 8),
            square_mm=9.0,
                      marker_mm=6.0, pose=f"b{k}")  # fmt: skip

    def take(
        self,
        kind: str,
        scene: Scene,
        exposure_s: float,
        repeats: int,
        temperature_c: float = 25.0,
        samples: int = 3,
        **more: Any,
    ) -> None:
        """Draw `repeats` captures of a scene, with `samples` a pixel. `more`: further keys of this kind of capture."""
        exposure = Exposure(scene, exposure_s, temperature_c=temperature_c, placed="image")
        electrons = expected_electrons(self.camera, exposure, oversample=samples, margins=self.margins)
        for _ in range(repeats):
            k = len(self.captures)
            path = f"frames/{self.side}-{k:04d}.npy"
            self.frames[path] = sensor.sample_from(
                electrons, self.camera, self.rng, self.pattern,
                dark_electrons=dark_electrons(self.camera, exposure, (), self.margins), gain_db=0.0,
                read_out=read_out(self.camera, exposure, (), self.margins),
            )  # fmt: skip
            self.captures.append(
                {"id": f"{self.side}-{k:04d}", "kind": kind, "side": self.side, "frame": path, "exposure_s": exposure_s,
                 "temperature_c": temperature_c, "time": (BEGIN + timedelta(seconds=self.elapsed_s)).isoformat(),
                 **more}
            )  # fmt: skip
            self.elapsed_s += BOARD_STEP_S if kind == "charuco" else STEP_S

    def read(self, light: Spectrum) -> str:
        """Store what the radiometer reads of a light; its path in the recording set."""
        wavelength_nm, value = light.arrays
        return self.noted(Spectrum.of(wavelength_nm, self.reading(value)))

    def noted(self, spectrum: Spectrum) -> str:
        """Store a spectrum; its path in the recording set."""
        path = f"spectra/{self.side}-{len(self.spectra):03d}.csv"
        self.spectra[path] = spectrum
        return path

    def exposure_for(self, light: Spectrum, level: float) -> float:
        """Exposure (s) that fills the brightest channel to the share `level` of the full well."""
        return level * self.camera.full_well_e / max(electron_rate(self.camera, c, light) for c in self.camera.channels)


def _matrix(
    turn: FloatArray,
) -> tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]:
    first, second, third = (_vector(row) for row in turn)
    return first, second, third


def _vector(values: FloatArray) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z
