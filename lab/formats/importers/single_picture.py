"""One picture of a slanted edge, or of a ColorChecker: PNG, TIFF, JPEG, FITS, .npy or a camera raw.

`camera.toml` beside it (or `--camera FILE`) has the camera's keys: `cfa`, `bit_depth` and `black_level_dn` have to be
stated, and everything else that is known helps. A colour picture is no mosaic: of an edge one channel is taken as that
of a monochrome camera, a chart is sampled like an RGGB mosaic of the same size. Its noise is that of a demosaiced
picture."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from lab.errors import InputError
from lab.formats.cgats import read_foreign_csv
from lab.formats.importers.images import codes_of, has_alpha, read_image, read_sides
from lab.formats.importers.own_statements import (
    compare_with_files,
    list_keys_taken,
    read_known_keys,
    subsampling_remark,
)
from lab.formats.importers.stated_settings import check_against_frames
from lab.formats.pictures import IMAGES, picture_facts, read_picture
from lab.formats.recording_set import DataSheet, Frame, Manifest, RecordingSet, frame_problem
from lab.formats.spectrum_csv import parse_spectrum
from sim.scene.colorchecker import reflectances
from sim.sensor import mosaic
from sim.spectrum import Spectrum


@dataclass(frozen=True)
class ImportOptions:
    """Statements that a format doesn't hold. None: not stated.

    `checkerboard`, `dots`: inner corners or dots (rows, cols), `square_mm` their spacing. `camera`: a camera file, in
    place of the `camera.toml` beside the picture. `channel`: of a colour picture, R, G or B. `transfer`: what the
    picture's codes are, proportional to the light or sRGB. `corners`: of a chart's 24 patches, [row, col] of dark skin,
    bluish green, black, white. `light`, `white_patch`: CSV of the radiance of a perfect diffuser, or of the chart's
    white patch, in the chart's place. `tap`: one tap of the sensor alone. `only`: frames whose headers state these
    settings, KEY=VALUE,...; `ignore`: keywords of headers that aren't used, KEY,..."""

    checkerboard: tuple[int, int] | None = None
    dots: tuple[int, int] | None = None
    square_mm: float | None = None
    camera: Path | None = None
    exposure_s: float | None = None
    channel: str | None = None
    transfer: Literal["linear", "srgb"] | None = None
    corners: tuple[tuple[float, float], ...] | None = None
    light: Path | None = None
    white_patch: Path | None = None
    tap: str | None = None
    only: str | None = None
    ignore: str | None = None

    def stated(self) -> tuple[str, ...]:
        """Return the names of the options that are stated, as on the command line."""
        names = (field.name for field in fields(self))
        return tuple(f"--{name.replace('_', '-')}" for name in names if getattr(self, name) is not None)


def grid(option: str, text: str) -> tuple[int, int] | None:
    """Return ROWSxCOLS as two numbers; None where `text` is empty.

    option : its name, with which an InputError begins

    >>> grid("--squares", "6x9")
    (6, 9)
    """
    if not text:
        return None
    match = re.fullmatch(r"(\d{1,4})x(\d{1,4})", text)
    if match is None:
        raise InputError(f"{option} {text}: give ROWSxCOLS, as in 6x9")
    return int(match[1]), int(match[2])


def chart_corners(option: str, text: str) -> tuple[tuple[float, float], ...] | None:
    """Return eight numbers with commas as four corners (row, col), px; None where `text` is empty.

    option : its name, with which an InputError begins

    >>> chart_corners("--corners", "10,20,10,620,470,620,470,20")[1]
    (10.0, 620.0)
    """
    if not text:
        return None
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 8:
        raise InputError(
            f"{option} {text}: give eight numbers, row and column of dark skin, bluish green, black, white"
        )
    return tuple(zip(numbers[::2], numbers[1::2], strict=True))


