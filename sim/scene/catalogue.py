"""The named scenes: one declaration each, read by the command line and the documentation.

Sizes are in px of an ideal pinhole camera perpendicular to a plane (`View`). What the lens then does, distortion
included, is a property of the lens.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, ClassVar, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from sim.camera import CameraModel, Geometry
from sim.extensions import refuse
from sim.parameters import Frozen, Quantity, read_quantities
from sim.scene import colorchecker
from sim.scene.chart import PatchChart, added_charts
from sim.scene.light import luminance_cd_m2, screen
from sim.scene.scenes import (
    EdgeRegion,
    KnifeEdge,
    PlanarTarget,
    PointArray,
    Ramp,
    ReflectanceChart,
    Scene,
    ScreenImage,
    ScreenPattern,
    SiemensStar,
    SpectralImage,
    UniformField,
    ZonePlate,
)
from sim.scene.screen import SubPixels
from sim.scene.warp import Warp
from sim.spectrum import Spectrum

UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class View:
    """How an ideal pinhole camera focused at `distance_mm` sees a plane there: m = f / (distance - f), image distance f
    (1 + m).
    """

    rows: int
    cols: int
    pixel_pitch_um: float
    focal_length_mm: float
    distance_mm: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.distance_mm) and self.distance_mm > self.focal_length_mm):
            raise ValueError(
                f"distance {self.distance_mm} mm is not above the limit of the focal length, {self.focal_length_mm:g} "
                "mm, or not finite: put the scene farther away"
            )

    @classmethod
    def of(cls, camera: CameraModel, distance_mm: float) -> Self:
        """Return the view of a camera, whatever its lens's distortion. Raises ValueError where nobody says the focal
        length."""
        focal_mm = camera.lens.known_focal_length_mm
        return cls(camera.rows, camera.cols, camera.pixel_pitch_um, focal_mm, distance_mm)

    @property
    def magnification(self) -> float:
        """Size of the image over that of the object, above 0."""
        return self.focal_length_mm / (self.distance_mm - self.focal_length_mm)

    @property
    def px_per_mm(self) -> float:
        """Camera px per mm of the scene's plane."""
        return 1e3 * self.magnification / self.pixel_pitch_um

    @property
    def centre(self) -> tuple[float, float]:
        """[row, col] of the frame's centre, on the optical axis."""
        return 0.5 * (self.rows - 1), 0.5 * (self.cols - 1)

    @property
    def geometry(self) -> Geometry:
        """The pinhole camera in OpenCV's form."""
        focal_px = 1e3 * self.focal_length_mm * (1.0 + self.magnification) / self.pixel_pitch_um
        row, col = self.centre
        return Geometry(camera_matrix=((focal_px, 0.0, col), (0.0, focal_px, row), (0.0, 0.0, 1.0)))

    def centre_pattern(self, rows: float, cols: float, cell_px: float) -> Warp:
        """Return a pattern of rows x cols cells of `cell_px`, centred in the frame."""
        row, col = self.centre
        return Warp.of(
            [(cell_px, 0.0, col - 0.5 * cols * cell_px), (0.0, cell_px, row - 0.5 * rows * cell_px), (0.0, 0.0, 1.0)]
        )

    def cell_px_to_fill(self, rows: int, cols: int) -> float:
        """Return the cell's size at which a pattern of rows x cols just fits into the frame."""
        return min(self.rows / rows, self.cols / cols)

    def corner_mm(self, rows: float, cols: float, cell_px: float) -> tuple[float, float, float]:
        """Position of the upper left corner of such a pattern in the camera's frame (x to the right, y down, z
        away).
        """
        cell_mm = cell_px / self.px_per_mm
        return -0.5 * cols * cell_mm, -0.5 * rows * cell_mm, self.distance_mm


