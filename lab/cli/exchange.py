"""What `calibench import` and `export` do with the formats that other programs exchange (`lab.formats`)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape

from lab.capture.data_folder import store_to_read
from lab.cli.console import out, progress_bar, warn
from lab.cli.sources import recordings_of
from lab.errors import InputError
from lab.pipeline import session_recordings

if TYPE_CHECKING:
    from lab.formats.camera_file import CameraFile
    from lab.formats.cgats import CgatsSpectra
    from lab.formats.importers.single_picture import ImportOptions

#: `import --from` these, and `export --as` these; the last of a camera file.
SPECTRA, LENSFUN, TILED = "spectra", "lensfun", "tiled"
#: `export --as` these takes a stereo pair, too.
OF_A_PAIR = ("opencv", "ros", "kalibr", "colmap", "mrcal")
OF_A_CAMERA = (LENSFUN, "rawtoaces", "dcp", "icc", "pyxel", "isetcam", *OF_A_PAIR)


@dataclass(frozen=True)
class ExportOptions:
    """What is stated of an export: for Pyxel exposure and light (`photons` a pixel in it, None: to half of the full
    well), and the channel whose quantum efficiency it gets; of a pair the right camera's file, and the fit (JSON) that
    has its pose."""

    exposure_s: float = 0.01
    photons: float | None = None
    wavelength_nm: float = 550.0
    channel: str = ""
    right: Path | None = None
    fit: Path | None = None


def import_spectra(path: Path, to: Path) -> None:
    """The spectra of a CGATS file as CSV: one as the file `to`, several as NAME.csv in the folder `to`."""
    from lab.formats.cgats import read_cgats
    from lab.formats.raw_file import replacing
    from lab.formats.spectrum_csv import format_spectrum

    read = read_cgats(path)
    warn(tuple(f"{path}: {remark}" for remark in read.remarks))
    files = {to if to.suffix.lower() == ".csv" else to / "1.csv": spectrum for spectrum in read.spectra.values()}
    if len(read.spectra) > 1:
        names = {
            name: re.sub(r"^\.+|[^\w.-]", lambda match: "_" * len(match[0]), name) for name in read.spectra
        }  # no hidden file, whatever a sample's name begins with
        if len(set(names.values())) < len(names) or to.suffix.lower() == ".csv":
            raise InputError(f"{to}: {path} holds {len(names)} spectra; give a folder by --out, and other names")
        files = {to / f"{names[name]}.csv": spectrum for name, spectrum in read.spectra.items()}
    for file, spectrum in files.items():
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as partial:
            partial.write_text(format_spectrum(spectrum), encoding="utf-8")
    out.print(escape(f"{to}: {len(files)} spectra, {read.quantity or 'their quantity not stated'}"))


def import_lens(path: Path, options: ImportOptions, lens: str, to: Path) -> None:
    """A lens of lensfun's before the camera of a camera file, as another camera file."""
    from lab.foreign_files import put_lens_before
    from lab.formats.camera_file import read_camera, write_camera

    if [name for name in options.stated() if name != "--camera"] or options.camera is None:
        raise InputError(f"--from {LENSFUN} takes --camera FILE, the camera to put the lens before, and --lens alone")
    made = put_lens_before(path, read_camera(options.camera), options.camera, lens)
    warn(made.remarks)
    write_camera(to, made.content)
    out.print(escape(f"{to}: {made.lens} at {made.focal_length_mm:g} mm: {', '.join(made.corrections)}"))


def export_spectra(source: str, to: Path, quantity: str, data: Path | None) -> None:
    """A spectrum's CSV, or all radiances of a recording set or session, as .sp or .ti3."""
    from lab.formats.cgats import write_cgats

    if to.suffix.lower() not in (".sp", ".ti3"):
        raise InputError(f"--to {to}: name a file that ends in .sp or .ti3")
    warn(tuple(f"{to}: {remark}" for remark in write_cgats(to, _spectra(source, quantity, data))))
    out.print(escape(str(to)))


def _spectra(source: str, quantity: str, data: Path | None) -> CgatsSpectra:
    from lab.capture_kinds.base import Names, names_in
    from lab.formats.cgats import CgatsSpectra, Quantity, get_quantity
    from lab.formats.spectrum_csv import parse_spectrum

    stated: Quantity = get_quantity(quantity)
    if not Path(source).is_file():
        recordings = recordings_of(source, data)
        paths = [
            path for capture in recordings.captures() for _, what, path in names_in(capture) if what is Names.SPECTRUM
        ]
        if not paths:
            raise InputError(f"{source}: has no radiance that was measured; give a set that has")
        return CgatsSpectra({Path(p).stem: recordings.spectrum(p) for p in dict.fromkeys(paths)}, "radiance")
    try:
        return CgatsSpectra({Path(source).stem: parse_spectrum(Path(source).read_text(encoding="utf-8"))}, stated)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{source}: can't be read as text; give a CSV in UTF-8") from error
    except InputError as error:
        raise InputError(f"{source}: {error}") from error


