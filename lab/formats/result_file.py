"""Results as JSON files, as `--json FILE` writes them."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from lab.errors import InputError

Result = TypeVar("Result", bound=BaseModel)


def result_json(result: BaseModel) -> str:
    """Return the text of a result's file."""
    return result.model_dump_json(indent=1) + "\n"


def write_result(result: BaseModel, file: Path) -> None:
    """Write a result completely or not at all. Raises InputError where the folder can't be written to."""
    from lab.formats.raw_file import replacing

    with replacing(file) as partial:
        partial.write_text(result_json(result), encoding="utf-8")


def read_result(model: type[Result], file: Path) -> Result:
    """Read a result. Raises InputError where the file can't be read or isn't of that model."""
    try:
        return model.model_validate_json(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: can't be read ({error}); give the file that --json wrote") from error
    except ValidationError as error:
        first = error.errors()[0]
        at = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{file}: not what --json wrote: {at} {first['msg']}; write it again") from error
