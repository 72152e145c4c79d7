"""TOML files that a user wrote."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from lab.errors import InputError


def read_toml(file: Path, remedy: str) -> dict[str, Any]:
    """Return the tables of a TOML file.

    remedy : end of the message where the file can't be read

    Raises InputError, one line, where it can't be read or isn't TOML.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "station.toml"
    ...     _ = file.write_text('name = "bench"')
    ...     read_toml(file, "give a station file")
    {'name': 'bench'}
    """
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{file}: can't be read ({error.strerror}); {remedy}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: isn't TOML ({error}); correct that place") from error
