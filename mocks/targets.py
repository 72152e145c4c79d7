"""The targets before the cameras, as scenes of the forward model; and where a lab would expect them in the frames.

A target is flat and stands at a `Pose` in the rig's frame; each camera sees it in perspective and through its lens's
distortion."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mocks.conceal import SIDES
from mocks.light_path import WAVELENGTH_NM, LightSettings, screen_radiance, sphere_radiance
from mocks.truth import DISTANCE_MM, HiddenCamera
from sim.camera import Side
from sim.scene import (
    Darkness,
    PlanarTarget,
    PlaneEdge,
    PosedEdges,
    ReflectanceChart,
    Scene,
    ScreenPattern,
    UniformField,
    Warp,
)
from sim.scene.scenes import Corners
from sim.scene.warp import Matrix
from sim.spectrum import FloatArray, Spectrum

UInt8Array = NDArray[np.uint8]

#: The screen: rows, columns, distance of neighbouring pixels.
SCREEN_ROWS, SCREEN_COLS, SCREEN_PITCH_MM = 1080, 1920, 0.225
#: What a knife edge's dark side, the screen's dark pixels and a board's black send back of the light.
BLADE_REFLECTANCE, SCREEN_BLACK, BOARD_BLACK, BOARD_WHITE = 0.02, 0.0015, 0.04, 0.88

#: The ColorChecker: distance of neighbouring patches, and the share of it that is frame.
CHART_PITCH_MM, CHART_GAP = 36.0, 0.13

#: Knife-edge targets: nominal angle of the edge from the vertical; each has an edge in three places of the field,
#: [rows, columns] from its centre in heights of the frame.
EDGE_ANGLES_DEG = {"edge-1": 5.2, "edge-2": 94.8, "edge-3": 41.0, "edge-4": -37.0}
EDGE_PLACES = {"centre": (0.0, 0.0), "mid": (-110.0 / 480, -165.0 / 480), "corner": (158.0 / 480, 228.0 / 480)}
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

#: The stops of the lenses' aperture rings, which the operator turns; and the one at which they stand.
STOPS, NOMINAL_STOP = {"f/4": 4.0, "f/5.6": 5.6, "f/8": 8.0}, "f/4"

#: Turns of the knife edges' holder about its middle (deg, the top to the right), and temperatures (C) of both sensors,
#: as the operator sets them by hand; None: as they are.
TURNS_DEG, TEMPERATURES_C = (
    {"turn 0": 0.0, "turn 45": 45.0, "turn 90": 90.0},
    {"usual": None, "35 C": 35.0, "45 C": 45.0},
)

#: Lights of the light source, as a lab mixes them: shares of its LEDs' most by nominal wavelength (nm), those of a
#: colour temperature (K) with the chromaticity of a black body to within 100 K.
MIXES: dict[float, dict[int, float]] = {
    3000.0: {460: 0.14, 550: 0.90, 635: 0.78},
    4500.0: {460: 0.30, 550: 0.90, 635: 0.46},
    6500.0: {460: 0.46, 550: 0.90, 635: 0.30},
}
SINGLE_LEDS_NM = (460, 525, 635)

#: Names of all targets.
TARGETS = (
    *("cap", "sphere", "colorchecker", *EDGE_ANGLES_DEG, "screen", *BOARD_POSES),
    *(*STOPS, *TURNS_DEG, *TEMPERATURES_C),
)


@dataclass(frozen=True, eq=False)
class Pose:
    """Where a flat target stands: its point X (mm, z = 0) is at `rotation` X + `centre_mm` in the rig's frame."""

    rotation: FloatArray
    centre_mm: FloatArray

    @classmethod
    def of(cls, centre_mm: tuple[float, float, float], euler_xyz_deg: tuple[float, float, float]) -> Pose:
        """Return a pose from the place of the target's origin and its turns about its own x, y and z."""
        return cls(Rotation.from_euler("XYZ", euler_xyz_deg, degrees=True).as_matrix(), np.array(centre_mm))

    def before(
        self, camera: HiddenCamera, origin_mm: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[Matrix, tuple[float, float, float]]:
        """Return (rotation, translation_mm) of the same plane in the camera's frame, from `origin_mm` [x, y] on."""
        corner = self.rotation @ np.array([*origin_mm, 0.0]) + self.centre_mm - camera.centre_mm
        first, second, third = ((float(a), float(b), float(c)) for a, b, c in camera.rotation @ self.rotation)
        x, y, z = (float(v) for v in camera.rotation @ corner)
        return (first, second, third), (x, y, z)

    def warp(self, camera: HiddenCamera, unit_mm: float = 1.0, origin_mm: tuple[float, float] = (0.0, 0.0)) -> Warp:
        """Return the warp from the target's plane to the camera's px: u, v in units of `unit_mm` from `origin_mm` [x,
        y].
        """
        rotation, translation_mm = self.before(camera, origin_mm)
        turn = np.asarray(rotation)
        plane = np.column_stack([turn[:, 0] * unit_mm, turn[:, 1] * unit_mm, translation_mm])
        return Warp.of(np.asarray(camera.geometry.camera_matrix) @ plane, camera.geometry)


_CHART = Pose.of((-103.0, -70.0, DISTANCE_MM), (0.0, 0.0, 0.7))
SCREEN_POSE = Pose.of((1.7, -0.9, DISTANCE_MM), (0.3, -0.4, 0.5))


@dataclass(frozen=True, eq=False)
class ShownCells:
    """What the display shows: 0/1 cells, each `cell_px` screen pixels wide, centred; None: all dark."""

    pattern: UInt8Array | None = None
    cell_px: int = 1
    serial: int = 0

    def origin_px(self) -> tuple[int, int]:
        """Return row and column of the screen pixel at which the pattern begins."""
        rows, cols = (0, 0) if self.pattern is None else self.pattern.shape
        return (SCREEN_ROWS - rows * self.cell_px) // 2, (SCREEN_COLS - cols * self.cell_px) // 2

    def lit_share(self) -> float:
        """Return the share of lit pixels in a spot of 10 mm at the screen's centre."""
        half = round(5.0 / SCREEN_PITCH_MM)
        if self.pattern is None:
            return 0.0
        share = []
        for origin, middle, count in zip(
            self.origin_px(), (SCREEN_ROWS // 2, SCREEN_COLS // 2), self.pattern.shape, strict=True
        ):
            cell = (np.arange(middle - half, middle + half) - origin) // self.cell_px
            share.append((cell, (cell >= 0) & (cell < count)))
        (rows, rows_in), (cols, cols_in) = share
        lit = self.pattern[np.ix_(rows[rows_in], cols[cols_in])].sum()
        return float(lit) / (rows.size * cols.size)


@cache
def _board_texture() -> FloatArray:
    """Return the ChArUco board as it is printed, with a white rim of one square: 0..1, `_TEXEL_MM` a sample."""
    rows, cols = BOARD_SQUARES
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, BOARD_DICTIONARY))
    board = cv2.aruco.CharucoBoard((cols, rows), SQUARE_MM, MARKER_MM, dictionary)
    rim = round(SQUARE_MM / _TEXEL_MM)
    size = (cols + 2) * rim, (rows + 2) * rim
    return np.asarray(board.generateImage(size, marginSize=rim), float) / 255.0


