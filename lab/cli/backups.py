"""`calibench backup` and `restore`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from lab.capture.data_folder import store_to_read
from lab.capture.generations import KEPT, acting_as_owner
from lab.cli.console import EXIT_CHECK, err, out, progress_bar, warn
from lab.cli.sources import StoreFolder
from lab.errors import InputError

commands = typer.Typer()

_MIB = 1 << 20


@commands.command()
def backup(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="the backup: new, or one of this data folder")],
    data: StoreFolder = None,
    keep: Annotated[int, typer.Option(min=1, max=10_000, help="how many generations to keep, the newest")] = KEPT,
    checksum: Annotated[
        bool,
        typer.Option("--checksum", help="read every file of the data folder, also those of unchanged size and time"),
    ] = False,
    verify: Annotated[
        bool, typer.Option("--verify", help="copy nothing: read every file of the backup and compare its SHA-256")
    ] = False,
) -> None:
    """Copy the data folder while it is in use. Each copy is a generation, a data folder itself; generations share the
    files that didn't change. Files that are damaged or missing in the data folder are named (exit code 4); their good
    copies stay.

    Example: calibench backup /mnt/backup/calibench --keep 30
    """
    from lab.capture.backup import back_up, verify_backup
    from lab.capture.settings import Settings

    if verify:
        files, lines = verify_backup(folder)
        _fail_with(lines)
        out.print(f"{files} files of the backup have the SHA-256 that was recorded")
        return
    with acting_as_owner(data or Settings().data, folder):
        made = back_up(store_to_read(data), folder, keep, checksum)
    state = "" if made.is_new else " (nothing changed since)"
    copied = f"{made.copied} copied, {made.copied_bytes / _MIB:.1f} MiB"
    out.print(f"{made.generation.name}{state}: {made.sessions} sessions; {made.files} files, {copied}")
    warn(made.remarks)
    _fail_with(made.damaged)


@commands.command()
def restore(
    backup: Annotated[Path, typer.Argument(metavar="BACKUP", help="the folder that `calibench backup` wrote")],
    data: Annotated[
        Path | None,
        typer.Option("--to", "--data", metavar="DIR", help="the data folder (CALIBENCH_DATA, else calibench-data)"),
    ] = None,
    generation: Annotated[
        str | None, typer.Option(metavar="NAME", help="which generation; without it, the newest")
    ] = None,
    show: Annotated[bool, typer.Option("--list", help="list the generations, and end")] = False,
    replace: Annotated[
        bool, typer.Option("--replace", help="move what the data folder holds to DIR/.before-restore-TIME")
    ] = False,
    repair: Annotated[
        bool,
        typer.Option(
            "--repair", help="bring back only files of the data folder that are damaged or missing, from any generation"
        ),
    ] = False,
) -> None:
    """Bring a data folder back from its backup: a generation, or with --repair damaged and missing files alone. Each
    file's SHA-256 is checked. A restore that was interrupted is continued by the same command.

    Example: calibench restore /mnt/backup/calibench --data calibench-data
    """
    from lab.capture import restore as restoring
    from lab.capture.settings import Settings

    if show:
        table = Table("generation", "sessions", "files", "MiB", "calibench", box=None, pad_edge=False)
        for stored in restoring.list_generations(backup):
            record = stored.record
            mib = sum(file.bytes for file in record.files.values()) / _MIB
            version = record.calibench or "unknown"
            table.add_row(stored.name, str(record.sessions), str(len(record.files)), f"{mib:.1f}", version)
        out.print(table)
        return
    if repair and (replace or generation):
        raise InputError(
            "--repair takes each file from the newest generation that has it; leave out --replace and --generation"
        )
    settings = Settings() if data is None else Settings(data=data)
    restoring.list_generations(backup)
    if repair:
        with acting_as_owner(settings.data), progress_bar("restore") as advance:
            mended = restoring.repair(backup, store_to_read(data), advance)
        for path in mended.restored:
            out.print(f"restored: {escape(path)}")
        out.print(f"{len(mended.restored)} files restored, {len(mended.lost)} without a good copy")
        if mended.before is not None:
            out.print(f"the damaged ones are in {escape(str(mended.before))}")
        _fail_with(mended.lost)
        return
    owned, made = (backup, settings.data) if backup.stat().st_uid else (settings.data, None)
    with acting_as_owner(owned, made), progress_bar("restore") as advance:
        done = restoring.restore(backup, settings, generation, replace, advance)
    out.print(
        f"{done.generation}: {done.files} files, {done.bytes / _MIB:.1f} MiB restored to {escape(str(settings.data))}"
    )
    if done.before is not None:
        out.print(f"what was there is in {escape(str(done.before))}")
    warn(done.remarks)


def _fail_with(lines: tuple[str, ...]) -> None:
    """Print what is damaged or missing, a line each, and end with exit code 4; nothing without lines."""
    for line in lines:
        err.print(f"[red]calibench:[/] {escape(line)}")
    if lines:
        raise typer.Exit(EXIT_CHECK)
