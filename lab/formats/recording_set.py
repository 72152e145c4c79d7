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
from collections.abc import Callable, Container, Iterator, Mapping
from dataclasses import dataclass, field
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
    region: tuple[int, int, int, int] | None = None  # row0, col0, row1, col1, end excluded; None: edges are looked for
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


#: Endings of camera raws that LibRaw reads.
RAWS = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")


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
    try:
        inside, exists, is_file = found.resolve().is_relative_to(root.resolve()), found.exists(), found.is_file()
    except (OSError, ValueError, RuntimeError) as error:  # a loop of links, a NUL, a name too long
        raise InputError(f"no usable path ({_reason(error)}); rename the file") from error
    if not inside:
        raise InputError("leads out of the folder; copy the file into the folder and name it by its relative path")
    if not exists:
        raise InputError("no such file; add it, or take what needs it out of the manifest")
    if not is_file:
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
    if suffix in RAWS:
        return _load_raw(file, shape)
    raise InputError(f"a frame can't be {suffix or 'without an ending'}; give .npy, .tif or .dng")


def parse_spectrum(text: str) -> Spectrum:
    """A spectrum from CSV text with the header `wavelength_nm,value`; InputError without the path.

    Blank lines and a byte-order mark are let pass. Wavelengths must ascend strictly, every number be finite.
    """
    return parse_curve(text, ("value",))[1]