def board_pose(name: str) -> Pose:
    """Return where a ChArUco pose's board stands; its plane's origin is the board's centre.

    name : of `BOARD_POSES`

    >>> isinstance(board_pose(next(iter(BOARD_POSES))), Pose)
    True
    """
    (x, y, z), turns = BOARD_POSES[name]
    return Pose.of((float(x), float(y), DISTANCE_MM + z), turns)


def mm_per_px(camera: HiddenCamera) -> float:
    """Return the size of a pixel at the targets' distance, by the data sheet."""
    return float(DISTANCE_MM * camera.model.pixel_pitch_um * 1e-3 / camera.model.lens.known_focal_length_mm)


def _edges(name: str, camera: HiddenCamera) -> tuple[PlaneEdge, ...]:
    """Return the edges of one knife-edge target, each a little off the middle of its place, as blades are."""
    scale = mm_per_px(camera)
    off = {"centre": (0.31, -0.52), "mid": (-0.77, 0.28), "corner": (0.55, 0.93)}
    targets = []
    for place, share in EDGE_PLACES.items():
        down, across = (camera.model.rows * part for part in share)
        centre = across * scale, down * scale
        through = (across + off[place][0]) * scale, (down + off[place][1]) * scale
        targets.append(PlaneEdge(centre, through, EDGE_ANGLES_DEG[name] + 0.15))
    return tuple(targets)


