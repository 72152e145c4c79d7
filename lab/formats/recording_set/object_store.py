"""A recording set below a URL: in an object store (`s3://bucket/set`), on a web server, or wherever fsspec reaches.

Workers of a cluster read it from there, so that they need no path in common; each opens its own connection. The
manifest is written last: without it there is no recording set, and an export that broke off is taken up again.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from lab.errors import InputError, one_line
from lab.formats.recording_set.files import Frame, Target, load_frame, load_target
from lab.formats.recording_set.manifest import DataSheet
from lab.formats.spectrum_csv import parse_spectrum
from sim.spectrum import Spectrum

_URL = re.compile(r"[a-z][a-z0-9+.-]*://.")
#: Files that others read by their path, kept on this computer at a time.
_KEPT_FILES = 64


def is_url(path: str | os.PathLike[str]) -> bool:
    """Return whether this names a place of fsspec's, and not a path of this computer.

    >>> is_url("s3://lab/my-camera"), is_url("/data/my-camera")
    (True, False)
    """
    return isinstance(path, str) and _URL.match(path) is not None


class ObjectStore:
    """The files below a URL. Another process that it is sent to opens the URL itself."""

    def __init__(self, url: str) -> None:
        if "@" in url.partition("://")[2].partition("/")[0]:
            raise InputError(
                f"{url.partition('://')[0]}://...: has a user or a password in it, which reports would show; put them "
                "into the environment (AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY)"
            )
        self.url = url.rstrip("/")
        self._lock = threading.Lock()
        self._opened: tuple[Any, str] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {"url": self.url}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["url"])  # type: ignore[misc]

    def content(self, path: str) -> bytes:
        """Return a file's bytes. Raises InputError, without the path."""
        with self._reached() as (system, root):
            return bytes(system.cat_file(f"{root}/{_within(path)}"))

    def size(self, path: str) -> int | None:
        """Return a file's size in bytes; None where there is none. Raises InputError."""
        with self._reached() as (system, root):
            try:
                found = system.info(f"{root}/{_within(path)}", refresh=True)
            except FileNotFoundError:
                return None
            return int(found["size"])

    def put(self, path: str, content: bytes) -> None:
        """Write a file. Raises InputError."""
        with self._reached() as (system, root):
            place = f"{root}/{_within(path)}"
            if "file" in system.protocol:  # an object store has no folders
                system.makedirs(str(PurePosixPath(place).parent), exist_ok=True)
            system.pipe_file(place, content)

    @contextmanager
    def _reached(self) -> Iterator[tuple[Any, str]]:
        """The file system and the path of the URL. Raises InputError in one line, whatever its library raises."""
        try:
            with self._lock:
                if self._opened is None:
                    from fsspec.core import url_to_fs

                    self._opened = url_to_fs(self.url, use_listings_cache=False)
            yield self._opened
        except InputError:
            raise
        except FileNotFoundError as error:
            raise InputError("no such file; add it, or take what needs it out of the manifest") from error
        except ImportError as error:
            raise InputError(f"{one_line(error)}; for s3:// install calibench's extra s3") from error
        except PermissionError as error:
            raise InputError(
                f"access is refused ({one_line(error)}); set the store's credentials in the environment, of workers too"
            ) from error
        except Exception as error:  # botocore, aiohttp and others have their own
            raise InputError(
                f"can't be reached ({type(error).__name__}: {one_line(error)}); check the address, the network and the "
                "store's credentials"
            ) from error


def _within(path: str) -> str:
    pure = PurePosixPath(path)
    if not path or "\\" in path or pure.is_absolute() or ".." in pure.parts or "://" in path:
        raise InputError("not a path relative to the folder with '/'; move the file into the folder and name it so")
    return str(pure)


class UrlFiles:
    """Frames, spectra and targets below a URL, fetched when they are asked for; a frame isn't kept."""

    def __init__(self, store: ObjectStore) -> None:
        self.store = store
        self._lock = threading.Lock()
        self._folder: Path | None = None
        self._kept: OrderedDict[str, Path] = OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        return {"store": self.store}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["store"])  # type: ignore[misc]

    def frame(self, path: str, camera: DataSheet) -> Frame:
        return self._loaded(path, lambda file: load_frame(file, (camera.rows, camera.cols)))

    def target(self, path: str) -> Target:
        return self._loaded(path, load_target)

    def spectrum(self, path: str) -> Spectrum:
        try:
            text = self.store.content(path).decode("utf-8")
        except UnicodeDecodeError as error:
            raise InputError(f"can't be read as text ({one_line(error)}); save it as CSV in UTF-8") from error
        return parse_spectrum(text)

    def file(self, path: str) -> Path | None:
        """Return a copy on this computer; the newest stay while this lives."""
        content = self.store.content(path)
        with self._lock:
            if self._folder is None:
                self._folder = Path(tempfile.mkdtemp(prefix="calibench-"))
                weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
            if path not in self._kept:
                place = self._folder / str(len(self._kept) + 1) / PurePosixPath(path).name
                if len(self._kept) >= _KEPT_FILES:
                    _, oldest = self._kept.popitem(last=False)
                    place = oldest.parent / place.name
                    oldest.unlink()
                place.parent.mkdir(exist_ok=True)
                place.write_bytes(content)
                self._kept[path] = place
            self._kept.move_to_end(path)
            return self._kept[path]

    def where(self, path: str) -> str:
        return f"{self.store.url}/{path}"

    def _loaded(self, path: str, load: Callable[[Path], Any]) -> Any:
        """Return what a reader of files makes of it: what is damaged is found by the same checks."""
        content = self.store.content(path)
        with tempfile.NamedTemporaryFile(prefix="calibench-", suffix=PurePosixPath(path).suffix) as file:
            file.write(content)
            file.flush()
            return load(Path(file.name))


def put_once(store: ObjectStore, path: str, content: bytes) -> bool:
    """Write a file unless it is there already, byte by byte. Returns whether it was written. Raises InputError."""
    if store.size(path) == len(content) and store.content(path) == content:
        return False
    store.put(path, content)
    return True