def parse_curve(text: str, columns: tuple[str, ...]) -> tuple[str, Spectrum]:
    """As `parse_spectrum`, with any of `columns` as the second column's name; which one it was, and the curve."""
    try:
        lines = csv.reader(io.StringIO(text.removeprefix("\ufeff"), newline=None))
        rows = [row for row in lines if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise InputError(f"isn't CSV ({_reason(error)}); write rows of two numbers") from None
    names = [cell.strip() for cell in rows[0]] if rows else []
    if len(names) != 2 or names[0] != "wavelength_nm" or names[1] not in columns:
        head = _quoted(rows[0]) if rows else ""
        wanted = " or ".join(f"'wavelength_nm,{column}'" for column in columns)
        raise InputError(f"its first line is '{head}', not {wanted}; write that header")
    if len(rows) == 1:
        raise InputError("has no samples; write one row a sample")
    wavelength_nm: list[float] = []
    value: list[float] = []
    for number, row in enumerate(rows[1:], start=2):
        try:
            at, height = (float(cell) for cell in row)
        except ValueError:
            raise InputError(f"row {number} is '{_quoted(row)}', not two numbers; write wavelength and value") from None
        if not (math.isfinite(at) and math.isfinite(height)):
            raise InputError(f"row {number} isn't finite ({at}, {height}); leave unknown samples out")
        if wavelength_nm and at <= wavelength_nm[-1]:
            raise InputError(f"row {number}: {at:g} nm follows {wavelength_nm[-1]:g} nm; sort the rows, each nm once")
        wavelength_nm.append(at)
        value.append(height)
    return names[1], Spectrum(wavelength_nm=tuple(wavelength_nm), value=tuple(value))


def _quoted(row: list[str]) -> str:
    """The start of a row of cells, which may hold line breaks, on one line."""
    return " ".join(",".join(row).split())[:60]


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


class Store(Protocol):
    """Frames, spectra and targets by the manifest's path; an InputError says why not, without the path."""

    def frame(self, path: str, camera: Camera) -> Frame: ...
    def spectrum(self, path: str) -> Spectrum: ...
    def target(self, path: str) -> Target: ...
    def file(self, path: str) -> Path | None: ...
    def where(self, path: str) -> str: ...


class FolderStore:
    """Frames, spectra and targets as files below `root`; importers override what they decode themselves."""

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
        # Not copied: an importer's frames may be a mapping that decodes on access.
        self.frames, self.spectra, self.targets = frames, spectra, targets

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


class _Overlaid:
    """Another store with some of its frames replaced."""

    def __init__(self, below: Store, frames: Mapping[str, NDArray[Any]]) -> None:
        self._below, self._above = below, _Memory(frames, {}, {})

    def file(self, path: str) -> Path | None:
        return self._below.file(path)

    def frame(self, path: str, camera: Camera) -> Frame:
        return (self._above if path in self._above.frames else self._below).frame(path, camera)

    def spectrum(self, path: str) -> Spectrum:
        return self._below.spectrum(path)

    def target(self, path: str) -> Target:
        return self._below.target(path)

    def where(self, path: str) -> str:
        return self._below.where(path)


class _Joined:
    """A store, and another whose paths begin with `folder`."""

    def __init__(self, first: Store, later: Store, folder: str) -> None:
        self._first, self._later, self._folder = first, later, f"{folder}/"

    def _of(self, path: str) -> tuple[Store, str]:
        return (self._later, path.removeprefix(self._folder)) if path.startswith(self._folder) else (self._first, path)

    def file(self, path: str) -> Path | None:
        store, its = self._of(path)
        return store.file(its)

    def frame(self, path: str, camera: Camera) -> Frame:
        store, its = self._of(path)
        return store.frame(its, camera)

    def spectrum(self, path: str) -> Spectrum:
        store, its = self._of(path)
        return store.spectrum(its)

    def target(self, path: str) -> Target:
        store, its = self._of(path)
        return store.target(its)

    def where(self, path: str) -> str:
        store, its = self._of(path)
        return store.where(its)


#: Keys of captures whose values name files or poses, which another set may name alike.
_NAMING = frozenset({"id", "frame", "radiance", "dark_radiance", "light_radiance", "target", "pose"})


def _renamed(told: Any, folder: str) -> Any:
    """A capture's document with `folder` before its id, its paths and its pose."""
    if not isinstance(told, dict):
        return told
    return {
        key: f"{folder}/{value}" if key in _NAMING and isinstance(value, str) else _renamed(value, folder)
        for key, value in told.items()
    }


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
        store: Store | None = None,
        cache_bytes: int = 256 << 20,
    ) -> None:
        self.manifest = manifest
        self.source = source
        self.warnings = warnings
        self.cache_bytes = cache_bytes
        self._store: Store = store or _Memory(frames or {}, spectra or {}, targets or {})
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

    def with_frames(self, frames: Mapping[str, NDArray[Any]]) -> RecordingSet:
        """The same set with other frames (uint16) at some of its paths."""
        return RecordingSet(
            self.manifest,
            source=self.source,
            warnings=self.warnings,
            store=_Overlaid(self._store, frames),
            cache_bytes=self.cache_bytes,
        )

    def joined(self, later: RecordingSet, folder: str) -> RecordingSet:
        """This set with the captures of a later one of the same cameras, whose ids and paths get `folder/` before them."""
        told = (_renamed(c.model_dump(mode="json", exclude_unset=True), folder) for c in later.manifest.captures)
        captures = (*self.manifest.captures, *Manifest.model_validate({"cameras": {}, "captures": list(told)}).captures)
        return RecordingSet(
            self.manifest.model_copy(update={"captures": captures}),
            source=self.source,
            warnings=(*self.warnings, *later.warnings),
            store=_Joined(self._store, later._store, folder),
            cache_bytes=self.cache_bytes,
        )

    def without(self, ids: Container[str]) -> RecordingSet:
        """The same set less the captures of these ids; frames, spectra and targets are shared."""
        kept = tuple(c for c in self.manifest.captures if c.id not in ids)
        return RecordingSet(
            self.manifest.model_copy(update={"captures": kept}),
            source=self.source,
            warnings=self.warnings,
            store=self._store,
            cache_bytes=self.cache_bytes,
        )

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
            raise InputError(f"{self.where(capture.frame)} (capture {capture.id}): {error}") from error
        frame.flags.writeable = False
        with self._lock:
            if capture.frame not in self._cache and frame.nbytes <= self.cache_bytes:
                self._cache[capture.frame] = frame
                self._held += frame.nbytes
                while self._held > self.cache_bytes:
                    self._held -= self._cache.popitem(last=False)[1].nbytes
        return frame

    def let_go(self) -> None:
        """Free the frames that are kept for being read again."""
        with self._lock:
            self._cache.clear()
            self._held = 0

    def spectrum(self, path: str) -> Spectrum:
        """The spectrum that the manifest calls `path`."""
        try:
            return self._store.spectrum(path)
        except InputError as error:
            raise InputError(f"{self.where(path)}: {error}") from error

    def target(self, path: str) -> Target:
        """What was shown on the screen: uint8 (rows, cols) of 0 and 1."""
        try:
            return self._store.target(path)
        except InputError as error:
            raise InputError(f"{self.where(path)}: {error}") from error

    def file(self, path: str) -> Path | None:
        """The file behind a path of the manifest, or None for a set in memory."""
        return self._store.file(path)

    def where(self, path: str) -> str:
        """How messages call what the manifest names `path`."""
        return self._store.where(path)


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


