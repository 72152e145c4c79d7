"""Results as JSON files, as `--json FILE` writes them."""

from __future__ import annotations

import hashlib
import platform
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from lab.errors import InputError
from lab.formats.recording_set import InstrumentSnapshot, RecordingSet, manifest_json
from sim.parameters import Frozen

Result = TypeVar("Result", bound=BaseModel)


def result_json(result: BaseModel) -> str:
    """Return a result as JSON text, as the commands write it with `--json`.

    >>> from lab.formats.results import FitResult
    >>> '"format": "calibench-fit"' in result_json(FitResult(source="my-camera", cameras={}))
    True
    """
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


#: The distributions whose version can change a number.
DISTRIBUTIONS = ("calibench", "numpy", "scipy", "opencv-contrib-python-headless", "colour-science", "rawpy")


class Provenance(Frozen):
    """The origin of a calibration: instruments, software, and digests of the recordings."""

    made: datetime
    instruments: dict[str, InstrumentSnapshot] = {}  # by name, what each said of itself before the first capture
    versions: dict[str, str] = {}
    manifest_sha256: str
    frame_sha256: dict[str, str]  # capture id -> SHA-256 of the frame's values (little-endian uint16, row by row)


def installed_versions() -> dict[str, str]:
    """Return the versions of calibench, of the libraries that compute, and of Python, by name.

    >>> sorted(set(installed_versions()) & {"calibench", "numpy", "python"})
    ['calibench', 'numpy', 'python']
    """
    versions = {"python": platform.python_version(), "system": platform.platform(terse=True)}
    for name in DISTRIBUTIONS:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions


def provenance_of(recordings: RecordingSet, made: datetime | None = None) -> Provenance:
    """Return the provenance of an evaluation of `recordings`, of which every frame is read once.

    made : time of the evaluation; now by default
    """
    digests = {
        capture.id: hashlib.sha256(recordings.frame(capture).astype("<u2").tobytes()).hexdigest()
        for capture in recordings.captures()
    }
    return Provenance(
        made=made or datetime.now(UTC),
        instruments=recordings.manifest.instruments,
        versions=installed_versions(),
        manifest_sha256=hashlib.sha256(manifest_json(recordings.manifest).encode()).hexdigest(),
        frame_sha256=digests,
    )
