"""The data folder: the store that a folder, or the environment, names."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from lab.errors import InputError

if TYPE_CHECKING:
    from lab.capture.store import Store


def open_store(folder: Path | None = None) -> Store:
    """Open the data folder; it is made if it isn't there.

    folder : by default what CALIBENCH_DATA says, else `calibench-data`

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     open_store(Path(folder) / "data").sessions()
    []
    """
    from lab.capture.settings import Settings
    from lab.capture.store import Store

    settings = Settings() if folder is None else Settings(data=folder)
    return Store.open(settings)


def existing_store(folder: Path | None = None) -> Store | None:
    """Return the store of the data folder, as `open_store` finds it; None without one: reading makes none."""
    from lab.capture.settings import Settings

    settings = Settings() if folder is None else Settings(data=folder)
    there = settings.registry_file is None or settings.registry_file.is_file()
    return open_store(folder) if there and settings.data.is_dir() else None


def store_to_read(folder: Path | None = None) -> Store:
    """Return the store of the data folder, for a command that only reads or changes what is there. Raises InputError
    where there is none.
    """
    from lab.capture.settings import Settings

    store = existing_store(folder)
    if store is None:
        at = folder or Settings().data
        raise InputError(
            f"{at}: holds no registry; name the data folder by --data, or, where its registry is a database server's, "
            "set CALIBENCH_DATABASE_URL as the service has it"
        )
    return store