# --- looking at everything, up front -----------------------------------------------------------------------------------


def _unknown_keys(where: str, item: Open) -> Iterator[str]:
    for key in item.unknown_keys():
        yield f"{where}: unknown key '{key}' is kept but not used; check its spelling"
    for name, value in item:
        if isinstance(value, Open):
            yield from _unknown_keys(f"{where}, {name}", value)


def _spectra_of(capture: Capture) -> dict[str, str]:
    """Key -> path of every spectrum that a capture names."""
    named = {key: getattr(capture, key, None) for key in ("radiance", "dark_radiance", "light_radiance")}
    screen = getattr(capture, "screen", None)
    if isinstance(screen, Screen):
        named["screen.radiance"] = screen.radiance
    return {key: path for key, path in named.items() if path is not None}


def _camera_problems(camera: Camera) -> Iterator[str]:
    limit = 2**camera.bit_depth - 1
    if camera.white_level_dn is not None and camera.white_level_dn > limit:
        yield f"white_level_dn = {camera.white_level_dn:g} is above what {camera.bit_depth} bits hold ({limit}); correct one"
    if camera.black_level_dn is not None and camera.black_level_dn >= camera.saturation_dn:
        yield f"black_level_dn = {camera.black_level_dn:g} isn't below the white level {camera.saturation_dn:g}; correct one"
    for channel in camera.quantum_efficiency or {}:
        if channel not in camera.channels:
            yield (
                f"quantum_efficiency of a channel '{channel}', but a {camera.cfa} sensor has "
                f"{', '.join(camera.channels)}; rename it"
            )


def _capture_problems(capture: Capture, camera: Camera) -> Iterator[str]:
    if isinstance(capture, SlantedEdge) and capture.region is not None:
        row0, col0, row1, col1 = capture.region
        if not (0 <= row0 < row1 <= camera.rows and 0 <= col0 < col1 <= camera.cols):
            yield (
                f"region {list(capture.region)} isn't inside the frame of {camera.rows} x {camera.cols}; "
                "give [row0, col0, row1, col1], end excluded"
            )
    if isinstance(capture, Chart):
        for row, col in capture.corners:
            if not (-0.5 <= row <= camera.rows - 0.5 and -0.5 <= col <= camera.cols - 0.5):
                yield f"corner [{row:g}, {col:g}] is outside the frame of {camera.rows} x {camera.cols}; give [row, col]"
    if isinstance(capture, Charuco):
        if capture.marker_mm is None and capture.dictionary != "none":
            yield "marker_mm is missing; give the markers' side, or dictionary 'none' for a plain checkerboard"
        if capture.marker_mm is not None and capture.marker_mm >= capture.square_mm and capture.dictionary != "none":
            yield f"markers of {capture.marker_mm:g} mm don't fit squares of {capture.square_mm:g} mm; correct one"
        if min(capture.squares) < 2:
            yield f"squares {list(capture.squares)} make no board; give [rows, cols] of squares, 2 at least"


