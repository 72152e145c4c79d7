"""A recording set in use: the manifest, and its frames, spectra and targets when they are asked for."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Container, Hashable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar, cast, get_args, overload

import numpy as np
from numpy.typing import NDArray

from lab.capture_kinds.base import Capture, in_folder
from lab.errors import InputError, NotDetermined
from lab.formats.recording_set.files import Frame, JoinedFiles, MemoryFiles, OverlaidFiles, RecordingFiles, Target
from lab.formats.recording_set.frame_codes import FrameCodes
from lab.formats.recording_set.manifest import DataSheet, Manifest
from lab.shown import Tabular
from sim.camera import Side
from sim.sensor.margins import NO_MARGINS
from sim.spectrum import Spectrum

C = TypeVar("C", bound=Capture)
T = TypeVar("T")


@dataclass(frozen=True)
class Summaries:
    """Summaries of frames by key: those that hold whatever is stated, and those under one manifest."""

    of_frames: dict[Hashable, Any] = field(default_factory=dict)
    of_manifest: dict[Hashable, Any] = field(default_factory=dict)

    @property
    def made(self) -> Summaries:
        """A copy without those that couldn't be made."""
        of_frames, of_manifest = (
            {key: summary for key, summary in kept.items() if not isinstance(summary, NotDetermined)}
            for kept in (self.of_frames, self.of_manifest)
        )
        return Summaries(of_frames, of_manifest)


