"""`calibench import`, `export` and `sessions`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from lab.cli.console import out, warn
from lab.cli.sources import StoreFolder, open_store
from lab.errors import InputError
from lab.formats import recording_set as recording
from lab.pipeline import session_recordings

commands = typer.Typer()


@commands.command("import")
def import_(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="the folder of the recordings")],
    kind: Annotated[str, typer.Option("--from", metavar="KIND", help="emva1288 or raw-folder")],
    out_folder: Annotated[Path, typer.Option("--out", metavar="DIR", help="the recording set to write")],
    checkerboard: Annotated[
        str, typer.Option(metavar="ROWSxCOLS", help="raw-folder: inner corners; the images are pairs leftNN, rightNN")
    ] = "",
    square_mm: Annotated[float, typer.Option(help="side of that checkerboard's squares")] = 0.0,
) -> None:
    """Turn another format into a recording set."""
    from lab.formats.importers import read_checkerboard_pairs, read_foreign

    if checkerboard:
        corners = re.fullmatch(r"(\d+)x(\d+)", checkerboard)
        if kind != "raw-folder" or corners is None or square_mm <= 0:
            raise InputError(
                "--checkerboard: give --from raw-folder --checkerboard ROWSxCOLS --square-mm S, as in 6x9 and 25"
            )
        recordings = read_checkerboard_pairs(path, (int(corners[1]), int(corners[2])), square_mm)
    else:
        recordings = read_foreign(kind, path)
    warn(recordings.warnings)
    folder = recording.write(recordings, out_folder)
    out.print(f"{folder}: {len(recordings.manifest.captures)} captures of {', '.join(recordings.sides)}")


@commands.command()
def sessions(data: StoreFolder = None) -> None:
    """List the stored sessions."""
    table = Table(box=None, pad_edge=False)
    for heading in ("session", "name", "created", "state", "steps done"):
        table.add_column(heading)
    for info in open_store(data).sessions():
        created = f"{info.created:%Y-%m-%d %H:%M}"
        table.add_row(info.id, escape(info.name), created, info.state, f"{info.steps_done} of {info.steps}")
    out.print(table)


@commands.command()
def export(
    session: Annotated[str, typer.Argument(metavar="SESSION", help="a stored session's id")],
    to: Annotated[Path, typer.Option("--to", metavar="DIR", help="the recording set to write")],
    data: StoreFolder = None,
) -> None:
    """Write a stored session as a recording set."""
    recordings = session_recordings(open_store(data), session)
    warn(recordings.warnings)
    folder = recording.write(recordings, to)
    out.print(f"{folder}: {len(recordings.manifest.captures)} captures of {', '.join(recordings.sides)}")