#: More than this share of a channel's pixels clipped: the capture says nothing of that channel's level.
CLIPPED_LIMIT = 0.5
#: A narrowband light's centre this far and a quarter of its bandwidth off the wavelength set is remarked on.
OFF_NAME_NM = 3.0
#: A saturated flat belongs to an exposure ladder when that many unsaturated levels lie below it ...
LADDER_LEVELS = 3
#: ... and these foretell at least this share of the white level for it (lamps and sensors aren't exactly linear).
LADDER_REACH = 0.85


@dataclass(frozen=True)
class _FlatLevel:
    """What the check of saturated flats keeps of one flat: means and clipped shares by channel."""

    id: str
    where: str
    gain_db: float | None
    light: float  # proportional to the photons, on the scale of that name
    scale: str
    mean_dn: dict[str, float]
    clipped: dict[str, float]


@dataclass
class _Findings:
    problems: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def _channel_planes(frame: Frame, camera: Camera) -> dict[str, list[Frame]]:
    """Each channel's planes: both green phases for `G`, the whole frame for `Y`."""
    step = 1 if camera.cfa == "MONO" else 2
    planes: dict[str, list[Frame]] = defaultdict(list)
    for row in range(step):
        for col in range(step):
            plane = frame[row::step, col::step]
            if plane.size:
                planes["Y" if step == 1 else camera.cfa[2 * row + col]].append(plane)
    return planes


def clipped_share(frame: Frame, camera: Camera) -> dict[str, float]:
    """Share of each channel's pixels that are clipped: at the white level, or all at one value above half of the range.

    A sensor whose full well lies below the converter's range saturates short of `white_level_dn`: photon noise never puts
    half of the pixels on the highest value, so a channel that does is clipped as well.
    """
    black = camera.black_level_dn or 0.0
    middle = black + (camera.saturation_dn - black) / 2
    shares = {}
    for channel, planes in _channel_planes(frame, camera).items():
        highest = max(float(plane.max()) for plane in planes)
        at = highest if highest > middle else camera.saturation_dn
        shares[channel] = sum(int(np.count_nonzero(plane >= at)) for plane in planes) / sum(p.size for p in planes)
    return shares


def _light(recordings: RecordingSet, flat: Flat) -> tuple[float, str]:
    """The light of a flat on a scale, and the scale's name: flats are comparable on one scale only."""
    if flat.photons_per_pixel is not None:
        return flat.photons_per_pixel, f"photons at {flat.wavelength_nm}"
    if flat.radiance is None:
        return flat.exposure_s, "exposure"
    spectrum = recordings.spectrum(flat.radiance)
    return flat.exposure_s * float(np.trapezoid(spectrum.value, spectrum.wavelength_nm)), "radiance"


def _why_not_a_ladder(level: _FlatLevel, channel: str, levels: list[_FlatLevel], black: float) -> str | None:
    """Why the clipped `channel` of a flat isn't the top of an exposure ladder, with the remedy; None where it is.

    EMVA 1288 needs exposures up to and beyond saturation, so a clipped flat is right where at least `LADDER_LEVELS`
    unclipped levels of the same gain and light lie below it, their slope foretells that it clips, and its repeats clip too.
    """
    unclipped = [
        other
        for other in levels
        if (other.gain_db, other.scale) == (level.gain_db, level.scale) and other.clipped[channel] <= CLIPPED_LIMIT
    ]
    for other in unclipped:
        if other.light >= level.light and other.clipped[channel] < CLIPPED_LIMIT / 5:
            return f"but {other.id} with as much light isn't; recapture it"
    below = sorted((other for other in unclipped if 0 < other.light < level.light), key=lambda other: other.light)
    if len({other.light for other in below}) < LADDER_LEVELS:
        return f"expose shorter, or add {LADDER_LEVELS} unsaturated levels below it"
    slope = float(np.median([(other.mean_dn[channel] - black) / other.light for other in below[-LADDER_LEVELS:]]))
    if slope * level.light < LADDER_REACH * (level.mean_dn[channel] - black):
        return f"but the flats below it foretell {black + slope * level.light:.0f} DN; recapture it"
    return None


