"""A session's files as those of a recording set, each checked against the registry's SHA-256."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from lab.capture.durable_files import npy_bytes
from lab.errors import InputError
from lab.formats.recording_set import DataSheet
from lab.formats.spectrum_csv import parse_spectrum
from sim.spectrum import Spectrum

#: Name of a packed session's file.
PACK = "session.nxs"


@dataclass(frozen=True)
class StoredPlace:
    """SHA-256 of a file, and the index of its frame in the packed session; None: it isn't packed."""

    sha256: str
    side: str | None
    pack_index: int | None


class SessionFiles:
    """Frames, spectra and targets of a session, packed or not. It holds paths only, so it can be sent to another
    process."""

    def __init__(self, folder: Path, places: Mapping[str, StoredPlace], pack: Path | None = None) -> None:
        self.folder, self.places = folder, dict(places)
        self.pack = pack or folder / PACK

    def _place(self, path: str) -> StoredPlace:
        if path not in self.places:
            raise InputError("isn't linked in the registry; resume the session, which takes it again")
        return self.places[path]

    def _bytes(self, path: str) -> bytes:
        place = self._place(path)
        try:
            content = (self.folder / path).read_bytes()
        except OSError as error:
            if self.pack.exists() and place.pack_index is None and path.startswith("frames/"):
                raise InputError("was packed with its session while it was read; read the session again") from error
            raise InputError(f"can't be read ({error.strerror}); restore it from a backup") from error
        return _intact(content, place)

    def file(self, path: str) -> Path | None:
        if path.startswith("lens/"):
            return self.folder / path
        return None if self._place(path).pack_index is not None else self.folder / path

    def frame(self, path: str, camera: DataSheet) -> NDArray[np.uint16]:
        place = self._place(path)
        if place.pack_index is None:
            return np.load(io.BytesIO(self._bytes(path)), allow_pickle=False)
        try:
            with h5py.File(self.pack, "r") as file:
                frame = np.asarray(file[f"entry/instrument/{place.side}/data"][place.pack_index], np.uint16)
        except (OSError, KeyError, ValueError) as error:
            raise InputError(f"can't be read from {self.pack} ({error}); restore it from a backup") from error
        _intact(npy_bytes(frame), place)
        return frame

    def spectrum(self, path: str) -> Spectrum:
        return parse_spectrum(self._bytes(path).decode())

    def target(self, path: str) -> NDArray[np.uint8]:
        return np.load(io.BytesIO(self._bytes(path)), allow_pickle=False)

    def where(self, path: str) -> str:
        place = self.places.get(path)
        if place is not None and place.pack_index is not None:
            return f"{self.pack}:/entry/instrument/{place.side}/data[{place.pack_index}]"
        return str(self.folder / path)


def _intact(content: bytes, place: StoredPlace) -> bytes:
    actual = hashlib.sha256(content).hexdigest()
    if actual != place.sha256:
        raise InputError(
            f"damaged: its SHA-256 is {actual[:12]}, the registry has {place.sha256[:12]}; restore it from a backup"
        )
    return content
