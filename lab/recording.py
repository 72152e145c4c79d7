"""The recording set: the folder format in which recordings come in from outside and go out again.

The models below are the manifest's keys, name by name. An unknown key is kept (and reported), an unknown kind of capture
is reported and skipped; anything else that is off is an `InputError`. `read` looks at everything once, up front, and
names all that is wrong with a folder, one line each; `write` puts a folder there completely or not at all.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
import shutil
import tempfile
import threading
from collections import Counter, OrderedDict, defaultdict
from collections.abc import Callable, Iterator, Mapping
from datetime import datetime
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal, Protocol, TypeVar, get_args, overload

import numpy as np
import rawpy
import tifffile
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, field_validator

from lab.errors import InputError
from sim.camera import Cfa, Side
from sim.spectrum import Spectrum

Frame = NDArray[np.uint16]
Target = NDArray[np.uint8]

Kind = Literal[
    "dark", "flat", "narrowband", "chart", "slanted_edge", "white", "black", "checkerboard", "bernoulli", "charuco"
]


class Open(BaseModel):
    """Base of the manifest's objects: immutable; an unknown key is kept, for the format says so."""

    model_config = ConfigDict(frozen=True, extra="allow", allow_inf_nan=False)

    def unknown_keys(self) -> dict[str, Any]:
        """The keys that the format doesn't know, with their values."""
        return dict(self.model_extra or {})


class Camera(Open):
    """What the manufacturer says of one camera: to be tested, not believed. None = unknown."""

    rows: int = Field(gt=0)
    cols: int = Field(gt=0)
    pixel_pitch_um: float | None = Field(default=None, gt=0)
    fill_factor: float | None = Field(default=None, gt=0, le=1)
    cfa: Cfa
    bit_depth: int = Field(ge=1, le=16)
    black_level_dn: float | None = Field(default=None, ge=0)
    white_level_dn: float | None = Field(default=None, gt=0)
    conversion_gain_dn_per_e: float | None = Field(default=None, gt=0)
    full_well_e: float | None = Field(default=None, gt=0)
    read_noise_e: float | None = Field(default=None, ge=0)
    dark_current_e_per_s: float | None = Field(default=None, ge=0)
    dsnu_e: float | None = Field(default=None, ge=0)
    prnu_percent: float | None = Field(default=None, ge=0)
    quantum_efficiency: dict[str, str] | None = None  # channel -> CSV path
    f_number: float | None = Field(default=None, gt=0)
    focal_length_mm: float | None = Field(default=None, gt=0)
    lens_transmittance: float | None = Field(default=None, gt=0, le=1)
    lens_file: str | None = None

    @field_validator("quantum_efficiency", mode="before")
    @classmethod
    def _known_channels(cls, value: Any) -> Any:
        return {key: path for key, path in value.items() if path is not None} if isinstance(value, dict) else value

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the colour channels, in the order R, G, B; `("Y",)` for a MONO sensor."""
        return ("Y",) if self.cfa == "MONO" else ("R", "G", "B")

    @property
    def saturation_dn(self) -> float:
        """The highest code: `white_level_dn`, or what `bit_depth` allows where that is unknown."""
        return self.white_level_dn if self.white_level_dn is not None else float(2**self.bit_depth - 1)


class Screen(Open):
    """How a pattern was shown: same `pose` = nothing moved."""

    pose: str
    cell_camera_px: float | None = Field(default=None, gt=0)
    radiance: str | None = None  # CSV path of the lit screen


class Capture(Open):
    """What every capture has; each kind adds its own keys."""

    id: str
    kind: str
    side: Side
    frame: str
    exposure_s: float = Field(ge=0)
    gain_db: float | None = None
    temperature_c: float | None = None
    time: datetime | None = None


class Dark(Capture):
    kind: Literal["dark"]


class Flat(Capture):
    kind: Literal["flat"]
    radiance: str | None = None
    photons_per_pixel: float | None = Field(default=None, ge=0)
    wavelength_nm: float | None = Field(default=None, gt=0)


class Narrowband(Capture):
    kind: Literal["narrowband"]
    wavelength_nm: float = Field(gt=0)
    bandwidth_nm: float | None = Field(default=None, ge=0)
    radiance: str


class Chart(Capture):
    kind: Literal["chart"]
    chart: str
    corners: tuple[
        tuple[float, float], tuple[float, float], tuple[float, float], tuple[float, float]
    ]  # [row, col]: dark skin, bluish green, black, white
    radiance: str


class SlantedEdge(Capture):
    kind: Literal["slanted_edge"]
    region: tuple[int, int, int, int]  # row0, col0, row1, col1, end excluded
    angle_deg: float | None = None
    dark_radiance: str | None = None
    light_radiance: str | None = None
    field_mm: tuple[float, float] | None = None  # [row, col] from the optical axis, at the sensor


class White(Capture):
    kind: Literal["white"]
    screen: Screen


class Black(Capture):
    kind: Literal["black"]
    screen: Screen


class Checkerboard(Capture):
    kind: Literal["checkerboard"]
    screen: Screen
    target: str


class Bernoulli(Capture):
    kind: Literal["bernoulli"]
    screen: Screen
    target: str


class Charuco(Capture):
    kind: Literal["charuco"]
    # An imported photograph of a board may not say how long it was exposed; geometry doesn't ask.
    exposure_s: float | None = Field(ge=0)  # type: ignore[assignment]
    dictionary: str  # OpenCV's name, or "none": a plain checkerboard of `squares`, without markers
    squares: tuple[int, int]  # rows, cols
    square_mm: float = Field(gt=0)
    marker_mm: float | None = Field(default=None, gt=0)  # None only where there are no markers
    pose: str


AnyCapture = Annotated[
    Dark | Flat | Narrowband | Chart | SlantedEdge | White | Black | Checkerboard | Bernoulli | Charuco,
    Field(discriminator="kind"),
]
C = TypeVar("C", bound=Capture)


class Manifest(Open):
    format: Literal["calibench-recording"] = "calibench-recording"
    version: Literal[1] = 1
    name: str = ""
    notes: str = ""
    cameras: dict[Side, Camera]
    captures: tuple[AnyCapture, ...]


# --- problems: one line each -------------------------------------------------------------------------------------------


class RecordingError(InputError):
    """All that is wrong with a recording set, one line each: what, where, remedy."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = tuple(problems)


