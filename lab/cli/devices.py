"""`calibench devices` and `calibench station`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from lab.cli.console import EXIT_CHECK, check_writable, err, out
from lab.errors import DeviceError, InputError
from lab.formats.toml_file import read_toml

if TYPE_CHECKING:
    from drivers.contract.peer import Peer

devices = typer.Typer(
    name="devices",
    help="List what is connected and what drives it. Its commands tell whether it works.",
    subcommand_metavar="[COMMAND] [ARGS]...",
    add_completion=False,
)
station = typer.Typer(name="station", help="The station file.", no_args_is_help=True, add_completion=False)

UsbIp = Annotated[str, typer.Option("--usbip", metavar="HOST[:PORT]", help="also what this USB/IP server exports")]
StationFile = Annotated[Path, typer.Argument(metavar="STATION", help="the station file")]


@devices.callback(invoke_without_command=True)
def listed(
    context: typer.Context,
    usbip: UsbIp = "",
    probe: Annotated[
        str,
        typer.Option("--probe", metavar="PORT", help="ask each serial driver whether its instrument is at this port"),
    ] = "",
) -> None:
    """List what is connected and what drives it."""
    from drivers import discovery
    from drivers.errors import InstrumentError

    if context.invoked_subcommand is not None:
        return
    table = _table("address", "what", "driver")
    count, answered = 0, False
    try:
        if probe:
            for name, answer in discovery.probe(probe):
                reply = "no"
                if not isinstance(answer, InstrumentError):
                    answered = True
                    reply = " ".join(filter(None, (answer.maker, answer.model, answer.serial_number)))
                table.add_row(escape(probe), escape(reply), name)
                count += 1
        else:
            for instrument in discovery.find_all(usbip):
                table.add_row(escape(instrument.address), escape(instrument.what), instrument.driver or "-")
                count += 1
    except InstrumentError as error:
        raise DeviceError(str(error)) from error
    if count:
        out.print(table)
        if probe and not answered:
            raise DeviceError(
                f"{probe}: none of these drivers' instruments answers there; check the power and the cable, and that "
                "the instrument is set to the speed that its driver uses"
            )
    else:
        out.print(
            "nothing is connected that is known here; serial ports of USB adapters, USB instruments and cameras are "
            "looked for"
        )


@devices.command()
def check(station_file: StationFile) -> None:
    """Connect to each instrument of a station, use it once, and report whether it works. Exit code 3 if one doesn't.

    Example: calibench devices check lab.toml
    """
    from lab.capture.self_test import data_sheets, self_tests
    from lab.capture.station import drivers_of, read_station

    failed, station = 0, read_station(station_file)
    for test in self_tests(drivers_of(station), data_sheets(station)):
        out.print(
            f"{'[green]works[/]' if test.works else '[red]fails[/]'}  {test.name}  {escape(test.identity or '-')}"
        )
        if not test.works:
            failed += 1
            out.print(f"       {escape(test.words)}")
    if failed:
        raise DeviceError(
            f"{failed} of the station's instruments {'does' if failed == 1 else 'do'} not work; see above"
        )


@devices.command()
def transcript(
    station_file: StationFile,
    name: Annotated[str, typer.Argument(metavar="INSTRUMENT", help="monochromator, cameras.left, ...")],
    file: Annotated[Path, typer.Option("--out", metavar="FILE", help="the transcript to write")],
) -> None:
    """Record the messages to and from an instrument while it is identified and used once.

    Example: calibench devices transcript lab.toml monochromator --out monochromator.txt
    """
    from lab.capture.self_test import record_transcript
    from lab.capture.station import read_station

    check_writable(file)
    test = record_transcript(read_station(station_file), name, file)
    out.print(f"{test.name}: {escape(test.words)}")
    out.print(f"transcript: {file}")
    if not test.works:
        raise DeviceError(f"{name}: {test.words}")


@devices.command()
def contract(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="the drivers and their peers (TOML)")],
) -> None:
    """Check that drivers keep their family's contract. Exit code 4 if one doesn't.

    FILE has a table [[instrument]] a driver: `driver` ("family.name"), and either `peer` ("module:callable", a mock) or
    `address` and the driver's settings (a real instrument).

    Example: calibench devices contract drivers.toml
    """
    from drivers.contract.checks import check_driver
    from drivers.errors import InstrumentError

    broken = 0
    for entry in _contract_entries(file):
        family, _, name = str(entry.pop("driver")).partition(".")
        try:
            with _peer_of(entry) as peer:
                for outcome in check_driver(family, name, peer):
                    broken += outcome.ended == "not met"
                    mark = {"met": "[green]met[/]     ", "not met": "[red]not met[/] ", "left out": "left out"}[
                        outcome.ended
                    ]
                    out.print(
                        f"{mark}  {family}.{name}  {outcome.asks}{f': {escape(outcome.why)}' if outcome.why else ''}"
                    )
        except InstrumentError as error:
            raise DeviceError(str(error)) from error
    if broken:
        err.print(f"[red]calibench:[/] {broken} {'check' if broken == 1 else 'checks'} not met")
        raise typer.Exit(EXIT_CHECK)


@station.command()
def init(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="the station file to write")],
    usbip: UsbIp = "",
) -> None:
    """Write a station file of the connected instruments: cameras with pixels, colour filters and bit depth, others with
    their addresses.

    Example: calibench station init lab.toml
    """
    from drivers import discovery
    from drivers.errors import InstrumentError
    from lab.capture.self_test import station_text

    if file.exists():
        raise InputError(f"{file}: is there already; name a new file, or remove it")
    check_writable(file)
    try:
        text = station_text(discovery.find_all(usbip))
    except InstrumentError as error:
        raise DeviceError(str(error)) from error
    file.write_text(text, encoding="utf-8")
    out.print(f"station: {file}")


def _table(*headings: str) -> Table:
    table = Table(box=None, pad_edge=False)
    for heading in headings:
        table.add_column(heading)
    return table


def _contract_entries(file: Path) -> list[dict[str, object]]:
    entries = read_toml(file, "give a file with a table [[instrument]] a driver").get("instrument")
    if not isinstance(entries, list) or not entries:
        raise InputError(
            f"{file}: names no instrument; write a table [[instrument]] with driver and peer, or driver and address"
        )
    for entry in entries:
        if not isinstance(entry, dict) or "." not in str(entry.get("driver", "")):
            raise InputError(f'{file}: an [[instrument]] without driver; write driver = "family.name"')
        if ("peer" in entry) == ("address" in entry):
            raise InputError(f"{file}: {entry['driver']} needs either peer or address; give one of them")
    return entries


def _peer_of(entry: dict[str, object]) -> Peer:
    from drivers.contract.peer import RealInstrument, start_peer

    if "peer" in entry:
        return start_peer(str(entry["peer"]))
    return RealInstrument(str(entry.pop("address")), entry)