def _saturated_flats(levels: list[_FlatLevel], camera: Camera) -> Iterator[str]:
    """One line for each flat that is clipped without being the top of an exposure ladder."""
    for level in levels:
        for channel, share in level.clipped.items():
            if share <= CLIPPED_LIMIT:
                continue
            if why := _why_not_a_ladder(level, channel, levels, camera.black_level_dn or 0.0):
                yield f"{level.where}: saturated flat, {100 * share:.0f} % of the {channel} pixels are clipped; {why}"
                break


def _check_frames(recordings: RecordingSet, found: _Findings) -> None:
    """Every frame, loaded once."""
    flats: dict[Side, list[_FlatLevel]] = defaultdict(list)
    clipped_of: dict[tuple[Side, str], list[str]] = defaultdict(list)
    for capture in recordings.manifest.captures:
        camera = recordings.manifest.cameras[capture.side]
        try:
            frame = recordings.frame(capture)
        except InputError as error:
            found.problems.append(str(error))
            continue
        if isinstance(capture, Dark | Charuco):
            continue
        clipped = clipped_share(frame, camera)
        if isinstance(capture, Flat):
            try:
                light, scale = _light(recordings, capture)
            except InputError:  # named with the spectra
                continue
            planes = _channel_planes(frame, camera)
            mean_dn = {name: float(np.mean([plane.mean() for plane in planes[name]])) for name in planes}
            where = f"{recordings.where(capture.frame)} (capture {capture.id})"
            flats[capture.side].append(_FlatLevel(capture.id, where, capture.gain_db, light, scale, mean_dn, clipped))
        elif max(clipped.values()) > CLIPPED_LIMIT:
            clipped_of[capture.side, capture.kind].append(capture.id)
    for side, levels in flats.items():
        found.problems += _saturated_flats(levels, recordings.manifest.cameras[side])
    for (side, kind), ids in clipped_of.items():
        named = ", ".join(ids[:3]) + (f" .. {ids[-1]}" if len(ids) > 3 else "")
        found.warnings.append(
            f"{recordings.source}: {len(ids)} {kind} captures of the {side} camera have a channel clipped ({named}); "
            "what a clipped channel saw is not used; expose shorter"
        )


def _check_cameras(recordings: RecordingSet, found: _Findings) -> None:
    for side, camera in recordings.manifest.cameras.items():
        where = f"{recordings.source}: camera {side}"
        found.warnings += _unknown_keys(where, camera)
        found.problems += [f"{where}: {problem}" for problem in _camera_problems(camera)]
        if camera.lens_file is not None:
            try:
                recordings.file(camera.lens_file)
            except InputError as error:
                found.problems.append(f"{recordings.where(camera.lens_file)} (lens_file of camera {side}): {error}")


def _check_captures(recordings: RecordingSet, found: _Findings) -> None:
    manifest, source = recordings.manifest, recordings.source
    for id, count in Counter(capture.id for capture in manifest.captures).items():
        if count > 1:
            found.problems.append(f"{source}: capture id '{id}' is used {count} times; give every capture its own")
    framed: dict[str, Capture] = {}
    for capture in manifest.captures:
        where = f"{source}: capture {capture.id}"
        found.warnings += _unknown_keys(where, capture)
        found.problems += [f"{where}: {text}" for text in _capture_problems(capture, manifest.cameras[capture.side])]
        if isinstance(capture, Flat) and capture.radiance is None and capture.photons_per_pixel is None:
            found.warnings.append(
                f"{where}: neither radiance nor photons_per_pixel: it tells of noise, not of sensitivity; add what is known"
            )
        first = framed.setdefault(capture.frame, capture)
        if first is not capture and not isinstance(capture, SlantedEdge):
            found.warnings.append(f"{where}: its frame is that of {first.id} too, so it is no repeat; check the path")