def _reason(error: Exception) -> str:
    """An exception's text on one line."""
    return " ".join(str(error).split()) or type(error).__name__


# --- files -------------------------------------------------------------------------------------------------------------


def _locate(root: Path, path: str) -> Path:
    """The file that a manifest's `path` names, or an InputError: missing, absolute, or outside `root`."""
    pure = PurePosixPath(path)
    if not path or "\\" in path or pure.is_absolute() or (len(path) > 1 and path[1] == ":"):
        raise InputError("not a path relative to the folder with '/'; move the file into the folder and name it so")
    found = root / pure
    if not found.resolve().is_relative_to(root.resolve()):
        raise InputError("leads out of the folder; copy the file into the folder and name it by its relative path")
    if not found.exists():
        raise InputError("no such file; add it, or take what needs it out of the manifest")
    if not found.is_file():
        raise InputError("not a file; name the file itself")
    return found


def _load_npy(file: Path, dtype: type[np.unsignedinteger[Any]]) -> NDArray[Any]:
    """A two-dimensional .npy of `dtype` in either byte order."""
    try:
        # Mapped, so that a damaged header that announces terabytes doesn't allocate them.
        mapped = np.load(file, mmap_mode="r", allow_pickle=False)
    except Exception as error:
        raise InputError(f"damaged .npy ({_reason(error)}); write it again or recapture") from error
    if not isinstance(mapped, np.ndarray):
        raise InputError("an archive of arrays; save one array with numpy.save")
    wanted = np.dtype(dtype)
    if mapped.dtype != wanted and mapped.dtype.newbyteorder("=") != wanted:
        raise InputError(f"its numbers are {mapped.dtype}, not {wanted}; save raw DN as {wanted}")
    if mapped.ndim != 2:
        raise InputError(f"has {mapped.ndim} dimensions, not 2; save one (rows, cols) array")
    return np.array(mapped, dtype=wanted, order="C")