CAMERA = "camera.toml"
#: Highest code of a picture that was decoded from sRGB.
LINEAR_BITS = 16
#: Least ratio of the chart's white patch to its black one for a chart to be believed.
WHITE_OVER_BLACK = 3.0
CHART = "ColorChecker24"
PATCH_ROWS, PATCH_COLS = 4, 6
#: Enlargements of the picture in which a chart is looked for, in turn: the detector finds patches of some sizes only.
SCALES = (1, 2, 3, 4, 6)
#: Grey rim laid about the picture, over its shorter side, and its code: a chart that fills the frame isn't found
#: without.
PADS, RIM_CODE = (0.0, 0.125), 110

Corners = tuple[tuple[float, float], ...]


def read_colour_chart(path: Path, options: ImportOptions) -> RecordingSet:
    """Return a picture of a ColorChecker of 24 patches as a recording set of one capture; the patches are located, or
    given by their corners.

    Raises InputError with all that isn't stated, in one line, or where no chart is found.
    """
    lit = options.light is None and options.white_patch is None
    missing = ("--light or --white-patch (CSV of the light's radiance)",) if lit else ()
    frame, camera, notes = read_picture_and_camera(path, options, _remosaic, missing)
    corners = options.corners
    if corners is None:
        corners = locate_chart(frame, camera)
        if corners is None:
            raise InputError(f"{path}: no ColorChecker of 24 patches found; give its --corners")
        said = " ".join(f"{value:.0f}" for corner in corners for value in corner)
        notes = (*notes, f"{path}: the chart's corners were found at {said} (row, column): check that")
    _check_grey_row(path, frame, camera, corners)
    capture = {"id": "chart", "kind": "chart", "chart": CHART, "corners": corners, "radiance": "spectra/light.csv"}
    light, remarks = _light(options)
    return build_recording_set(path, frame, camera, options, capture, (*notes, *remarks), {"spectra/light.csv": light})


