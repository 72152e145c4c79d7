"""A finished session in one HDF5 file of the NeXus layout."""

from __future__ import annotations

import contextlib
import json
import os
import zlib
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from lab.capture.records import RunRecord, SessionInfo, StoredFile
from lab.capture_kinds.base import Capture
from lab.formats.recording_set import RecordingSet, manifest_json

_GZIP_LEVEL = 1  # of frames that are mostly noise, level 6 saves 2 % more and takes three times as long
_PACKERS = 2


def _group(parent: h5py.Group, name: str, nx_class: str) -> h5py.Group:
    group = parent.create_group(name)
    group.attrs["NX_class"] = nx_class
    return group


def _chunk(frame: NDArray[np.uint16]) -> bytes:
    """Return a frame as HDF5's shuffle and gzip filters encode it. HDF5's own filters would block other threads; zlib
    doesn't."""
    shuffled = np.ascontiguousarray(frame.astype("<u2").view(np.uint8).reshape(-1, 2).T)
    return zlib.compress(shuffled.tobytes(), _GZIP_LEVEL)


def _chunks(recordings: RecordingSet, captures: Sequence[Capture]) -> Generator[bytes, None, None]:
    """Yield the frames as chunks, packed by threads. Closing it drops those that weren't begun: leaving the pool alone
    would pack them all."""
    with ThreadPoolExecutor(_PACKERS, thread_name_prefix="pack") as pool:
        yield from pool.map(lambda capture: _chunk(recordings.whole_frame(capture)), captures)


@contextlib.contextmanager
def _fresh(path: Path) -> Iterator[h5py.File]:
    """An HDF5 file that is written. Where that fails, its content is given up first: HDF5 can't close a file on a full
    disk, and would try again and again."""
    file = h5py.File(path, "w")
    try:
        yield file
        file.close()
    except BaseException:
        with contextlib.suppress(OSError):
            os.truncate(path, 0)
        with contextlib.suppress(OSError, RuntimeError):
            file.close()
        raise


def write_nexus(
    path: Path,
    recordings: RecordingSet,
    info: SessionInfo,
    runs: Sequence[RunRecord],
    files: Sequence[StoredFile],
    progress: Callable[[str, float], None] | None,
) -> dict[str, int]:
    """Write the NeXus-layout file; returns the index of every frame in its side's stack.

    `/entry/instrument/SIDE` is an NXdetector whose `data` stacks that side's frames in the order in which they were
    taken; `/entry/spectra` and `/entry/targets` hold the rest, `/entry/manifest` the manifest as JSON."""
    first = {capture.frame: capture for capture in reversed(recordings.manifest.captures)}
    frames = [stored for stored in files if stored.role == "frame"]
    index: dict[str, int] = {}
    with _fresh(path) as file:
        file.attrs["NX_class"] = "NXroot"
        file.attrs["default"] = "entry"
        entry = _group(file, "entry", "NXentry")
        entry["title"] = info.name or info.id
        entry["entry_identifier"] = info.id
        entry["start_time"] = info.created.isoformat()
        entry["program_name"] = "calibench"
        entry["manifest"] = manifest_json(recordings.manifest)
        entry["provenance"] = json.dumps([run.model_dump(mode="json") for run in runs])
        instrument = _group(entry, "instrument", "NXinstrument")
        done = 0
        for side in recordings.sides:
            camera = recordings.manifest.cameras[side]
            mine = [stored for stored in frames if stored.side == side]
            detector = _group(instrument, side, "NXdetector")
            data = detector.create_dataset(
                "data",
                shape=(len(mine), *camera.frame_shape),
                dtype=np.dtype("<u2"),
                chunks=(1, *camera.frame_shape) if mine else None,
                compression="gzip" if mine else None,
                compression_opts=_GZIP_LEVEL if mine else None,
                shuffle=bool(mine),
            )
            data.attrs["units"] = "DN"
            with contextlib.closing(_chunks(recordings, [first[stored.path] for stored in mine])) as chunks:
                for at, (stored, chunk) in enumerate(zip(mine, chunks, strict=True)):
                    data.id.write_direct_chunk((at, 0, 0), chunk)
                    index[stored.path] = at
                    done += 1
                    if progress:
                        progress("packing the session", done / len(frames))
            detector["frame_name"] = [stored.path for stored in mine]
            detector["count_time"] = [first[stored.path].exposure_s for stored in mine]
            detector["count_time"].attrs["units"] = "s"
            detector["bit_depth_readout"] = camera.bit_depth
            if camera.pixel_pitch_um is not None:
                for axis in ("x_pixel_size", "y_pixel_size"):
                    detector[axis] = camera.pixel_pitch_um
                    detector[axis].attrs["units"] = "um"
        spectra = _group(entry, "spectra", "NXcollection")
        targets = _group(entry, "targets", "NXcollection")
        for stored in files:
            name = Path(stored.path).stem
            if stored.role == "spectrum":
                spectrum = recordings.spectrum(stored.path)
                group = _group(spectra, name, "NXdata")
                group.attrs["signal"], group.attrs["axes"] = "value", "wavelength"
                group["value"] = spectrum.value
                group["wavelength"] = spectrum.wavelength_nm
                group["wavelength"].attrs["units"] = "nm"
            elif stored.role == "target":
                targets.create_dataset(name, data=recordings.target(stored.path), compression="gzip")
    return index