def scene(camera: HiddenCamera, placed: str, light: LightSettings, shown: ShownCells, turn_deg: float = 0.0) -> Scene:
    """Return what one camera sees of a target: its light is what the lamp and the monochromator give when nothing is
    wrong. `turn_deg`: of the knife edges' holder.

    First-order light is of the kind "narrowband" on every target: what goes wrong in a monochromator does so whatever
    it lights."""
    if placed == "cap":
        return Darkness()
    if placed == "screen":
        return _screen(camera, shown)
    radiance = sphere_radiance(light, WAVELENGTH_NM)

    def shine(share: float) -> Spectrum:
        return Spectrum.of(WAVELENGTH_NM, radiance * share)

    def kind(of_target: str) -> str:
        return "narrowband" if light.first_order else of_target

    if placed == "colorchecker":
        pinhole = Warp(_CHART.warp(camera, CHART_PITCH_MM).homography)
        (a, b), (c, d), (e, f), (g, h) = corners_px(pinhole, 6.0 - CHART_GAP, 4.0 - CHART_GAP).tolist()
        corners: Corners = (a, b), (c, d), (e, f), (g, h)
        return ReflectanceChart(corners, shine(1.0), gap=CHART_GAP, kind=kind("chart"), geometry=camera.geometry)
    if placed in EDGE_ANGLES_DEG:
        pose = Pose.of((0.0, 0.0, DISTANCE_MM), (0.0, 0.0, turn_deg)).before(camera)
        lights = shine(BLADE_REFLECTANCE), shine(1.0)
        return PosedEdges(_edges(placed, camera), *pose, camera.geometry, *lights, kind=kind("slanted_edge"))
    if placed in BOARD_POSES:
        rows, cols = BOARD_SQUARES
        pose = board_pose(placed).before(camera, (-(cols / 2 + 1) * SQUARE_MM, -(rows / 2 + 1) * SQUARE_MM))
        lights = shine(BOARD_BLACK), shine(BOARD_WHITE)
        return PlanarTarget(
            _board_texture(), _TEXEL_MM, *pose, camera.geometry, *lights, surround=1.0, kind=kind("charuco")
        )
    return UniformField(shine(1.0), kind=kind("flat"))


def _screen(camera: HiddenCamera, shown: ShownCells) -> Scene:
    white = screen_radiance(WAVELENGTH_NM)
    dark, lit = Spectrum.of(WAVELENGTH_NM, white * SCREEN_BLACK), Spectrum.of(WAVELENGTH_NM, white)
    if shown.pattern is None:
        return UniformField(dark, kind="black")
    row, col = shown.origin_px()
    corner = (col - SCREEN_COLS / 2) * SCREEN_PITCH_MM, (row - SCREEN_ROWS / 2) * SCREEN_PITCH_MM
    warp = SCREEN_POSE.warp(camera, SCREEN_PITCH_MM * shown.cell_px, corner)
    kind = "white" if np.all(shown.pattern) else "bernoulli"
    return ScreenPattern(shown.pattern.astype(float), warp, dark, lit, kind=kind)


def corners_px(warp: Warp, width: float, height: float) -> FloatArray:
    """Return [row, col] of the corners (0, 0), (width, 0), (width, height), (0, height) of a target's plane, px.

    warp : from the plane to the camera's px
    width, height : of the target, in the plane's unit
    """
    row, col = warp.to_camera(np.array([0.0, width, width, 0.0]), np.array([0.0, 0.0, height, height]))
    return np.stack([row, col], axis=1)