def export_camera(kind: str, source: str, to: Path, options: ExportOptions) -> None:
    """A camera file as one of `OF_A_CAMERA`."""
    from lab.formats.camera_file import read_camera
    from lab.formats.colour_profile import write_dcp, write_icc, write_rawtoaces
    from lab.formats.isetcam_sensor import write_isetcam
    from lab.formats.lensfun import write_lensfun
    from lab.formats.pyxel_file import write_pyxel

    if not source.endswith(".toml"):
        raise InputError(f"{source}: --as {kind} is of a camera file; `calibench fit --write-cameras` writes one")
    if (options.right is not None or options.fit is not None) and kind not in OF_A_PAIR:
        raise InputError(f"--as {kind} is of one camera; leave out --right and --fit, or take {', '.join(OF_A_PAIR)}")
    content = read_camera(Path(source))
    if kind == "pyxel":
        at = content.camera.quantum_efficiency
        efficiency = max((float(curve.at(options.wavelength_nm)) for curve in at.values()), default=0.0)
        if options.photons is None and not efficiency > 0:
            raise InputError(f"--wavelength-nm {options.wavelength_nm:g}: no light is seen there; state --photons")
        photons = options.photons or 0.5 * content.camera.full_well_e / efficiency
        remarks = write_pyxel(
            to,
            content,
            exposure_s=options.exposure_s,
            photons_per_pixel=photons,
            wavelength_nm=options.wavelength_nm,
            channel=options.channel,
        )
    elif kind in OF_A_PAIR:
        remarks = _write_geometry(kind, to, content, options)
    else:
        writer = {
            LENSFUN: write_lensfun,
            "rawtoaces": write_rawtoaces,
            "dcp": write_dcp,
            "icc": write_icc,
            "isetcam": write_isetcam,
        }[kind]
        remarks = writer(to, content)
    warn(tuple(f"{to}: {remark}" for remark in remarks))
    out.print(escape(str(to)))


def _write_geometry(kind: str, to: Path, content: CameraFile, options: ExportOptions) -> tuple[str, ...]:
    """The geometry of a camera, or of a pair, as one of `OF_A_PAIR`; what it has no place for."""
    from lab.formats.camera_file import read_camera
    from lab.formats.geometry_files import (
        pair_cameras,
        write_colmap,
        write_kalibr,
        write_mrcal,
        write_opencv,
        write_ros,
    )
    from lab.formats.result_file import read_result
    from lab.formats.results.fit import FitResult

    writer = {
        "opencv": write_opencv,
        "ros": write_ros,
        "kalibr": write_kalibr,
        "colmap": write_colmap,
        "mrcal": write_mrcal,
    }[kind]
    if options.right is None and options.fit is None:
        return writer(to, content)
    if options.right is None or options.fit is None:
        raise InputError("a pair needs both --right (the right camera's file) and --fit (what `fit --json` wrote)")
    stereo = read_result(FitResult, options.fit).stereo
    if stereo is None:
        raise InputError(f"{options.fit}: has no pose of a stereo pair; fit both cameras' views of a board")
    return writer(to, *pair_cameras(content, read_camera(options.right), stereo))


def export_tiled(session: str, to: str, data: Path | None) -> None:
    """A stored session into a Tiled catalogue: a server's address, or a folder."""
    from lab.capture.tiled_catalogue import open_catalogue, write_session

    store = store_to_read(data)
    recordings = session_recordings(store, session)
    warn(recordings.warnings)
    catalogue = open_catalogue(to)
    with progress_bar("export") as advance:
        key = write_session(catalogue, recordings, store.folder(session) / "documents.jsonl", advance)
    out.print(escape(f"{to}: {key}, {len(recordings.manifest.captures)} captures"))


def import_tiled(path: Path, to: Path) -> None:
    """A session of a Tiled catalogue, CATALOGUE/SESSION, as a recording set."""
    from lab.capture.tiled_catalogue import open_catalogue, read_session
    from lab.formats import recording_set

    where = str(path.parent)
    server = where.startswith(("http:", "https:"))  # of whose address a path keeps one slash
    if not server and not path.parent.is_dir():
        raise InputError(f"{path}: no such catalogue; give FOLDER/SESSION, or the server's address with /SESSION")
    recordings = read_session(open_catalogue(where.replace(":/", "://", 1) if server else where), path.name)
    warn(recordings.warnings)
    with progress_bar("import") as advance:
        folder = recording_set.write(recordings, to, progress=advance)
    out.print(escape(f"{folder}: {len(recordings.manifest.captures)} captures of {', '.join(recordings.sides)}"))