def _check_spectra_and_targets(recordings: RecordingSet, found: _Findings) -> None:
    manifest = recordings.manifest
    efficiencies = {
        path: f"quantum_efficiency {channel} of camera {side}"
        for side, camera in manifest.cameras.items()
        for channel, path in (camera.quantum_efficiency or {}).items()
    }
    lights: dict[str, str] = {}
    targets: dict[str, str] = {}
    for capture in manifest.captures:
        for key, path in _spectra_of(capture).items():
            lights.setdefault(path, f"{key} of capture {capture.id}")
        if isinstance(capture, Checkerboard | Bernoulli):
            targets.setdefault(capture.target, f"target of capture {capture.id}")
    for path, user in [*efficiencies.items(), *lights.items()]:
        where = f"{recordings.where(path)} ({user})"
        try:
            lowest, highest = min(value := recordings.spectrum(path).value), max(value)
        except InputError as error:
            found.problems.append(f"{where}: {error.__cause__}")
            continue
        if user.startswith("quantum_efficiency") and not 0 <= lowest <= highest <= 1:
            found.problems.append(
                f"{where}: {lowest:g}..{highest:g} isn't a quantum efficiency of 0..1 electrons a photon; "
                "divide percent by 100"
            )
        elif not user.startswith("quantum_efficiency") and highest <= 0:
            found.warnings.append(f"{where}: no light at any wavelength; was the shutter open?")
    found.warnings += _lights_off_their_names(recordings)
    for path, user in targets.items():
        try:
            recordings.target(path)
        except InputError as error:
            found.problems.append(f"{recordings.where(path)} ({user}): {error.__cause__}")


def _lights_off_their_names(recordings: RecordingSet) -> Iterator[str]:
    """One line on the narrowband lights whose measured centre, over what exceeds half of the maximum, isn't the wavelength set."""
    off: dict[str, str] = {}
    for capture in recordings.manifest.captures:
        if not isinstance(capture, Narrowband) or capture.radiance in off:
            continue
        try:
            wavelength, value = recordings.spectrum(capture.radiance).arrays
        except InputError:  # named with the spectra
            continue
        if value.max() > 0:
            share = value / value.max()
            above = share > 0.5
            centre_nm = float(np.average(wavelength[above], weights=share[above]))
            if abs(centre_nm - capture.wavelength_nm) > OFF_NAME_NM + 0.25 * (capture.bandwidth_nm or 0.0):
                off[capture.radiance] = f"{capture.wavelength_nm:g} nm: {centre_nm:.1f} nm"
    if off:
        yield (
            f"{recordings.source}: {len(off)} narrowband lights are centred elsewhere than they are set ({'; '.join(off.values())}); "
            "their measured spectra are used; correct wavelength_nm, or measure again"
        )


def inspect(recordings: RecordingSet) -> tuple[list[str], list[str]]:
    """(problems, warnings) of a recording set, one line each: everything that `read` refuses and everything it remarks.

    Looks at every frame, spectrum and target once.
    """
    found = _Findings(warnings=list(_unknown_keys(f"{recordings.source}: manifest", recordings.manifest)))
    _check_cameras(recordings, found)
    _check_captures(recordings, found)
    _check_spectra_and_targets(recordings, found)
    _check_frames(recordings, found)
    return found.problems, found.warnings


# --- reading and writing -----------------------------------------------------------------------------------------------

_CAPTURE: TypeAdapter[AnyCapture] = TypeAdapter(AnyCapture)


def _schema_lines(where: str, error: ValidationError) -> Iterator[str]:
    for item in error.errors():
        kinds = get_args(Kind)
        key = ".".join(str(part) for part in item["loc"] if part not in kinds)
        if item["type"] == "missing":
            yield f"{where}: the key '{key}' is missing; add it"
        else:
            given = "" if isinstance(item["input"], dict | list) else f" (it is {item['input']!r})"
            yield f"{where}: {key or 'it'}: {item['msg'][:1].lower()}{item['msg'][1:]}{given}; correct it"