class Declared(Frozen):
    """Base class of all declarations: a subclass's fields are its parameters, each with its `Quantity`."""

    name: ClassVar[str]
    shows: ClassVar[str]

    @classmethod
    def quantities(cls) -> dict[str, Quantity]:
        """Return the declared parameters, by field name."""
        return read_quantities(cls)

    @classmethod
    def choose(cls, parameters: Mapping[str, object] | None) -> Self:
        """Return the declaration with some parameters set. Raises ValueError, in one line, for an unknown one or a
        value outside its bounds.
        """
        try:
            return cls.model_validate(dict(parameters or {}))
        except ValidationError as error:
            problem = error.errors(include_url=False)[0]
            where = ".".join(str(part) for part in problem["loc"])
            if problem["type"] == "extra_forbidden":
                raise ValueError(
                    f"scene {cls.name} has no parameter {where!r}: it has {', '.join(cls.model_fields) or 'none'}"
                ) from None
            raise ValueError(f"scene {cls.name}: {where}: {problem['msg'].removeprefix('Value error, ')}") from None


class NamedScene(Declared):
    """A scene that is defined by a name and its parameters."""

    def place(self, view: View, white: Spectrum) -> Scene:
        """Return the scene before a camera. `white`: radiance of a perfect white diffuser at the scene, or of full
        light."""
        raise NotImplementedError


Contrast = Annotated[float, Quantity("1", "Michelson contrast, (light - dark) / (light + dark)", lower=0.0, upper=1.0)]
Angle = Annotated[float, Quantity("deg", "angle from the vertical, positive turns the top to the right")]
Cell = Annotated[float, Quantity("px", "a cell's side on the camera", lower=0.1)]


def _dark(white: Spectrum, contrast: float) -> Spectrum:
    return white.scale((1.0 - contrast) / (1.0 + contrast))


class UniformScene(NamedScene):
    name: ClassVar[str] = "uniform"
    shows: ClassVar[str] = "even light that fills the frame"

    def place(self, view: View, white: Spectrum) -> Scene:
        return UniformField(white)


Gap = Annotated[
    float, Quantity("1", "share of the patches' distance that the frame between them takes", lower=0.0, upper=0.9)
]


class _Chart(NamedScene):
    chart: ClassVar[str]
    fill: Annotated[
        float, Quantity("1", "the patch grid's size over the largest that fits into the frame", lower=0.05, upper=4.0)
    ] = 0.9
    gap: Gap = 0.13

    def place(self, view: View, white: Spectrum) -> Scene:
        rows, cols = (n - self.gap for n in colorchecker.grid(self.chart))
        cell = self.fill * min(view.rows / rows, view.cols / cols)
        row, col = view.centre_pattern(rows, cols, cell).to_camera([0.0, cols, cols, 0.0], [0.0, 0.0, rows, rows])
        a, b, c, d = zip(row.tolist(), col.tolist(), strict=True)
        return ReflectanceChart((a, b, c, d), white, self.chart, self.gap)


class ColorChecker24(_Chart):
    name: ClassVar[str] = "colorchecker24"
    shows: ClassVar[str] = "the ColorChecker's 24 patches, measured reflectances"
    chart: ClassVar[str] = "ColorChecker24"


class ColorCheckerSG(_Chart):
    name: ClassVar[str] = "colorchecker-sg"
    shows: ClassVar[str] = "the Digital ColorChecker SG's 140 patches, reflectances recovered from published colours"
    chart: ClassVar[str] = "ColorCheckerSG"


class SlantedEdge(NamedScene):
    name: ClassVar[str] = "slanted-edge"
    shows: ClassVar[str] = "one straight edge through the frame's middle, exact at any angle"
    angle_deg: Angle = 5.0
    contrast: Contrast = 0.6
    offset_px: Annotated[float, Quantity("px", "distance of the edge from the frame's middle, to the dark side")] = 0.0

    def place(self, view: View, white: Spectrum) -> Scene:
        region = EdgeRegion((0, 0, view.rows, view.cols), self.angle_deg, self.offset_px)
        return KnifeEdge((region,), _dark(white, self.contrast), white)