def _load_tif(file: Path) -> NDArray[Any]:
    """A TIFF of one page, 16 bit, one sample a pixel."""
    frame = None
    try:
        with tifffile.TiffFile(file) as tif:
            pages, page = len(tif.pages), tif.pages[0]
            shape, dtype = tuple(page.shape), np.dtype(page.dtype)
            if pages == 1 and dtype == np.uint16 and len(shape) == 2:
                frame = np.ascontiguousarray(page.asarray())
    except Exception as error:
        raise InputError(f"damaged TIFF ({_reason(error)}); write it again or recapture") from error
    if pages != 1:
        raise InputError(f"has {pages} pages, not 1; save one file a frame")
    if dtype != np.uint16:
        raise InputError(f"its samples are {dtype}, not uint16; save raw DN as 16 bit")
    if frame is None:
        raise InputError(f"has the shape {shape}, not (rows, cols); save the mosaic, not colours")
    return frame


def _load_raw(file: Path, shape: tuple[int, int] | None = None) -> NDArray[Any]:
    """The mosaic of a camera raw: the visible area, or the whole one where only that has the wanted `shape`."""
    try:
        with rawpy.imread(str(file)) as raw:
            visible, whole = raw.raw_image_visible, raw.raw_image
            chosen = whole if shape not in (None, visible.shape) and whole.shape == shape else visible
            frame = np.array(chosen, dtype=np.uint16, order="C")
    except Exception as error:
        raise InputError(f"damaged raw ({_reason(error)}); copy it again or recapture") from error
    if frame.ndim != 2:
        raise InputError("holds no mosaic (a linear DNG); save the raw itself")
    return frame


def load_frame(file: Path, shape: tuple[int, int] | None = None) -> Frame:
    """One frame from an .npy, .tif/.tiff or camera-raw file: uint16 (rows, cols) as stored. InputError without the path."""
    suffix = file.suffix.lower()
    if suffix == ".npy":
        return _load_npy(file, np.uint16)
    if suffix in (".tif", ".tiff"):
        return _load_tif(file)
    if suffix == ".dng":
        return _load_raw(file, shape)
    raise InputError(f"a frame can't be {suffix or 'without an ending'}; give .npy, .tif or .dng")


def parse_spectrum(text: str) -> Spectrum:
    """A spectrum from CSV text with the header `wavelength_nm,value`; InputError without the path.

    Blank lines and a byte-order mark are let pass. Wavelengths must ascend strictly, every number be finite.
    """
    rows = [row for row in csv.reader(io.StringIO(text.removeprefix("\ufeff"))) if any(cell.strip() for cell in row)]
    if not rows or [cell.strip() for cell in rows[0]] != ["wavelength_nm", "value"]:
        head = ",".join(rows[0])[:60] if rows else ""
        raise InputError(f"its first line is '{head}', not 'wavelength_nm,value'; write that header")
    if len(rows) == 1:
        raise InputError("has no samples; write one row a sample")
    wavelength_nm: list[float] = []
    value: list[float] = []
    for number, row in enumerate(rows[1:], start=2):
        try:
            at, height = (float(cell) for cell in row)
        except ValueError:
            raise InputError(
                f"row {number} is '{','.join(row)[:60]}', not two numbers; write wavelength and value"
            ) from None
        if not (math.isfinite(at) and math.isfinite(height)):
            raise InputError(f"row {number} isn't finite ({at}, {height}); leave unknown samples out")
        if wavelength_nm and at <= wavelength_nm[-1]:
            raise InputError(f"row {number}: {at:g} nm follows {wavelength_nm[-1]:g} nm; sort the rows, each nm once")
        wavelength_nm.append(at)
        value.append(height)
    return Spectrum(wavelength_nm=tuple(wavelength_nm), value=tuple(value))


def _load_spectrum(file: Path) -> Spectrum:
    try:
        text = file.read_text(encoding="utf-8")
    except (UnicodeDecodeError, OSError) as error:
        raise InputError(f"can't be read as text ({_reason(error)}); save it as CSV in UTF-8") from error
    return parse_spectrum(text)


def _checked_target(target: Target) -> Target:
    if target.size == 0 or int(target.max()) > 1:
        raise InputError("holds other numbers than 0 and 1; save what was shown as 0 (dark) and 1 (lit)")
    return target


# --- where frames, spectra and targets lie -----------------------------------------------------------------------------


class _Store(Protocol):
    """Frames, spectra and targets by the manifest's path; an InputError says why not, without the path."""

    def frame(self, path: str, camera: Camera) -> Frame: ...
    def spectrum(self, path: str) -> Spectrum: ...
    def target(self, path: str) -> Target: ...
    def file(self, path: str) -> Path | None: ...
    def where(self, path: str) -> str: ...