class RecordingSet(Tabular):
    """A manifest with its frames, spectra and targets. Frames are loaded when asked for, and `cache_bytes` of them are
    kept. The codes of every frame are counted once and stay.

    It comes from a folder by `read`, or from memory: `frames`, `spectra` and `targets` by the paths in the manifest. It
    can be shared between threads and sent to another process.
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
        files: RecordingFiles | None = None,
        cache_bytes: int = 256 << 20,
    ) -> None:
        self.manifest = manifest
        self.source = source
        self.warnings = warnings
        self.cache_bytes = cache_bytes
        self._files: RecordingFiles = files or MemoryFiles(frames or {}, spectra or {}, targets or {})
        self._cache: OrderedDict[str, Frame] = OrderedDict()
        self._held = 0
        self._summaries = Summaries()
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_cache": OrderedDict(), "_held": 0, "_summaries": self._summaries.made, "_lock": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ |= state | {"_lock": threading.Lock()}

    @property
    def sides(self) -> tuple[Side, ...]:
        """The sides that have a camera, left first."""
        return tuple(side for side in get_args(Side) if side in self.manifest.cameras)

    def camera(self, side: Side) -> DataSheet:
        """Return the data sheet of the camera of `side`. Raises InputError where there is none."""
        if side not in self.manifest.cameras:
            raise InputError(f"{self.source}: no camera '{side}', only {', '.join(self.sides)}; ask for one of these")
        return self.manifest.cameras[side]

    @overload
    def captures(self, kind: type[C], side: Side | None = None) -> list[C]: ...
    @overload
    def captures(self, kind: None = None, side: Side | None = None) -> list[Capture]: ...
    @overload
    def captures(self, kind: str, side: Side | None = None) -> list[Any]: ...

    def captures(self, kind: str | type[Capture] | None = None, side: Side | None = None) -> Any:
        """Captures in the manifest's order, of one kind (its class or its name) and one side, or of all."""
        return [
            capture
            for capture in self.manifest.captures
            if (side is None or capture.side == side)
            and (kind is None or (capture.kind == kind if isinstance(kind, str) else isinstance(capture, kind)))
        ]

    def with_frames(self, frames: Mapping[str, NDArray[Any]]) -> RecordingSet:
        """Return the same set with other frames (uint16) at some of its paths."""
        return self._copy(files=OverlaidFiles(self._files, frames))

    def joined(self, later: RecordingSet, folder: str) -> RecordingSet:
        """This set with the captures of a later one of the same cameras. The later one's ids, paths and poses begin
        with `folder/`."""
        captures = (*self.manifest.captures, *(in_folder(capture, folder) for capture in later.manifest.captures))
        return self._copy(
            manifest=self.manifest.model_copy(update={"captures": captures}),
            warnings=(*self.warnings, *later.warnings),
            files=JoinedFiles(self._files, later._files, folder),
        )

    def without(self, ids: Container[str]) -> RecordingSet:
        """Return the same set less the captures of these ids; frames, spectra and targets are shared."""
        kept = tuple(c for c in self.manifest.captures if c.id not in ids)
        return self.under(self.manifest.model_copy(update={"captures": kept}))

    def under(self, manifest: Manifest) -> RecordingSet:
        """Return the same frames, spectra and targets as `manifest` describes them."""
        return self._copy(manifest=manifest)

    def for_one_of(self, processes: int) -> RecordingSet:
        """Return the same set for one of several processes, which together keep as many frames as this set would."""
        return self._copy(cache_bytes=self.cache_bytes // processes)

    def _copy(
        self,
        manifest: Manifest | None = None,
        warnings: tuple[str, ...] | None = None,
        files: RecordingFiles | None = None,
        cache_bytes: int | None = None,
    ) -> RecordingSet:
        """Return a set with an empty cache of frames; what isn't given is this set's. Where the files are the same, it
        shares the summaries of frames, and under the same manifest all of them."""
        copy = RecordingSet(
            self.manifest if manifest is None else manifest,
            source=self.source,
            warnings=self.warnings if warnings is None else warnings,
            files=self._files if files is None else files,
            cache_bytes=self.cache_bytes if cache_bytes is None else cache_bytes,
        )
        if files is None:
            summaries_of_manifest = self._summaries.of_manifest if manifest is None else {}
            copy._summaries = Summaries(self._summaries.of_frames, summaries_of_manifest)
        return copy

    def capture(self, id: str) -> Capture:
        """Return the capture called `id`; InputError where there is none."""
        for capture in self.manifest.captures:
            if capture.id == id:
                return capture
        raise InputError(f"{self.source}: no capture '{id}'; the manifest lists {len(self.manifest.captures)} others")

    def frame(self, capture: Capture) -> Frame:
        """Raw DN of a capture: uint16 (rows, cols) of the active area, read-only. Raises InputError where the file
        contradicts the manifest."""
        whole, camera = self.whole_frame(capture), self.camera(capture.side)
        if whole.shape == (camera.rows, camera.cols):
            return whole
        frame = np.ascontiguousarray(camera.margins.active(whole))
        frame.flags.writeable = False
        return frame

    def whole_frame(self, capture: Capture) -> Frame:
        """Return the raw DN of a capture with its margins: uint16 (rows, cols), read-only; a frame that was stored
        without them is its active area. Raises InputError where the file contradicts the manifest."""
        with self._lock:
            if capture.frame in self._cache:
                self._cache.move_to_end(capture.frame)
                return self._cache[capture.frame]
        camera = self.camera(capture.side)
        try:
            frame = self._files.frame(capture.frame, camera)
            if problem := frame_problem(frame, camera):
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

    def codes(self, capture: Capture) -> FrameCodes:
        """Return how often each code comes in the frame of a capture. Counted once, whatever the manifest states."""
        return self.once(
            ("codes", capture.frame),
            lambda: FrameCodes.count(self.frame(capture), with_digest=True),
            whatever_is_stated=True,
        )

    def once(self, key: Hashable, make: Callable[[], T], *, whatever_is_stated: bool = False) -> T:
        """Return the summary of frames called `key`, made by `make` when it is first asked for. Where that raised
        NotDetermined, it is raised again.

        A summary is small against its frames: it outlives them (`let_go`), and goes with the set to other processes.
        `whatever_is_stated`: it holds for all sets of the same frames, as `key` holds all that it depends on, frames by
        their paths; else for sets under the same manifest.
        """
        kept = self._summaries.of_frames if whatever_is_stated else self._summaries.of_manifest
        if key not in kept:
            try:
                made: Any = make()
            except NotDetermined as refused:
                made = refused
            with self._lock:
                kept.setdefault(key, made)
        summary = kept[key]
        if isinstance(summary, NotDetermined):
            raise NotDetermined(summary.step, summary.reason)
        return cast(T, summary)

    @property
    def summaries(self) -> Summaries:
        """The summaries that were made so far, without those that couldn't be made."""
        with self._lock:
            return self._summaries.made

    def keep(self, summaries: Summaries) -> None:
        """Keep summaries that another process made of this set."""
        with self._lock:
            self._summaries.of_frames.update(summaries.of_frames)
            self._summaries.of_manifest.update(summaries.of_manifest)

    def let_go(self) -> None:
        """Free the cached frames."""
        with self._lock:
            self._cache.clear()
            self._held = 0

    def spectrum(self, path: str) -> Spectrum:
        """Return the spectrum that the manifest calls `path`."""
        try:
            return self._files.spectrum(path)
        except InputError as error:
            raise InputError(f"{self.where(path)}: {error}") from error

    def target(self, path: str) -> Target:
        """Return what was shown on the screen: uint8 (rows, cols) of 0 and 1."""
        try:
            return self._files.target(path)
        except InputError as error:
            raise InputError(f"{self.where(path)}: {error}") from error

    def file(self, path: str) -> Path | None:
        """Return the file behind a path of the manifest, or None for a set in memory."""
        return self._files.file(path)

    def where(self, path: str) -> str:
        """Return how messages call the file that the manifest names `path`."""
        return self._files.where(path)


def frame_problem(frame: Frame, camera: DataSheet) -> str | None:
    """Why `frame` can't be a frame of `camera`, with the remedy; None where it can."""
    if frame.shape not in (camera.frame_shape, (camera.rows, camera.cols)):
        rows, cols = camera.frame_shape
        margins = "" if camera.margins == NO_MARGINS else " with the margins"
        return (
            f"{frame.shape[0]} x {frame.shape[1]} pixels (rows x cols), but the manifest says "
            f"{rows} x {cols}{margins}; recapture, or correct rows and cols{margins and ', or margins'}"
        )
    highest, limit = int(frame.max()), 2**camera.bit_depth - 1
    if highest > limit:
        return f"{highest} DN is above what {camera.bit_depth} bits hold ({limit} DN); {_remedy(frame, camera)}"
    if highest > camera.saturation_dn:
        return (
            f"{highest} DN is above white_level_dn = {camera.saturation_dn:g} DN; correct white_level_dn, or save raw "
            "DN unscaled"
        )
    return None


def _remedy(frame: Frame, camera: DataSheet) -> str:
    """Return what to do about codes above the bit depth: codes that are all multiples of 2^n are of fewer bits."""
    shift = 0
    while shift < 15 and not np.any(frame & ((2 << shift) - 1)):
        shift += 1
    if shift and int(frame.max()) >> shift < 2**camera.bit_depth:
        return (
            f"its codes are multiples of {1 << shift}, as codes of {camera.bit_depth} bits shifted up by {shift} are "
            f"(left-aligned): state bit_depth = {camera.bit_depth + shift} and levels in stored codes, or save raw DN "
            "unshifted"
        )
    return "correct bit_depth, or save raw DN unscaled"