class Checkerboard(NamedScene):
    name: ClassVar[str] = "checkerboard"
    shows: ClassVar[str] = "squares, dark and light by turns"
    cell_px: Cell = 32.0
    contrast: Contrast = 1.0

    def place(self, view: View, white: Spectrum) -> Scene:
        rows, cols = _cells_to_cover(view, self.cell_px)
        pattern = (np.add.outer(np.arange(rows), np.arange(cols)) % 2).astype(np.uint8)
        warp = view.centre_pattern(rows, cols, self.cell_px)
        return ScreenPattern(pattern, warp, _dark(white, self.contrast), white, "checkerboard")


class Bernoulli(NamedScene):
    name: ClassVar[str] = "bernoulli"
    shows: ClassVar[str] = "square cells, dark or light at random with equal chance"
    cell_px: Cell = 2.0
    contrast: Contrast = 1.0
    pattern_seed: Annotated[int, Quantity("1", "seed of the pattern's random numbers", lower=0)] = 1

    def place(self, view: View, white: Spectrum) -> Scene:
        rows, cols = _cells_to_cover(view, self.cell_px)
        pattern = np.random.default_rng(self.pattern_seed).integers(0, 2, (rows, cols), dtype=np.uint8)
        warp = view.centre_pattern(rows, cols, self.cell_px)
        return ScreenPattern(pattern, warp, _dark(white, self.contrast), white, "bernoulli")


class ZonePlateScene(NamedScene):
    name: ClassVar[str] = "zone-plate"
    shows: ClassVar[str] = "rings whose frequency rises in proportion to the distance from the middle"
    highest_cy_per_px: Annotated[
        float, Quantity("cy/px", "local frequency at the rim; drawing takes twice as many samples a pixel", lower=1e-3)
    ] = 0.6
    fill: Annotated[
        float, Quantity("1", "the plate's diameter over the frame's shorter side", lower=0.01, upper=4.0)
    ] = 1.0
    contrast: Contrast = 1.0

    def place(self, view: View, white: Spectrum) -> Scene:
        radius = 0.5 * self.fill * min(view.rows, view.cols)
        return ZonePlate(view.centre, radius, self.highest_cy_per_px, _dark(white, self.contrast), white)


class SiemensStarScene(NamedScene):
    name: ClassVar[str] = "siemens-star"
    shows: ClassVar[str] = "spokes from the frame's middle"
    spokes: Annotated[int, Quantity("1", "number of light spokes", lower=2, upper=1000)] = 36
    fill: Annotated[
        float, Quantity("1", "the star's diameter over the frame's shorter side", lower=0.01, upper=4.0)
    ] = 0.95
    contrast: Contrast = 1.0

    def place(self, view: View, white: Spectrum) -> Scene:
        radius = 0.5 * self.fill * min(view.rows, view.cols)
        return SiemensStar(view.centre, radius, self.spokes, _dark(white, self.contrast), white)


class RampScene(NamedScene):
    name: ClassVar[str] = "ramp"
    shows: ClassVar[str] = "light that rises across the frame, evenly or in steps"
    steps: Annotated[int, Quantity("1", "number of equal steps; 0: linear", lower=0, upper=4096)] = 0
    angle_deg: Annotated[float, Quantity("deg", "where it rises to; 0 right, 90 down")] = 0.0
    contrast: Contrast = 1.0

    def place(self, view: View, white: Spectrum) -> Scene:
        angle = np.deg2rad(self.angle_deg)
        length = view.cols * abs(np.cos(angle)) + view.rows * abs(np.sin(angle))
        return Ramp(view.centre, float(length), _dark(white, self.contrast), white, self.angle_deg, self.steps)