def _usable_captures(listed: list[Any], where: str, sides: Container[str], found: _Findings) -> list[AnyCapture]:
    captures: list[AnyCapture] = []
    for number, item in enumerate(listed):
        at = f"{where}: captures[{number}]"
        if not isinstance(item, dict):
            found.problems.append(f"{at}: isn't an object; write the capture's keys")
            continue
        at += f" ({item['id']})" if item.get("id") is not None else ""
        kind = item.get("kind")
        if isinstance(kind, str) and kind not in get_args(Kind):
            found.warnings.append(f"{at}: unknown kind '{kind}' is skipped; the kinds are {', '.join(get_args(Kind))}")
            continue
        if kind == "chart" and item.get("chart") not in (None, "ColorChecker24"):
            found.warnings.append(f"{at}: unknown chart {item['chart']!r} is skipped; only ColorChecker24 is known")
            continue
        try:
            capture = _CAPTURE.validate_python(item)
        except ValidationError as error:
            found.problems += _schema_lines(at, error)
            continue
        if capture.side not in sides:
            found.problems.append(f"{at}: no camera '{capture.side}' in cameras; describe it, or correct the side")
            continue
        captures.append(capture)
    return captures


def parse_manifest(text: str, where: str) -> tuple[Manifest, list[str]]:
    """The manifest in JSON `text`, and warnings on what was skipped. RecordingError with one line for each problem."""
    try:
        raw = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise RecordingError([f"{where}: isn't JSON ({_reason(error)}); write it again"]) from error
    if not isinstance(raw, dict):
        raise RecordingError([f"{where}: isn't a JSON object; write the keys of the recording-set format"])
    if raw.get("format") != "calibench-recording" or raw.get("version") != 1:
        given = f"format {raw.get('format')!r} version {raw.get('version')!r}"
        raise RecordingError([f"{where}: {given}, not 'calibench-recording' 1; give a recording set of that version"])
    found = _Findings()
    listed, cameras = raw.get("captures"), raw.get("cameras")
    captures: list[AnyCapture] = []
    if isinstance(listed, list):
        # Where the cameras themselves are wrong, that is said once, below.
        sides = cameras if isinstance(cameras, dict) and cameras else get_args(Side)
        captures = _usable_captures(listed, where, sides, found)
        raw["captures"] = ()
        if not captures and not found.problems:
            found.problems += [*found.warnings, f"{where}: no capture that can be used; list what was captured"]
    manifest: Manifest | None = None
    try:
        manifest = Manifest.model_validate(raw)
    except ValidationError as error:
        found.problems += _schema_lines(where, error)
    if manifest is not None and not manifest.cameras:
        found.problems.append(f"{where}: cameras is empty; describe the left camera at least")
    if found.problems or manifest is None:
        raise RecordingError(found.problems)
    return manifest.model_copy(update={"captures": tuple(captures)}), found.warnings


def read(path: str | os.PathLike[str], *, progress: Callable[[str], None] | None = None) -> RecordingSet:
    """The recording set in the folder `path`, looked through completely.

    Raises RecordingError (an InputError) with one line for everything that can't be used; what is merely odd (unknown
    keys, skipped kinds) stands in `.warnings`.
    """
    root = Path(path)
    if root.name == "manifest.json" and root.is_file():
        root = root.parent
    if not root.is_dir():
        raise RecordingError([f"{root}: no such folder; give the folder of a recording set"])
    try:
        text = _locate(root, "manifest.json").read_text(encoding="utf-8-sig")
    except (InputError, OSError, UnicodeDecodeError) as error:
        raise RecordingError([f"{root / 'manifest.json'}: {_reason(error)}"]) from error
    manifest, skipped = parse_manifest(text, str(root / "manifest.json"))
    recordings = RecordingSet(manifest, source=str(root), store=FolderStore(root))
    if progress:
        progress(f"looking through {len(manifest.captures)} captures")
    problems, warnings = inspect(recordings)
    if problems:
        raise RecordingError([*skipped, *problems])  # whoever mends the folder wants to hear of all of it
    recordings.warnings = (*skipped, *warnings)
    return recordings