class _Folder:
    def __init__(self, root: Path) -> None:
        self.root = root

    def file(self, path: str) -> Path | None:
        return _locate(self.root, path)

    def frame(self, path: str, camera: Camera) -> Frame:
        return load_frame(_locate(self.root, path), (camera.rows, camera.cols))

    def spectrum(self, path: str) -> Spectrum:
        return _load_spectrum(_locate(self.root, path))

    def target(self, path: str) -> Target:
        file = _locate(self.root, path)
        if file.suffix.lower() != ".npy":
            raise InputError(f"a target can't be {file.suffix or 'without an ending'}; give .npy (uint8)")
        return _checked_target(_load_npy(file, np.uint8))

    def where(self, path: str) -> str:
        return str(self.root / path) if not PurePosixPath(path).is_absolute() else path


class _Memory:
    def __init__(
        self, frames: Mapping[str, NDArray[Any]], spectra: Mapping[str, Spectrum], targets: Mapping[str, NDArray[Any]]
    ) -> None:
        self.frames, self.spectra, self.targets = dict(frames), dict(spectra), dict(targets)

    def file(self, path: str) -> Path | None:
        return None

    def frame(self, path: str, camera: Camera) -> Frame:
        if path not in self.frames:
            raise InputError("no such frame; give it in `frames`")
        frame = np.asarray(self.frames[path])
        if frame.dtype != np.uint16 or frame.ndim != 2:
            raise InputError(
                f"is {frame.dtype} with {frame.ndim} dimensions; give raw DN as a 2-dimensional uint16 array"
            )
        return frame.copy()

    def spectrum(self, path: str) -> Spectrum:
        if path not in self.spectra:
            raise InputError("no such spectrum; give it in `spectra`")
        spectrum = self.spectra[path]
        if not (np.all(np.isfinite(spectrum.wavelength_nm)) and np.all(np.isfinite(spectrum.value))):
            raise InputError("isn't finite; leave unknown samples out")
        return spectrum

    def target(self, path: str) -> Target:
        if path not in self.targets:
            raise InputError("no such target; give it in `targets`")
        target = np.asarray(self.targets[path])
        if target.dtype != np.uint8 or target.ndim != 2:
            raise InputError(f"is {target.dtype} with {target.ndim} dimensions; give a 2-dimensional uint8 array")
        return _checked_target(target.copy())

    def where(self, path: str) -> str:
        return path


# --- the set -----------------------------------------------------------------------------------------------------------