def locate_chart(frame: Frame, camera: DataSheet) -> Corners | None:
    """Find the corners of the grid of patches, [row, col] of dark skin, bluish green, black, white; None where no chart
    is found.

    Patches are found by OpenCV's MCC detector in the mosaic binned to its period; a homography through the 24 centres
    gives the corners."""
    step = mosaic.step(camera.cfa)
    picture = _small_colours(frame, camera)
    for pad, scale in ((pad, scale) for pad in PADS for scale in SCALES):
        rim = round(pad * min(picture.shape[:2]))
        padded = cv2.copyMakeBorder(picture, rim, rim, rim, rim, cv2.BORDER_CONSTANT, value=(RIM_CODE,) * 3)
        larger = cv2.resize(padded, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        detector = cv2.mcc.CCheckerDetector.create()
        if _detects_alike(detector, larger):
            charts = np.asarray(detector.getBestColorChecker().getColorCharts(), float).reshape(-1, 4, 2)
            if len(charts) == PATCH_ROWS * PATCH_COLS:
                break
    else:
        return None
    centres = (charts.mean(axis=1) + 0.5) / scale - 0.5 - rim
    row, col = np.divmod(np.arange(len(centres)), PATCH_COLS)
    grid = np.column_stack([(col + 0.5) / PATCH_COLS, (row + 0.5) / PATCH_ROWS])
    homography, _ = cv2.findHomography(grid, centres)
    square = np.array([[[0.0, 0.0]], [[1.0, 0.0]], [[1.0, 1.0]], [[0.0, 1.0]]])
    corners_px = cv2.perspectiveTransform(square, homography)[:, 0] * step + 0.5 * (step - 1)
    corners = tuple((float(y), float(x)) for x, y in corners_px)
    return _upright(frame, camera, corners)


def _detects_alike(detector: Any, picture: NDArray[np.uint8]) -> bool:
    """Return whether a detector finds a chart, alike at every call: it clusters colours from random starts, and each
    thread draws its own."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        cv2.setRNGSeed(0)
        return bool(detector.process(picture, 1))
    finally:
        cv2.setNumThreads(threads)


def _upright(frame: Frame, camera: DataSheet, corners: Corners) -> Corners:
    """Return the corners in the order of a chart that isn't mirrored, of whose two the grey row falls: the detector may
    take it turned or mirrored where light has one colour."""
    orders = ((0, 1, 2, 3), (2, 3, 0, 1), (1, 0, 3, 2), (3, 2, 1, 0))
    candidates = [tuple(corners[k] for k in order) for order in orders]

    def is_front(c: Corners) -> bool:
        (y0, x0), (y1, x1), _, (y3, x3) = c
        return (x1 - x0) * (y3 - y0) - (y1 - y0) * (x3 - x0) > 0

    front = [c for c in candidates if is_front(c)]
    return max(front, key=lambda c: -float(np.polyfit(np.arange(PATCH_COLS), grey_levels(frame, c), 1)[0]))


def read_picture_and_camera(
    path: Path,
    options: ImportOptions,
    plane_of: Callable[[NDArray[Any]], tuple[Frame, str]],
    missing: tuple[str, ...],
) -> tuple[Frame, DataSheet, tuple[str, ...]]:
    """Return the frame, its camera, and what was done to it. Raises InputError that names everything that isn't stated.
    `plane_of`: frame and mosaic of a colour picture (rows, cols, 3) in R, G, B."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; give one picture")
    file, keys = _read_stated_camera(path, options)
    is_image = path.suffix.lower() in IMAGES
    with _about(path):
        image = read_picture(path) if is_image else read_image(path)
        known = read_known_keys(path, (image.shape[0], image.shape[1]))
        colours = image.ndim == 3 and image.shape[2] >= 3 and bool(np.ptp(image[..., :3], axis=2).any())
        notes = _refuse_mixed_channels(path, options) if is_image and colours else ()
    stated = frozenset(keys)
    keys = known | keys
    if image.dtype == np.uint8:
        keys.setdefault("bit_depth", 8)
    _refuse_unstated(path, file, keys, options, missing, needs_cfa=not colours)
    if has_alpha(image):
        notes += (f"{path}: has a channel of transparency, which is dropped",)
    if colours:
        image, keys["cfa"] = plane_of(image[..., :3])
        notes += (f"{path}: a colour picture: its pixels are no mosaic's, and neighbours share their noise",)
    else:
        notes += tuple(list_keys_taken(stated, known, path))
    with _about(path):
        frame = codes_of(image[..., 0] if image.ndim == 3 else image)
    camera = _camera_of(file, keys, frame)
    if problem := frame_problem(frame, camera):
        raise InputError(f"{path}: {problem}")
    notes += tuple(compare_with_files(camera, frozenset() if colours else stated, [path]))
    if options.transfer == "srgb":
        frame, keys = _linear(frame, keys)
        camera = _camera_of(file, keys, frame)
        notes += (
            f"{path}: decoded from sRGB to linear codes of {LINEAR_BITS} bit; a screen's tone curve isn't undone",
        )
    return frame, camera, notes


@contextmanager
def _about(path: Path) -> Iterator[None]:
    """Put the picture's path before an InputError that doesn't state it."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _refuse_unstated(
    path: Path,
    file: Path,
    keys: Mapping[str, Any],
    options: ImportOptions,
    missing: tuple[str, ...],
    *,
    needs_cfa: bool,
) -> None:
    """Raise InputError that names everything that isn't stated."""
    needed = (*(("cfa",) if needs_cfa else ()), "bit_depth", "black_level_dn")
    lacking = [key for key in needed if key not in keys]
    lacking_options = ([f"{', '.join(lacking)} ({file})"] if lacking else []) + list(missing)
    if options.exposure_s is None:
        lacking_options.append("--exposure-s")
    if path.suffix.lower() in IMAGES and options.transfer is None:
        lacking_options.append("--transfer linear, or srgb where the picture is made for a screen")
    if lacking_options:
        raise InputError(f"{path}: isn't stated: {'; '.join(lacking_options)}; state them")


