"""Files of other programs that hold no recordings: tables of levels, which become a fit, and lenses of lensfun's, which
are put before a camera. Recordings are in `lab.foreign_recordings`, spectra in `lab.formats.cgats`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from lab.errors import InputError

if TYPE_CHECKING:
    from lab.formats.camera_file import CameraFile
    from lab.formats.recording_set import DataSheet
    from lab.formats.results import FitResult

#: A CSV of channel means and variances by level, or of channel means by wavelength.
TableKind = Literal["photon-transfer-table", "spectral-table"]
TABLES: dict[str, TableKind] = {kind: kind for kind in get_args(TableKind)}


@dataclass(frozen=True)
class TableFit:
    """The fit of a table, the data sheet of the camera that it is of, and what is remarked about the file."""

    fit: FitResult
    camera: DataSheet
    remarks: tuple[str, ...]


def fit_table(kind: TableKind, path: Path, camera_file: Path) -> TableFit:
    """Fit a table, which holds no frames.

    path, camera_file : the CSV, and the camera.toml with its data sheet
    Raises InputError, one line with the file, where one of them can't be used, and NotDetermined.
    """
    from lab.fit.noise.noise_fit import fit_level_table
    from lab.fit.spectral.mean_table import fit_mean_table
    from lab.formats.cgats import read_foreign_csv
    from lab.formats.importers.images import read_camera_file

    if not path.is_file():
        raise InputError(f"{path}: no such file; give the table (CSV)")
    camera = read_camera_file(camera_file, {"left": {"rows": 1, "cols": 1}}).get("left")
    if camera is None:
        raise InputError(f"{camera_file}: describes no left camera; write the keys without a table")
    remarks = tuple(f"{path}: {remark}" for remark in read_foreign_csv(path).remarks)
    result = (fit_level_table if kind == "photon-transfer-table" else fit_mean_table)(path, camera)
    return TableFit(result, camera, remarks)


@dataclass(frozen=True)
class LensBefore:
    """A camera behind a lens of lensfun's: the camera file, the lens's name and focal length (mm), its corrections that
    were taken, and what is remarked."""

    content: CameraFile
    lens: str
    focal_length_mm: float
    corrections: tuple[str, ...]
    remarks: tuple[str, ...]


def put_lens_before(path: Path, content: CameraFile, camera_file: Path, lens: str = "") -> LensBefore:
    """Put a lens of lensfun's before a camera.

    path : the XML; lens : the model's name, where it has several
    content, camera_file : the camera, and its file for messages
    Raises InputError, one line with the file, where the lens can't be used.
    """
    from lab.formats.lensfun import read_lensfun, with_lens

    if content.camera.lens.focal_length_mm is None:
        raise InputError(f"{camera_file}: lens.focal_length_mm is not set; write the lens's, as {path} has several")
    model = read_lensfun(path, content.camera, lens)
    try:
        made, remarks = with_lens(content, model)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    had = tuple(name for name in ("distortion", "vignetting", "tca") if getattr(model, name) is not None)
    told = tuple(f"{path}: {remark}" for remark in remarks)
    return LensBefore(made, model.model, model.focal_length_mm, had, told)