class RecordingSet:
    """A manifest with its frames, spectra and targets; frames are loaded when asked for and kept while memory allows.

    From a folder by `read`, or in memory: `frames`, `spectra` and `targets` by the paths that the manifest names. Safe to
    share between threads, and to send to another process.
    """

    def __init__(
        self,
        manifest: Manifest,
        frames: Mapping[str, NDArray[Any]] | None = None,
        spectra: Mapping[str, Spectrum] | None = None,
        targets: Mapping[str, NDArray[Any]] | None = None,
        *,
        source: str = "memory",
        warnings: tuple[str, ...] = (),
        store: _Store | None = None,
        cache_bytes: int = 256 << 20,
    ) -> None:
        self.manifest = manifest
        self.source = source
        self.warnings = warnings
        self.cache_bytes = cache_bytes
        self._store: _Store = store or _Memory(frames or {}, spectra or {}, targets or {})
        self._cache: OrderedDict[str, Frame] = OrderedDict()
        self._held = 0
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_cache": OrderedDict(), "_held": 0, "_lock": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ |= state | {"_lock": threading.Lock()}

    @property
    def sides(self) -> tuple[Side, ...]:
        """The sides that have a camera, left first."""
        return tuple(side for side in get_args(Side) if side in self.manifest.cameras)

    def camera(self, side: Side) -> Camera:
        """The maker's word on the camera of `side`; InputError where there is none."""
        if side not in self.manifest.cameras:
            raise InputError(f"{self.source}: no camera '{side}', only {', '.join(self.sides)}; ask for one of these")
        return self.manifest.cameras[side]

    @overload
    def captures(self, kind: Literal["dark"], side: Side | None = None) -> list[Dark]: ...
    @overload
    def captures(self, kind: Literal["flat"], side: Side | None = None) -> list[Flat]: ...
    @overload
    def captures(self, kind: Literal["narrowband"], side: Side | None = None) -> list[Narrowband]: ...
    @overload
    def captures(self, kind: Literal["chart"], side: Side | None = None) -> list[Chart]: ...
    @overload
    def captures(self, kind: Literal["slanted_edge"], side: Side | None = None) -> list[SlantedEdge]: ...
    @overload
    def captures(self, kind: Literal["white"], side: Side | None = None) -> list[White]: ...
    @overload
    def captures(self, kind: Literal["black"], side: Side | None = None) -> list[Black]: ...
    @overload
    def captures(self, kind: Literal["checkerboard"], side: Side | None = None) -> list[Checkerboard]: ...
    @overload
    def captures(self, kind: Literal["bernoulli"], side: Side | None = None) -> list[Bernoulli]: ...
    @overload
    def captures(self, kind: Literal["charuco"], side: Side | None = None) -> list[Charuco]: ...
    @overload
    def captures(self, kind: type[C], side: Side | None = None) -> list[C]: ...
    @overload
    def captures(self, kind: Kind | None = None, side: Side | None = None) -> list[AnyCapture]: ...

    def captures(self, kind: str | type[Capture] | None = None, side: Side | None = None) -> Any:
        """Captures in the manifest's order, of one kind (its name or its class) and one side, or of all."""
        return [
            capture
            for capture in self.manifest.captures
            if (side is None or capture.side == side)
            and (kind is None or (capture.kind == kind if isinstance(kind, str) else isinstance(capture, kind)))
        ]

    def capture(self, id: str) -> AnyCapture:
        """The capture called `id`; InputError where there is none."""
        for capture in self.manifest.captures:
            if capture.id == id:
                return capture
        raise InputError(f"{self.source}: no capture '{id}'; the manifest lists {len(self.manifest.captures)} others")

    def frame(self, capture: Capture) -> Frame:
        """Raw DN of a capture: uint16 (rows, cols), read-only. InputError where the file is not what the manifest says."""
        with self._lock:
            if capture.frame in self._cache:
                self._cache.move_to_end(capture.frame)
                return self._cache[capture.frame]
        camera = self.camera(capture.side)
        try:
            frame = self._store.frame(capture.frame, camera)
            if problem := _frame_problem(frame, camera):
                raise InputError(problem)  # noqa: TRY301
        except InputError as error:
            raise InputError(f"{self._store.where(capture.frame)} (capture {capture.id}): {error}") from error
        frame.flags.writeable = False
        with self._lock:
            if capture.frame not in self._cache and frame.nbytes <= self.cache_bytes:
                self._cache[capture.frame] = frame
                self._held += frame.nbytes
                while self._held > self.cache_bytes:
                    self._held -= self._cache.popitem(last=False)[1].nbytes
        return frame

    def spectrum(self, path: str) -> Spectrum:
        """The spectrum that the manifest calls `path`."""
        try:
            return self._store.spectrum(path)
        except InputError as error:
            raise InputError(f"{self._store.where(path)}: {error}") from error

    def target(self, path: str) -> Target:
        """What was shown on the screen: uint8 (rows, cols) of 0 and 1."""
        try:
            return self._store.target(path)
        except InputError as error:
            raise InputError(f"{self._store.where(path)}: {error}") from error

    def file(self, path: str) -> Path | None:
        """The file behind a path of the manifest, or None for a set in memory."""
        return self._store.file(path)


def _frame_problem(frame: Frame, camera: Camera) -> str | None:
    """Why `frame` can't be a frame of `camera`, with the remedy; None where it can."""
    if frame.shape != (camera.rows, camera.cols):
        return (
            f"{frame.shape[0]} x {frame.shape[1]} pixels (rows x cols), but the manifest says "
            f"{camera.rows} x {camera.cols}; recapture, or correct rows and cols"
        )
    highest, limit = int(frame.max()), 2**camera.bit_depth - 1
    if highest > limit:
        return f"{highest} DN is above what {camera.bit_depth} bits hold ({limit} DN); correct bit_depth, or save raw DN unscaled"
    if highest > camera.saturation_dn:
        return f"{highest} DN is above white_level_dn = {camera.saturation_dn:g} DN; correct white_level_dn, or save raw DN unscaled"
    return None