def _refuse_mixed_channels(path: Path, options: ImportOptions) -> tuple[str, ...]:
    """Return the note on a colour picture whose channels share their fine detail; InputError, without the path, where
    the channel that is asked for has least of its own."""
    mixed = subsampling_remark(picture_facts(path))
    if mixed is None:
        return ()
    if options.channel in ("R", "B"):
        raise InputError(f"{mixed}; give --channel G, a picture without subsampling, or the raw")
    return (f"{path}: {mixed}",)


def _camera_of(file: Path, keys: Mapping[str, Any], frame: Frame) -> DataSheet:
    """Return the camera that a camera file's keys describe, of the frame's size."""
    try:
        return DataSheet.model_validate({**keys, "rows": frame.shape[0], "cols": frame.shape[1]})
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"{file}: {'.'.join(map(str, first['loc']))}: {first['msg']}; correct it") from error


def _read_stated_camera(path: Path, options: ImportOptions) -> tuple[Path, dict[str, Any]]:
    """Return the camera file of a picture, and its keys."""
    file = options.camera if options.camera is not None else path.parent / CAMERA
    if options.camera is not None and not file.is_file():
        raise InputError(f"{file}: no such file; give the camera file of --camera")
    sides = read_sides(file)
    if "left" not in sides:
        raise InputError(f"{file}: describes no left camera; write the keys without a table")
    return file, dict(sides["left"])


def _linear(frame: Frame, keys: dict[str, Any]) -> tuple[Frame, dict[str, Any]]:
    """Codes in proportion to the light (IEC 61966-2-1), and the camera's levels in them."""

    def light(code: NDArray[Any] | float) -> NDArray[Any]:
        value = np.asarray(code, float) / (2.0 ** int(keys["bit_depth"]) - 1.0)
        low = value / 12.92
        return np.asarray(np.where(value <= 0.04045, low, ((value + 0.055) / 1.055) ** 2.4) * (2.0**LINEAR_BITS - 1.0))

    changed = {key: float(light(keys[key])) for key in ("black_level_dn", "white_level_dn") if key in keys}
    made = np.ascontiguousarray(np.rint(light(frame)).clip(0, 2**LINEAR_BITS - 1), dtype=np.uint16)
    return made, keys | changed | {"bit_depth": LINEAR_BITS}


def take_channel(image: NDArray[Any], options: ImportOptions) -> tuple[Frame, str]:
    """Return the stated channel of a colour picture (rows, cols, 3), and the mosaic of a monochrome camera.

    Raises InputError where `options.channel` is none of R, G and B.
    """
    if options.channel not in ("R", "G", "B"):
        raise InputError("a colour picture: state --channel R, G or B, or give the raw")
    return image[..., "RGB".index(options.channel)], "MONO"