class Points(NamedScene):
    name: ClassVar[str] = "points"
    shows: ClassVar[str] = "a grid of small square holes in the dark, each with its exact light"
    spacing_px: Annotated[float, Quantity("px", "distance of neighbouring holes", lower=1.0)] = 32.25
    side_px: Annotated[float, Quantity("px", "a hole's side on the camera", lower=1e-6)] = 0.5
    contrast: Contrast = 1.0

    def place(self, view: View, white: Spectrum) -> Scene:
        down, across = (
            centre + self.spacing_px * np.arange(-(n // 2), n // 2 + 1)
            for centre, n in zip(
                view.centre,
                (2 * int(0.5 * (size - 1) / self.spacing_px) + 1 for size in (view.rows, view.cols)),
                strict=True,
            )
        )
        points = tuple((float(row), float(col)) for row in down for col in across)
        return PointArray(points, self.side_px, _dark(white, self.contrast), white)


class Charuco(NamedScene):
    name: ClassVar[str] = "charuco"
    shows: ClassVar[str] = "a ChArUco board (DICT_5X5_1000) on white, facing the camera"
    squares_down: Annotated[int, Quantity("1", "squares down the board", lower=3, upper=40)] = 9
    squares_across: Annotated[int, Quantity("1", "squares across the board", lower=3, upper=40)] = 12
    marker_share: Annotated[float, Quantity("1", "a marker's side over a square's", lower=0.3, upper=0.95)] = 0.75
    fill: Annotated[
        float, Quantity("1", "the board's size over the largest that fits into the frame", lower=0.05, upper=4.0)
    ] = 0.85
    contrast: Contrast = 0.9

    def place(self, view: View, white: Spectrum) -> Scene:
        texture = charuco_texture((self.squares_down, self.squares_across), self.marker_share)
        cell = self.fill * view.cell_px_to_fill(self.squares_down, self.squares_across) / TEXELS_PER_SQUARE
        rows, cols = texture.shape
        return PlanarTarget(
            texture=texture,
            texel_mm=cell / view.px_per_mm,
            rotation=UPRIGHT,
            translation_mm=view.corner_mm(rows, cols, cell),
            geometry=view.geometry,
            dark_radiance=_dark(white, self.contrast),
            light_radiance=white,
            surround=1.0,
        )


class PictureOnScreen(Declared):
    """An 8-bit RGB picture on a screen that faces the camera."""

    name: ClassVar[str] = "picture"
    shows: ClassVar[str] = "an RGB picture on a liquid-crystal screen"
    fill: Annotated[
        float, Quantity("1", "the picture's size over the largest that fits into the frame", lower=0.01, upper=10.0)
    ] = 1.0
    gamma: Annotated[float, Quantity("1", "the screen's exponent, all primaries", lower=0.2, upper=5.0)] = 2.2
    contrast_ratio: Annotated[float, Quantity("1", "the screen's white over its black", lower=1.01)] = 1000.0
    falloff_exponent: Annotated[
        float, Quantity("1", "power of the view angle's cosine; 0 is Lambertian", lower=0.0, upper=20.0)
    ] = 0.0
    stripes: Annotated[
        int, Quantity("1", "1: sub-pixels in stripes; 0: pixels that are even squares", lower=0, upper=1)
    ] = 0

    def show(self, codes: NDArray[np.uint8], view: View, white: Spectrum) -> ScreenImage:
        """`codes` (rows, cols, 3) on a screen whose white has the luminance of `white`."""
        rows, cols = codes.shape[:2]
        cell = self.fill * view.cell_px_to_fill(rows, cols)
        shown_on = screen(
            luminance_cd_m2(white),
            self.contrast_ratio,
            (self.gamma, self.gamma, self.gamma),
            self.falloff_exponent,
            SubPixels() if self.stripes else None,
        )
        corner = view.corner_mm(rows, cols, cell)
        return ScreenImage(shown_on, codes, cell / view.px_per_mm, UPRIGHT, corner, view.geometry)


class Cube(Declared):
    """A picture with a spectrum in every sample, in a plane that faces the camera."""

    name: ClassVar[str] = "cube"
    shows: ClassVar[str] = "a multispectral image"
    fill: Annotated[
        float, Quantity("1", "the image's size over the largest that fits into the frame", lower=0.01, upper=10.0)
    ] = 1.0

    def show(self, image: SpectralImage, view: View) -> SpectralImage:
        """Return the image centred in the view; of the frame's own shape and at a `fill` of 1, sample on pixel."""
        rows, cols = image.radiance.shape[:2]
        if self.fill == 1.0 and (rows, cols) == (view.rows, view.cols):
            return replace(image, to_camera=None)
        return replace(image, to_camera=view.centre_pattern(rows, cols, self.fill * view.cell_px_to_fill(rows, cols)))


#: Texels to a square of a board's texture: a multiple of a marker's cells when markers take 3/4 of a square, 7 cells
#: wide.
TEXELS_PER_SQUARE = 56


def charuco_texture(
    squares: tuple[int, int], marker_share: float = 0.75, dictionary: str = "DICT_5X5_1000"
) -> NDArray[np.uint8]:
    """Return a printed ChArUco board of `squares` (rows, cols), 0 or 1, `TEXELS_PER_SQUARE` texels a square
    (OpenCV)."""
    named = getattr(cv2.aruco, dictionary, None)
    if named is None:
        raise ValueError(f"dictionary {dictionary!r} is not one of OpenCV's: name one such as DICT_5X5_1000")
    rows, cols = squares
    board = cv2.aruco.CharucoBoard((cols, rows), 1.0, marker_share, cv2.aruco.getPredefinedDictionary(named))
    drawn = board.generateImage((cols * TEXELS_PER_SQUARE, rows * TEXELS_PER_SQUARE))
    return np.asarray(drawn > 127, np.uint8)


def _cells_to_cover(view: View, cell_px: float) -> tuple[int, int]:
    """Rows and columns of cells that extend beyond the frame by a quarter of it and 32 px on all sides, so that
    neither blur nor barrel distortion shows the surround."""
    down, across = (2 * int(np.ceil((0.75 * n + 32.0) / cell_px)) for n in (view.rows, view.cols))
    return down, across


#: Name -> declaration, in the order in which they're listed.
SCENES: dict[str, type[NamedScene]] = {
    item.name: item
    for item in (
        UniformScene,
        ColorChecker24,
        ColorCheckerSG,
        SlantedEdge,
        Checkerboard,
        Charuco,
        Bernoulli,
        RampScene,
        ZonePlateScene,
        SiemensStarScene,
        Points,
    )
}


@cache
def scenes() -> dict[str, type[NamedScene]]:
    """Return all named scenes: `SCENES`, and the charts of other packages. A name that is taken stays as it is."""
    found = dict(SCENES)
    for name, chart in added_charts().items():
        if name in SCENES or name in colorchecker.KNOWN:
            refuse("charts", name, "a scene or a chart of calibench has that name")
        else:
            found[name] = _scene_of(name, chart)
    return found


def _scene_of(chart_name: str, added: PatchChart) -> type[NamedScene]:
    class AddedChart(_Chart):
        name: ClassVar[str] = chart_name
        shows: ClassVar[str] = added.shows
        chart: ClassVar[str] = chart_name
        gap: Gap = added.gap

    return AddedChart


def scene_by_name(
    name: str,
    camera: CameraModel,
    illuminant: Spectrum,
    *,
    distance_mm: float = 1000.0,
    parameters: Mapping[str, object] | None = None,
) -> Scene:
    """Return the named scene before a camera.

    `illuminant`: radiance (W sr^-1 m^-2 nm^-1) of a perfect white diffuser at the scene
    (`sim.scene.light.illuminant`); full light has it. `parameters`: those of the scene's declaration in `scenes()`;
    others keep their defaults. `View.of(camera, distance_mm).magnification` is the magnification that belongs to it.
    Raises ValueError, in one line, for an unknown name or parameter, or a value outside its bounds.
    """
    if name not in scenes():
        raise ValueError(f"scene {name!r} is not known: name one of {', '.join(scenes())}, or a file")
    return scenes()[name].choose(parameters).place(View.of(camera, distance_mm), illuminant)
