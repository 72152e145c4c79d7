"""`calibench import`, `export` and `sessions`."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from lab.capture.data_folder import store_to_read
from lab.cli.console import check_output, check_writable, out, progress_bar, warn, write_json
from lab.cli.exchange import (
    LENSFUN,
    OF_A_CAMERA,
    SPECTRA,
    TILED,
    ExportOptions,
    export_camera,
    export_spectra,
    export_tiled,
    import_lens,
    import_spectra,
    import_tiled,
)
from lab.cli.sources import StoreFolder, recordings_of
from lab.cli.tables import print_fit
from lab.errors import InputError
from lab.pipeline import session_recordings

if TYPE_CHECKING:
    from lab.formats.importers.single_picture import ImportOptions


commands = typer.Typer()
#: `--from` these: a CSV of channel means and variances by level, or of channel means by wavelength, which becomes a
#: fit.
LEVEL_TABLE, MEAN_TABLE = "photon-transfer-table", "spectral-table"


@commands.command("import")
def import_(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="the folder of the recordings, or the picture")],
    kind: Annotated[
        str,
        typer.Option(
            "--from",
            metavar="KIND",
            help="emva1288, raw-folder, fits, slanted-edge, colorchecker, dot-grid, checkerboard, "
            "photon-transfer-table, spectral-table, spectra, lensfun or tiled",
        ),
    ],
    out_folder: Annotated[
        Path,
        typer.Option(
            "--out",
            metavar="DIR",
            help="the recording set to write; of a table, the fit's JSON; of spectra, a CSV or a folder of them; of "
            "lensfun, a camera file",
        ),
    ],
    checkerboard: Annotated[
        str,
        typer.Option(
            metavar="ROWSxCOLS", help="checkerboard: inner corners; raw-folder: of pairs of images leftNN, rightNN"
        ),
    ] = "",
    dots: Annotated[str, typer.Option(metavar="ROWSxCOLS", help="dot-grid: dots of the plane grid")] = "",
    square_mm: Annotated[float, typer.Option(help="side of the checkerboard's squares, or spacing of the dots")] = 0.0,
    tap: Annotated[str, typer.Option(metavar="NAME", help="raw-folder, fits: this tap of the sensor alone")] = "",
    only: Annotated[
        str,
        typer.Option(metavar="KEY=VALUE,...", help="raw-folder, fits: frames alone whose headers state these settings"),
    ] = "",
    ignore: Annotated[
        str, typer.Option(metavar="KEY,...", help="raw-folder, fits: keywords of the headers that are wrong")
    ] = "",
    camera: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="a picture's camera.toml, where it isn't beside it; lensfun: the camera file",
        ),
    ] = None,
    exposure_s: Annotated[float | None, typer.Option(help="a picture's exposure")] = None,
    transfer: Annotated[
        str,
        typer.Option(
            metavar="linear|srgb", help="whether a PNG, TIFF or JPEG picture's codes are linear in the light or sRGB"
        ),
    ] = "",
    channel: Annotated[str, typer.Option(metavar="R|G|B", help="slanted-edge: the channel of a colour picture")] = "",
    corners: Annotated[
        str,
        typer.Option(
            metavar="R,C,R,C,R,C,R,C", help="colorchecker: row, column of dark skin, bluish green, black, white"
        ),
    ] = "",
    light: Annotated[
        Path | None, typer.Option(metavar="FILE", help="colorchecker: radiance (CSV) of a perfect diffuser there")
    ] = None,
    white_patch: Annotated[
        Path | None, typer.Option(metavar="FILE", help="colorchecker: radiance (CSV) of the white patch")
    ] = None,
    lens: Annotated[
        str, typer.Option(metavar="NAME", help="lensfun: the model of the lens, where the file has several")
    ] = "",
) -> None:
    """Turn another format into a recording set; spectra into CSV, a lens into a camera file.

    Example: calibench import --from raw-folder frames --out my-camera
    """
    from lab.foreign_recordings import read_foreign
    from lab.formats import recording_set
    from lab.formats.importers.single_picture import ImportOptions, chart_corners, grid

    if transfer not in ("", "linear", "srgb"):
        raise InputError(f"--transfer {transfer}: give linear or srgb")
    options = ImportOptions(
        checkerboard=grid("--checkerboard", checkerboard),
        dots=grid("--dots", dots),
        square_mm=square_mm or None,
        camera=camera,
        exposure_s=exposure_s,
        channel=channel or None,
        transfer="srgb" if transfer == "srgb" else "linear" if transfer else None,
        corners=chart_corners("--corners", corners),
        light=light,
        white_patch=white_patch,
        tap=tap or None,
        only=only or None,
        ignore=ignore or None,
    )
    if lens and kind != LENSFUN:
        raise InputError(f"--from {kind} doesn't take --lens")
    check_output(out_folder)
    if kind in (SPECTRA, TILED):
        if options.stated():
            raise InputError(f"--from {kind} doesn't take {', '.join(options.stated())}; it takes none")
        (import_spectra if kind == SPECTRA else import_tiled)(path, out_folder)
        return
    if kind == LENSFUN:
        import_lens(path, options, lens, out_folder)
        return
    if kind in (LEVEL_TABLE, MEAN_TABLE):
        _import_table(kind, path, options, out_folder)
        return
    recordings = read_foreign(kind, path, options)
    warn(recordings.warnings)
    warnings: list[str] = []
    with progress_bar("import") as advance:
        folder = recording_set.write(recordings, out_folder, progress=advance, report_warnings=warnings.extend)
    warn(tuple(warnings))
    out.print(f"{folder}: {len(recordings.manifest.captures)} captures of {', '.join(recordings.sides)}")


def _import_table(kind: str, path: Path, options: ImportOptions, file: Path) -> None:
    """A table holds no frames: its import is a fit."""
    from lab.fit.noise.noise_fit import fit_level_table
    from lab.fit.spectral.mean_table import fit_mean_table
    from lab.formats.cgats import read_foreign_csv
    from lab.formats.importers.images import read_camera_file
    from lab.formats.recording_set import Manifest, RecordingSet

    if [name for name in options.stated() if name != "--camera"]:
        raise InputError(f"--from {kind} takes --camera alone")
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the table (CSV)")
    described = options.camera if options.camera is not None else path.parent / "camera.toml"
    camera = read_camera_file(described, {"left": {"rows": 1, "cols": 1}}).get("left")
    if camera is None:
        raise InputError(f"{described}: describes no left camera; write the keys without a table")
    check_writable(file)
    warn(tuple(f"{path}: {remark}" for remark in read_foreign_csv(path).remarks))
    result = (fit_level_table if kind == LEVEL_TABLE else fit_mean_table)(path, camera)
    write_json(result, file)
    print_fit(RecordingSet(Manifest(cameras={"left": camera}, captures=())), result)


@commands.command()
def sessions(data: StoreFolder = None) -> None:
    """List the stored sessions.

    Example: calibench sessions --data calibench-data
    """
    table = Table(box=None, pad_edge=False)
    for heading in ("session", "name", "created", "state", "steps done"):
        table.add_column(heading)
    for info in store_to_read(data).sessions():
        created = f"{info.created:%Y-%m-%d %H:%M}"
        table.add_row(info.id, escape(info.name), created, info.state, f"{info.steps_done} of {info.steps}")
    out.print(table)


@commands.command()
def export(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help="a stored session's id; spectra: a CSV, or a recording set's folder, too; all others but tiled: a "
            "camera file",
        ),
    ],
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="PATH",
            help="the recording set (a folder) or the file to write; tiled: a catalogue's folder, or a server's URL",
        ),
    ],
    kind: Annotated[
        str,
        typer.Option(
            "--as",
            metavar="KIND",
            help="recording-set, tiled, spectra (.sp or .ti3), lensfun, rawtoaces, dcp, icc, pyxel, isetcam, opencv, "
            "ros, kalibr, colmap or mrcal",
        ),
    ] = "recording-set",
    quantity: Annotated[
        str,
        typer.Option(
            metavar="NAME", help="spectra: what the CSV holds: radiance, reflectance, transmittance or sensitivity"
        ),
    ] = "radiance",
    exposure_s: Annotated[float, typer.Option(help="pyxel: the exposure")] = 0.01,
    photons: Annotated[
        float | None, typer.Option(help="pyxel: photons a pixel in it (without: half of a pixel's full well)")
    ] = None,
    wavelength_nm: Annotated[float, typer.Option(help="pyxel: wavelength of the light")] = 550.0,
    channel: Annotated[str, typer.Option(metavar="R|G|B", help="pyxel: whose efficiency (without: green's)")] = "",
    right: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="opencv, ros, kalibr, colmap, mrcal: of a pair, the right camera's file"),
    ] = None,
    fit: Annotated[
        Path | None, typer.Option(metavar="FILE", help="with --right: the JSON of the fit that has the pair's pose")
    ] = None,
    data: StoreFolder = None,
) -> None:
    """Write a stored session as a recording set; spectra and cameras in the formats of other programs.

    Example: calibench export 20261127-101500-7f3ad2 --to my-camera
    """
    from lab.formats import recording_set

    if kind != TILED:  # a catalogue may be a server's
        check_output(Path(to))
    if kind == SPECTRA:
        export_spectra(source, Path(to), quantity, data)
        return
    if kind == TILED:
        export_tiled(source, to, data)
        return
    if kind in OF_A_CAMERA:
        export_camera(kind, source, Path(to), ExportOptions(exposure_s, photons, wavelength_nm, channel, right, fit))
        return
    if kind != "recording-set":
        raise InputError(f"--as {kind}: no such format; choose {', '.join((SPECTRA, TILED, *OF_A_CAMERA))}")
    recordings = session_recordings(store_to_read(data), source)
    warn(recordings.warnings)
    with progress_bar("export") as advance:
        folder = recording_set.write(recordings, Path(to), progress=advance)
    out.print(f"{folder}: {len(recordings.manifest.captures)} captures of {', '.join(recordings.sides)}")


@commands.command()
def kinds(
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="count the captures in a recording set or a stored session")
    ] = "",
    data: StoreFolder = None,
) -> None:
    """The kinds of capture: the scene, and the sequence that takes them.

    Example: calibench kinds my-camera
    """
    from lab.capture_kinds.base import CAPTURES

    counted = Counter(capture.kind for capture in recordings_of(source, data).captures()) if source else None
    table = Table(box=None, pad_edge=False)
    for heading in (
        "kind",
        "sequence",
        "what stands before the camera",
        *(["captures"] if counted is not None else []),
    ):
        table.add_column(heading)
    for name, kind in CAPTURES.models.items():
        sequence = kind.sequence.name if kind.sequence else "-"
        table.add_row(name, sequence, escape(kind.shows), *([str(counted[name])] if counted is not None else []))
    out.print(table)