def format_spectrum(spectrum: Spectrum) -> str:
    """A spectrum as the format's CSV; reading it gives the same numbers bit for bit."""
    rows = (f"{at!r},{height!r}\n" for at, height in zip(spectrum.wavelength_nm, spectrum.value, strict=True))
    return "wavelength_nm,value\n" + "".join(rows)


def manifest_json(manifest: Manifest) -> str:
    """A manifest as JSON text: the keys that were given, unknown ones too."""
    kept = manifest.model_dump(mode="json", exclude_unset=True)
    head = {key: getattr(manifest, key) for key in ("format", "version", "name", "notes")}
    return json.dumps(head | kept, indent=1, ensure_ascii=False) + "\n"


def _write_into(recordings: RecordingSet, root: Path) -> None:
    def place(path: str) -> Path:
        pure = PurePosixPath(path)
        if "\\" in path or pure.is_absolute() or ".." in pure.parts or path == "manifest.json":
            raise InputError(
                f"{recordings.source}: the path '{path}' leaves the folder; name it frames/..., spectra/..."
            )
        file = root / pure
        file.parent.mkdir(parents=True, exist_ok=True)
        return file

    manifest = recordings.manifest
    written: set[str] = set()
    for capture in manifest.captures:
        if capture.frame in written:
            continue
        written.add(capture.frame)
        file, there = place(capture.frame), recordings.file(capture.frame)
        if there is not None:
            shutil.copyfile(there, file)  # the bytes themselves, whatever the container
            continue
        frame = recordings.frame(capture)
        if file.suffix == ".npy":
            np.save(file, frame, allow_pickle=False)
        elif file.suffix in (".tif", ".tiff"):
            tifffile.imwrite(file, frame, photometric="minisblack", metadata=None)
        else:
            raise InputError(f"{recordings.source}: can't write a frame to '{capture.frame}'; name it .npy or .tif")
    spectra = {path for capture in manifest.captures for path in _spectra_of(capture).values()}
    for camera in manifest.cameras.values():
        spectra |= set((camera.quantum_efficiency or {}).values())
        if camera.lens_file is not None and (there := recordings.file(camera.lens_file)) is not None:
            shutil.copyfile(there, place(camera.lens_file))
    for path in spectra:
        there = recordings.file(path)
        text = format_spectrum(recordings.spectrum(path)) if there is None else there.read_text(encoding="utf-8")
        place(path).write_text(text, encoding="utf-8")
    for path in {c.target for c in manifest.captures if isinstance(c, Checkerboard | Bernoulli)}:
        np.save(place(path), recordings.target(path), allow_pickle=False)
    (root / "manifest.json").write_text(manifest_json(manifest), encoding="utf-8")


def write(recordings: RecordingSet, path: str | os.PathLike[str]) -> Path:
    """Write a recording set as the folder `path`: completely, or not at all. Frames stay bit-exact.

    Raises InputError where `path` exists and isn't an empty folder, and RecordingError where the set itself would be
    refused by `read`.
    """
    folder = Path(path)
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise InputError(f"{folder}: already exists; give a new folder, or take that one away")
    problems, _ = inspect(recordings)
    if problems:
        raise RecordingError(problems)
    folder.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", suffix=".partial", dir=folder.parent))
    try:
        _write_into(recordings, partial)
        partial.chmod(0o755)
        if folder.exists():
            folder.rmdir()
        partial.rename(folder)
    except OSError as error:
        shutil.rmtree(partial, ignore_errors=True)
        raise InputError(
            f"{folder}: can't be written ({_reason(error)}); make room or choose another folder"
        ) from error
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    return folder
