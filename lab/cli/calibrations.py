"""`calibench calibrations`: what each calibration is, certifying one, and how its figures drift."""

from __future__ import annotations

import getpass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from lab.capture.data_folder import store_to_read
from lab.cli.console import EXIT_CHECK, check_writable, out, warn, write_json
from lab.cli.sources import Json, StoreFolder
from lab.errors import InputError

if TYPE_CHECKING:
    from lab.calibration.limits import CalibrationLimits
    from lab.capture.store import Store

calibrations = typer.Typer(
    name="calibrations", no_args_is_help=True, help="A calibration's life: candidate, certified, superseded, expired."
)
Id = Annotated[str, typer.Argument(metavar="ID", help="a calibration's id, or its session's: the newest of it")]
LimitsFile = Annotated[
    Path | None,
    typer.Option("--limits", metavar="FILE", help="the limits, TOML; without it limits.toml in the data folder"),
]


def _limits(store: Store, file: Path | None) -> CalibrationLimits:
    from lab.calibration.limits import read_limits

    return read_limits(file or store.root / "limits.toml")


def _standing(store: Store, file: Path | None) -> CalibrationLimits | None:
    """The limits that are given, or those of the data folder where it has some."""
    from lab.calibration.limits import standing_limits

    return standing_limits(store.root) if file is None else _limits(store, file)


def _table(*headings: str) -> Table:
    table = Table(box=None, pad_edge=False)
    for heading in headings:
        table.add_column(heading)
    return table


@calibrations.command("list")
def list_calibrations(data: StoreFolder = None) -> None:
    """All calibrations, the newest first.

    Example: calibench calibrations list
    """
    from lab.calibration.life import calibrations as known

    table = _table("id", "of", "begun (UTC)", "state", "by", "until", "cameras")
    for record in known(store_to_read(data)):
        until = f"{record.expires:%Y-%m-%d}" if record.expires else ""
        begun, cameras = f"{record.created:%Y-%m-%d %H:%M}", ", ".join(record.cameras.values())
        table.add_row(
            record.id,
            escape(record.name),
            begun,
            record.state,
            escape(record.certified_by or ""),
            until,
            escape(cameras),
        )
    out.print(table)


@calibrations.command()
def show(id: Id, limits: LimitsFile = None, json: Json = None, data: StoreFolder = None) -> None:
    """One calibration: its state, and its figures against the limits. Exit code 4 if a figure is bad or missing.

    Example: calibench calibrations show 20261127-101500-7f3ad2
    """
    from lab.calibration.life import calibration, figures
    from lab.calibration.limits import judge_figures
    from lab.formats.results.words import format_unit

    check_writable(json)
    store = store_to_read(data)
    record = calibration(store, id)
    chosen = record.limits if limits is None and record.limits is not None else _standing(store, limits)
    by_limit = judge_figures(figures(store, record.id), chosen) if chosen is not None else ()
    write_json(record.model_copy(update={"limits": chosen, "judgements": by_limit}), json)
    if str(json) != "-":
        who = f" by {record.certified_by} at {record.certified:%Y-%m-%d %H:%M}" if record.certified else ""
        out.print(escape(f"{record.id} of {record.name}: {record.state}{who}"))
        table = _table("quantity", "side", "value", "std", "unit", "good", "mark", "figure")
        for judgement in by_limit:
            value, std = (
                ("" if judgement.value is None else f"{judgement.value:.6g}"),
                ("" if judgement.std is None else f"{judgement.std:.2g}"),
            )
            numbers = (value, std, format_unit(judgement.unit), judgement.limit.good_text)
            table.add_row(
                escape(judgement.title or judgement.figure),
                judgement.side or "",
                *numbers,
                judgement.mark,
                escape(judgement.figure),
            )
        if table.row_count:
            out.print(table)
    if any(judgement.mark in ("bad", "missing") for judgement in by_limit):
        raise typer.Exit(EXIT_CHECK)


@calibrations.command()
def certify(
    id: Id,
    limits: LimitsFile = None,
    by: Annotated[str, typer.Option(metavar="NAME", help="who certifies; without it the user of this computer")] = "",
    accept_warnings: Annotated[
        bool, typer.Option("--accept-warnings", help="certify with figures in the warning band")
    ] = False,
    data: StoreFolder = None,
) -> None:
    """Certify a candidate against limits; the same cameras' earlier calibration is superseded.

    Example: calibench calibrations certify 20261127-101500-7f3ad2 --limits limits.toml
    """
    from lab.calibration import life

    store = store_to_read(data)
    record = life.certify(store, id, by or _user(), _limits(store, limits), accept_warnings=accept_warnings)
    until = f"until {record.expires:%Y-%m-%d}" if record.expires else "until it is superseded"
    out.print(
        escape(
            f"{record.id}: certified by {record.certified_by}, {len(record.judgements)} figures within limits, {until}"
        )
    )
    if record.limits is not None and (dependence := record.limits.dependence_on(record.id)) is not None:
        warn((dependence,))


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError) as error:
        raise InputError("--by: this user has no name; say who certifies") from error


@calibrations.command()
def history(
    camera: Annotated[
        str, typer.Argument(metavar="CAMERA", help="a camera's name; without FIGURE its figures are listed")
    ] = "",
    figure: Annotated[str, typer.Argument(metavar="FIGURE", help="a figure, as `compare` names it")] = "",
    place: Annotated[str, typer.Option(help="of a figure of several numbers (fx, cx): which")] = "",
    limits: LimitsFile = None,
    json: Json = None,
    data: StoreFolder = None,
) -> None:
    """A figure of a camera over all its calibrations: bands and drift. Exit code 4 where the newest is bad or
    drifted.

    Example: calibench calibrations history left read_noise_e
    """
    from lab.calibration.life import figure_names
    from lab.calibration.life import history as looked_up
    from lab.formats.results.words import format_unit, plain_name, unit_of

    check_writable(json)
    store = store_to_read(data)
    if not figure:
        known = figure_names(store)
        cameras = ", ".join(dict.fromkeys(name for name, _, _ in known)) or "none"
        if camera and all(name != camera for name, _, _ in known):
            raise InputError(f"camera {camera!r} has no calibration in {store.root}; cameras that have: {cameras}")
        for name, of, where in known:
            if camera in ("", name):
                read_as = ", ".join(part for part in (plain_name(of, where), format_unit(unit_of(of))) if part)
                out.print(escape("  ".join(part for part in (name, of, where, f"({read_as})") if part)))
        return
    history = looked_up(store, camera, figure, place, _standing(store, limits))
    write_json(history, json)
    if str(json) != "-":
        warm = any(point.temperature_c is not None for point in history.points)
        unit = format_unit(history.unit)
        out.print(escape(f"{history.title or history.figure}{f', {unit}' if unit else ''}, of {history.camera}"))
        at = ("sensor, °C",) if warm else ()
        table = _table("calibration", "begun (UTC)", "state", "value", "std", *at, "mark", "sigma", "drift")
        for point in history.points:
            sigma = "" if point.significance_sigma is None else f"{point.significance_sigma:.1f}"
            values = (
                f"{point.value:.6g}",
                f"{point.std:.2g}",
                *((("" if point.temperature_c is None else f"{point.temperature_c:.1f}"),) if warm else ()),
                point.mark or "",
                sigma,
                "yes" if point.drifted else "no",
            )
            table.add_row(point.calibration_id, f"{point.created:%Y-%m-%d %H:%M}", point.state, *values)
        out.print(table)
    if history.points[-1].mark == "bad" or history.points[-1].drifted:
        raise typer.Exit(EXIT_CHECK)