def _remosaic(image: NDArray[Any]) -> tuple[Frame, str]:
    """Return a colour picture (rows, cols, 3) sampled like a mosaic."""
    rows, cols = (n // 2 * 2 for n in image.shape[:2])
    made = np.empty((rows, cols), image.dtype)
    for channel, places in mosaic.phases("RGGB").items():
        for row, col in places:
            made[row::2, col::2] = image[row:rows:2, col:cols:2, "RGB".index(channel)]
    return made, "RGGB"


def _small_colours(frame: Frame, camera: DataSheet) -> NDArray[np.uint8]:
    """Return the mosaic binned to its period as a picture for a screen, (rows, cols, 3) in B, G, R: each channel over
    its brightest per mille."""
    step = mosaic.step(camera.cfa)
    black = camera.black_level_dn or 0.0
    rows, cols = (n // step for n in frame.shape)
    planes = []
    for channel in "BGR" if camera.cfa != "MONO" else "YYY":
        phases = mosaic.phases(camera.cfa)[channel]
        plane = np.mean([frame[r::step, c::step][:rows, :cols] for r, c in phases], axis=0) - black
        planes.append(np.clip(plane / max(float(np.quantile(plane, 0.999)), 1.0), 0.0, 1.0) ** (1.0 / 2.2))
    return np.ascontiguousarray(np.rint(255.0 * np.dstack(planes)), dtype=np.uint8)


def _check_grey_row(path: Path, frame: Frame, camera: DataSheet, corners: Corners) -> None:
    """Refuse corners inside which the grey row doesn't fall from white to black."""
    corner = np.array(corners, float)
    if not np.all((corner >= -0.5) & (corner <= np.array(frame.shape) - 0.5)):
        raise InputError(
            f"{path}: a corner of the chart is outside the frame of {frame.shape[0]} x {frame.shape[1]}; give [row, "
            "col]"
        )
    level = grey_levels(frame, corners) - (camera.black_level_dn or 0.0)
    if np.any(np.diff(level) >= 0) or level[0] < WHITE_OVER_BLACK * max(level[-1], 1e-9):
        said = ", ".join(f"{value:.4g}" for value in level)
        raise InputError(
            f"{path}: the grey row doesn't fall from white to black between these corners ({said} DN above black); "
            "give --corners as "
            "row and column of dark skin, bluish green, black, white"
        )


def grey_levels(frame: Frame, corners: Corners) -> NDArray[np.floating[Any]]:
    """Return the mean DN of the inner parts of the patches of the grey row, white first."""
    corner, v = np.array(corners, float), (PATCH_ROWS - 0.5) / PATCH_ROWS
    half = max(int(0.15 * np.linalg.norm(corner[1] - corner[0]) / PATCH_COLS), 1)
    levels = []
    for col in range(PATCH_COLS):
        u = (col + 0.5) / PATCH_COLS
        at = (1 - v) * ((1 - u) * corner[0] + u * corner[1]) + v * ((1 - u) * corner[3] + u * corner[2])
        row0, col0 = (max(int(n) - half, 0) for n in at)
        part = frame[row0 : row0 + 2 * half + 1, col0 : col0 + 2 * half + 1]
        levels.append(float(part.mean()) if part.size else np.nan)
    return np.nan_to_num(np.array(levels))


def _light(options: ImportOptions) -> tuple[Spectrum, tuple[str, ...]]:
    """Radiance of a perfect diffuser in the chart's place, and what was found in reading it."""
    file = options.light if options.light is not None else options.white_patch
    assert file is not None
    try:
        text = read_foreign_csv(file)
        spectrum = parse_spectrum(text.text)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error
    remarks = tuple(f"{file}: {remark}" for remark in text.remarks)
    if options.light is not None:
        return spectrum, remarks
    white = next(value for name, value in reflectances(CHART).items() if name.startswith("white"))
    wavelength_nm, value = spectrum.arrays
    return Spectrum.of(wavelength_nm, value / white.at(wavelength_nm)), remarks


def build_recording_set(
    path: Path,
    frame: Frame,
    camera: DataSheet,
    options: ImportOptions,
    capture: dict[str, Any],
    notes: tuple[str, ...],
    spectra: dict[str, Spectrum],
) -> RecordingSet:
    """Return a recording set of one picture.

    path : the picture
    frame : (rows, cols), DN
    camera : its data sheet
    options : as they were stated on the command line
    capture : keys of the capture
    notes : remarks of the import
    spectra : by the path under which the capture names them
    """
    stored = f"frames/{capture['id']}.npy"
    manifest = Manifest.model_validate(
        {
            "name": path.stem,
            "notes": f"imported from the picture {path.name}",
            "cameras": {"left": camera.model_dump(exclude_unset=True)},
            "captures": [capture | {"side": "left", "frame": stored, "exposure_s": options.exposure_s}],
        }
    )
    manifest, said = check_against_frames(manifest, {stored: path}, str(path))
    return RecordingSet(manifest, {stored: frame}, spectra, source=str(path), warnings=(*notes, *said))