def station_targets(cameras: Mapping[Side, HiddenCamera]) -> dict[str, Any]:
    """Return the nominal layout of the targets in the frames, for the station file's `[targets]`: as good as a hand
    that places them and an eye that reads them off a first picture (corners to half a pixel, regions to the pixel).
    Keys by target:

    - all: `kind` ("cap" "sphere" "colorchecker" "slanted_edge" "screen" "charuco" "aperture" "turn" ...)
    - colorchecker: `chart`; `[targets.colorchecker.left]` `corners` (4 x [row, col], as in the recording set)
    - edge-N: `angle_deg`; `[[targets."edge-1".left.regions]]` `name` ("centre" "mid" "corner"), `region`
      [row0, col0, row1, col1], `angle_deg`, `field_mm` [row, col]
    - screen: `rows`, `cols`, `pixel_mm`; `[targets.screen.left]` `camera_px_per_screen_px`,
      `visible` [row0, col0, row1, col1] in screen pixels (what surely lies inside the frame)
    - f/N: `f_number`; turn N: `angle_deg`; N C: `sensor_c`
    - charuco-NN: `dictionary`, `squares` [rows, cols], `square_mm`, `marker_mm`, `pose`
    """

    def by_side(layout: Callable[[HiddenCamera], dict[str, Any]]) -> dict[str, Any]:
        return {side: layout(cameras[side]) for side in SIDES}

    targets: dict[str, Any] = {"cap": {"kind": "cap"}, "sphere": {"kind": "sphere"}}
    targets["colorchecker"] = {"kind": "colorchecker", "chart": "ColorChecker24"} | by_side(_chart_layout)
    for name, angle_deg in EDGE_ANGLES_DEG.items():
        targets[name] = {"kind": "slanted_edge", "angle_deg": angle_deg} | by_side(partial(_edge_layout, name))
    targets["screen"] = {
        "kind": "screen",
        "rows": SCREEN_ROWS,
        "cols": SCREEN_COLS,
        "pixel_mm": SCREEN_PITCH_MM,
    } | by_side(_screen_layout)
    for name in BOARD_POSES:
        targets[name] = {
            "kind": "charuco",
            "dictionary": BOARD_DICTIONARY,
            "squares": list(BOARD_SQUARES),
            "square_mm": SQUARE_MM,
            "marker_mm": MARKER_MM,
            "pose": name,
        }
    for name, f_number in STOPS.items():
        targets[name] = {"kind": "aperture", "f_number": f_number}
    targets |= {name: {"kind": "turn", "angle_deg": angle_deg} for name, angle_deg in TURNS_DEG.items()}
    for name, sensor_c in TEMPERATURES_C.items():
        targets[name] = {"kind": "sensor_temperature"} | ({} if sensor_c is None else {"sensor_c": sensor_c})
    return targets


def station_lights() -> dict[str, Any]:
    """Return the lights of the light source by name, for the station file's `[light_source.lights]`: `channels`, and
    `colour_temperature_k` or `wavelength_nm`."""
    white = {
        f"{kelvin:g} K": {
            "colour_temperature_k": kelvin,
            "channels": {str(nm): share for nm, share in mix.items()},
        }
        for kelvin, mix in MIXES.items()
    }
    return white | {f"{nm} nm": {"wavelength_nm": float(nm), "channels": {str(nm): 1.0}} for nm in SINGLE_LEDS_NM}


def _chart_layout(camera: HiddenCamera) -> dict[str, Any]:
    corners = corners_px(_CHART.warp(camera, CHART_PITCH_MM), 6.0 - CHART_GAP, 4.0 - CHART_GAP)
    return {"corners": (np.round(corners * 2.0) / 2.0).tolist()}


def _edge_layout(name: str, camera: HiddenCamera) -> dict[str, Any]:
    regions = []
    model = camera.model
    for place, share in EDGE_PLACES.items():
        down_px, across_px = (model.rows * part for part in share)
        row, col = (model.rows - 1) / 2 + down_px, (model.cols - 1) / 2 + across_px
        half = EDGE_REGION_PX // 2
        top, left = round(row) - half, round(col) - half
        regions.append(
            {
                "name": place,
                "region": [top, left, top + 2 * half, left + 2 * half],
                "angle_deg": EDGE_ANGLES_DEG[name],
                "field_mm": [round(px * model.pixel_pitch_um * 1e-3, 4) for px in (down_px, across_px)],
            }
        )
    return {"regions": regions}


def _screen_layout(camera: HiddenCamera) -> dict[str, Any]:
    model = camera.model
    corner = -SCREEN_COLS / 2 * SCREEN_PITCH_MM, -SCREEN_ROWS / 2 * SCREEN_PITCH_MM
    warp = SCREEN_POSE.warp(camera, SCREEN_PITCH_MM, corner)
    edge = np.array([12.0, model.rows - 13.0, 12.0, model.cols - 13.0])
    u, v = warp.to_pattern(np.repeat(edge[:2], 2), np.tile(edge[2:], 2))
    visible = [max(v[0], v[1]), max(u[0], u[2]), min(v[2], v[3]), min(u[1], u[3])]
    return {
        "camera_px_per_screen_px": round(SCREEN_PITCH_MM / mm_per_px(camera), 3),
        "visible": [int(np.ceil(value / 2)) * 2 if k < 2 else int(value // 2) * 2 for k, value in enumerate(visible)],
    }
