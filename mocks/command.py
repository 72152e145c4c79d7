"""The commands that start mock instruments: `calibench mock` for one alone, `calibench bench` for the whole bench.

The bench's process holds the hidden truth; what leaves it is addresses, and what a lab would know of such a bench.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import typer

from mocks.wire import (
    AddressError,
    Endpoint,
    Fault,
    FaultSpecError,
    Grammar,
    MeasuredLight,
    Pty,
    Tcp,
    parse_faults,
    serve,
)

if TYPE_CHECKING:
    from mocks.bench import Bench
    from mocks.conceal import Concealed
    from mocks.display import MockScreen
    from mocks.lamp import Lamp
    from mocks.ready_frames import ReadyFrames
    from mocks.stage import Targets

    class Place(MeasuredLight, Targets, MockScreen, Protocol):
        """All that the mocks here act on: a bench, or a lamp alone."""


commands = typer.Typer()

#: Says what a bench conceals that is told nothing on its command line.
CONCEAL_VARIABLE = "CALIBENCH_CONCEAL"
#: What a calibration file of `calibench mock` is off by, as real ones are.
CALIBRATION_DEPARTURE_PERCENT = 2.0
#: The dark current doubles every few degrees: beyond this, darks saturate.
WARMEST_C = 40.0


def _mock(module: str, name: str, *identity: Any) -> Callable[[Place], Grammar]:
    """Makes a mock of the class `name` in `mocks.MODULE`, which is imported only then: `calibench --help` names them
    all."""
    return lambda place: getattr(import_module(f"mocks.{module}"), name)(place, *identity)


INSTRUMENTS: dict[str, Callable[[Place], Grammar]] = {
    "cornerstone260": _mock("cornerstone260", "MockCornerstone260"),
    "cornerstone260b-serial": _mock("cornerstone260b_serial", "MockCornerstone260BSerial"),
    "cm110": _mock("cm110", "MockCm110"),
    "sp2150": _mock("sp2150", "MockSp2150"),
    "specbos1211": _mock("specbos1211", "MockSpecbos1211"),
    "specbos1201": _mock("specbos1211", "MockSpecbos1211", "1201427", "specbos 1201", (380.0, 780.0)),
    "spectraval1501": _mock("specbos1211", "MockSpecbos1211", "1501427", "spectraval 1501", (380.0, 780.0)),
    "pr655": _mock("pr655", "PhotoResearch", "PR-655"),
    "pr670": _mock("pr655", "PhotoResearch", "PR-670", "67001234"),
    "cr250": _mock("cr300", "ColorimetryResearch", "CR-250"),
    "cr300": _mock("cr300", "ColorimetryResearch", "CR-300"),
    "cs2000": _mock("cs2000", "MockCs2000"),
    "spotread": _mock("spotread", "MockSpotread"),
    "scpi-meter": _mock("scpi_meter", "MockScpiMeter"),
    "pe4000": _mock("pe4000", "MockPe4000"),
    "stage": _mock("stage", "MockStage"),
}

#: Exported over USB/IP (`mocks.usb`).
USB_INSTRUMENTS = ("cornerstone260b", "usb2000plus", "u3v", "u3v-stereo")
#: Come with a calibration file (`--calibration`).
CALIBRATED = ("usb2000plus", "scpi-meter")
EVERY_INSTRUMENT = (*INSTRUMENTS, *USB_INSTRUMENTS, "tethered", "display")


class _Unusable(Exception):
    """An option that can't be used; the message is one line, the exit code 2."""


@commands.command()
def mock(
    name: Annotated[str, typer.Argument(metavar="INSTRUMENT", help=f"instrument: {', '.join(EVERY_INSTRUMENT)}")],
    link: Annotated[Path | None, typer.Option(help="make this path a link to the pseudo-terminal")] = None,
    tcp: Annotated[
        str,
        typer.Option(
            metavar="HOST:PORT", help="listen at it instead (display: to connect to; USB instruments: for USB/IP)"
        ),
    ] = "",
    fault: Annotated[
        str,
        typer.Option(
            metavar="SPEC",
            help="how to fail: KIND[=VALUE][@N[+]], as in half@3; late never half wrong error drop unplug, "
            "a camera's frames also torn repeated missed",
        ),
    ] = "",
    real_time: Annotated[
        float, typer.Option(min=0.0, help="real seconds for each second of the instrument (0: no waiting)")
    ] = 0.0,
    dialect: Annotated[
        str,
        typer.Option(help="which of an instrument's public dialects it speaks (pr655, pr670: two-lines, one-line)"),
    ] = "",
    calibration: Annotated[
        Path | None,
        typer.Option(help="write the calibration file that came with the instrument here (usb2000plus, scpi-meter)"),
    ] = None,
    frames: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="replay the frames *-left.npy and *-right.npy of this folder, in real time (u3v, u3v-stereo)",
        ),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="the folder that the camera's software writes raw files into (tethered)"),
    ] = None,
) -> None:
    """Serve one mock instrument on a pseudo-terminal, a TCP port or USB/IP; prints `ready ADDRESS` when it listens.

    Example: calibench mock cornerstone260 --link monochromator
    """
    from mocks.display import Page, browse
    from mocks.lamp import Lamp, LampClock
    from mocks.pr655 import PhotoResearch

    with _one_line_errors():
        _check_options(name, link=link, tcp=tcp, dialect=dialect, calibration=calibration, frames=frames, folder=folder)
        faults = parse_faults(fault, frames=name.startswith("u3v"))
        if calibration is not None:
            _write(calibration, _calibration_of(name))
        lamp = Lamp(clock=LampClock(real_time))
        stop = threading.Event()
        with _ended_by_signals(stop):
            if name == "display":
                host, port = _host_and_port(tcp or "127.0.0.1:8765")
                _say(f"ready {host}:{port}")
                browse(Page(lamp), f"{host}:{port}", stop, faults)
            elif folder is not None:
                _serve_tethered(folder, real_time, stop, faults)
            elif name in USB_INSTRUMENTS:
                light = lamp if not name.startswith("u3v") else _before_cameras(name, frames, real_time)
                _serve_usb(name, light, _host_and_port(tcp or "127.0.0.1:0"), stop, faults)
            else:
                endpoint = Tcp(*_host_and_port(tcp)) if tcp else Pty(link)
                grammar = INSTRUMENTS[name](lamp)
                if isinstance(grammar, PhotoResearch) and dialect:
                    grammar.dialect = dialect
                serve(grammar, endpoint, stop, faults=faults, announce=lambda at: _say(f"ready {at}"))


def _check_options(
    name: str,
    *,
    link: Path | None,
    tcp: str,
    dialect: str,
    calibration: Path | None,
    frames: Path | None,
    folder: Path | None,
) -> None:
    """Raise `_Unusable` for an instrument that isn't there, and for an option that this one doesn't take."""
    from mocks.pr655 import DIALECTS

    if name not in EVERY_INSTRUMENT:
        raise _Unusable(f"mock {name}: no such instrument; choose from {', '.join(EVERY_INSTRUMENT)}")
    by_line = name in INSTRUMENTS
    refused = {
        "it has no line that a path could name; leave --link out": link is not None and not by_line,
        "--link and --tcp exclude one another; give one of them": link is not None and bool(tcp),
        "its address is a folder; leave --tcp out": bool(tcp) and name == "tethered",
        "name the folder that its software writes into: --folder": folder is None and name == "tethered",
        "it writes into no folder; leave --folder out": folder is not None and name != "tethered",
        f"no dialect {dialect!r}; pr655 and pr670 have {', '.join(DIALECTS)}": bool(dialect)
        and (name not in ("pr655", "pr670") or dialect not in DIALECTS),
        "no calibration file comes with it; leave --calibration out": calibration is not None
        and name not in CALIBRATED,
        "it takes no frames; leave --frames out": frames is not None and not name.startswith("u3v"),
    }
    for why, wrong in refused.items():
        if wrong:
            raise _Unusable(f"mock {name}: {why}")


def _calibration_of(name: str) -> str:
    """Return the calibration file of one of `CALIBRATED`, as far off as real ones are."""
    from mocks import scpi_meter, usb2000plus

    if name == "scpi-meter":
        return scpi_meter.calibration_csv()
    return usb2000plus.calibration_csv(CALIBRATION_DEPARTURE_PERCENT)


def _before_cameras(name: str, frames: Path | None, real_time: float) -> Bench | ReadyFrames:
    """Return what stands before cameras that are served alone: white light, or frames that are ready."""
    from mocks.bench import Bench
    from mocks.ready_frames import ReadyFrames

    if frames is not None:
        try:
            return ReadyFrames.of_folder(frames, ("left", "right") if name == "u3v-stereo" else ("left",))
        except ValueError as error:
            raise _Unusable(f"--frames {error}") from error
    return _lit(Bench(real_time_factor=real_time))


def _lit(bench: Bench) -> Bench:
    """Return the bench with white light before the cameras."""
    bench.place("sphere")
    bench.set_shutter(True)
    return bench


def _serve_tethered(folder: Path, real_time: float, stop: threading.Event, faults: tuple[Fault, ...]) -> None:
    """Write pictures into a folder until `stop`; says the driver's settings as lines of a station file, then
    `ready`."""
    from mocks.bench import Bench
    from mocks.tethered import TetheredCamera

    if any(fault.kind == "error" for fault in faults):
        raise _Unusable("mock tethered: a folder has no error code; choose another fault")
    light = _lit(Bench(real_time_factor=real_time))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        camera = TetheredCamera(folder.absolute(), light)
        camera.start()
    except OSError as error:
        raise _Unusable(
            f"--folder {folder}: can't be written ({error.strerror}); name a folder that is yours"
        ) from error
    camera.fail(faults)
    for key, command in camera.settings.items():
        _say(f"{key} = {json.dumps(command)}")
    _say(f"ready {folder.absolute()}")
    stop.wait()
    camera.close()


def _serve_usb(
    name: str,
    light: Bench | Lamp | ReadyFrames,
    at: tuple[str, int],
    stop: threading.Event,
    faults: tuple[Fault, ...],
) -> None:
    from mocks.usb import devices, serve_usbip

    exported = devices(name, light)
    for device in exported:
        device.fail(faults)
    try:
        server = serve_usbip(exported, *at)
    except OSError as error:
        raise AddressError(
            f"--tcp {at[0]}:{at[1]}: can't listen there ({error.strerror}); choose a free port"
        ) from error
    with server:
        for device in exported:
            _say(f"ready {server.url(device.identity.serial_number)}")
        stop.wait()


@commands.command()
def bench(
    station: Annotated[Path | None, typer.Option(help="write the station file of this bench here")] = None,
    seed: Annotated[int, typer.Option(help="seed of the hidden truth and of the noise")] = 1,
    real_time: Annotated[
        float, typer.Option(min=0.0, help="real seconds for each second of the bench (0: no waiting)")
    ] = 0.0,
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="INSTRUMENT:SPEC", help="how it fails, as in spectroradiometer:half@3; may be repeated"),
    ] = None,
    host: Annotated[str, typer.Option(metavar="HOST", help="where the stage and the cameras listen")] = "127.0.0.1",
    advertise: Annotated[
        str, typer.Option(metavar="HOST", help="name of this computer for others; as --host if not given")
    ] = "",
    serial_over_tcp: Annotated[
        bool, typer.Option("--serial-over-tcp", help="the serial instruments listen at --host, too")
    ] = False,
    display: Annotated[str, typer.Option(metavar="HOST:PORT", help="at which the display driver will listen")] = "",
    with_parent: Annotated[bool, typer.Option("--with-parent", help="end when standard input is closed")] = False,
    conceal: Annotated[
        list[str] | None,
        typer.Option(
            help="SIDE:EFFECT:PARAMETER=VALUE[,...], as in left:nonlinearity:quadratic_percent=2, in place of the "
            "bench's "
            "default effects; may be repeated (or CALIBENCH_CONCEAL, with a ; between)"
        ),
    ] = None,
    healthy: Annotated[
        bool, typer.Option("--healthy", help="conceal nothing: cameras that do what their data sheet says")
    ] = False,
    warm_up: Annotated[
        float, typer.Option(help="degrees by which the sensors get warmer during the first virtual minutes")
    ] = 0.0,
    margins: Annotated[
        bool, typer.Option("--margins", help="frames hold masked pixels and overscan around the image, too")
    ] = False,
) -> None:
    """Run the whole mock bench: prints one line an instrument, then `ready`.

    Example: calibench bench --station bench.toml
    """
    with _one_line_errors():
        faults = _bench_faults(fault or [])
        concealed = _parse_concealed(conceal or [], healthy)
        stop = threading.Event()
        with _ended_by_signals(stop), contextlib.ExitStack() as running:
            line = _BenchLine(host, advertise or host, serial_over_tcp, display)
            place = _bench(seed, real_time, concealed, warm_up, with_margins=margins)
            addresses, known = _start_bench(running, stop, place, faults, line)
            for instrument, at in addresses.items():
                _say(f"{instrument} {at['driver']} {at['address']}")
            if station is not None:
                _write(station, station_toml(addresses, known))
                _say(f"station {station}")
            _say("ready")
            if with_parent:
                _wait_for_parent(stop)
            while not stop.wait(0.5):
                pass


@dataclass(frozen=True)
class _BenchLine:
    """Where the bench's instruments are to be reached."""

    host: str
    advertise: str
    serial_over_tcp: bool
    display: str

    def advertised(self, address: str) -> str:
        """Return the address as another machine writes it."""
        return address.replace(f"//{self.host}:", f"//{self.advertise}:", 1)

    def display_settings(self) -> tuple[str, dict[str, Any]]:
        """Return where the mock display connects to, and the driver's table of the station file."""
        if not self.display:
            address = f"127.0.0.1:{_free_port()}"
            return address, {"driver": "browser", "address": address}
        host, port = _host_and_port(self.display)
        if host in {"127.0.0.1", "localhost"}:
            return self.display, {"driver": "browser", "address": self.display}
        return self.display, {"driver": "browser", "address": f"0.0.0.0:{port}", "allow_remote": True}


def _parse_concealed(specs: list[str], healthy: bool) -> Concealed | None:
    """Return the effects to conceal, from the command line, else from the environment; None: the bench's default
    ones."""
    from mocks.conceal import ConcealError, parse

    stated = specs or [part for part in os.environ.get(CONCEAL_VARIABLE, "").split(";") if part.strip()]
    if healthy and stated:
        raise _Unusable("bench: --healthy conceals nothing; leave out --conceal, or --healthy")
    try:
        return parse(stated) if stated or healthy else None
    except ConcealError as error:
        raise _Unusable(str(error)) from error


def _bench(seed: int, real_time: float, concealed: Concealed | None, warm_up_c: float, *, with_margins: bool) -> Bench:
    from mocks.bench import Bench
    from mocks.truth import MARGINS
    from sim.sensor.margins import NO_MARGINS

    if not abs(warm_up_c) <= WARMEST_C:
        raise _Unusable(f"--warm-up {warm_up_c:g}: beyond {WARMEST_C:g} degrees; give how much warmer the sensors get")
    margins = MARGINS if with_margins else NO_MARGINS
    place = Bench(seed, real_time, concealed, margins=margins, warm_up_c=warm_up_c, session_clock=time.time)
    place.compile_loops()
    return place


def _start_bench(
    running: contextlib.ExitStack,
    stop: threading.Event,
    place: Bench,
    faults: Mapping[str, tuple[Fault, ...]],
    line: _BenchLine,
) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
    """Start everything; returns the addresses by instrument, and what a lab knows of this bench."""
    # The bench brings the whole forward model along: only this command pays for it.
    from mocks.cornerstone260 import MockCornerstone260
    from mocks.display import Page, browse
    from mocks.pe4000 import MockPe4000
    from mocks.specbos1211 import MockSpecbos1211
    from mocks.stage import MockStage
    from mocks.targets import SCREEN_COLS, SCREEN_ROWS, station_lights
    from mocks.usb import SERIAL_NUMBERS, serve_usbip, stereo_pair

    running.callback(stop.set)
    display_at, display_table = line.display_settings()
    addresses: dict[str, dict[str, Any]] = {
        "monochromator": {"driver": "cornerstone260"},
        "spectroradiometer": {"driver": "specbos1211"},
        "light_source": {"driver": "pe4000"},
        "display": display_table,
        "stage": {"driver": "operator"},
    }
    for instrument, grammar, endpoint in (
        ("monochromator", MockCornerstone260(place), Tcp(line.host, 0) if line.serial_over_tcp else Pty()),
        ("spectroradiometer", MockSpecbos1211(place), Tcp(line.host, 0) if line.serial_over_tcp else Pty()),
        ("light_source", MockPe4000(place), Tcp(line.host, 0) if line.serial_over_tcp else Pty()),
        ("stage", MockStage(place), Tcp(line.host, 0)),
    ):
        address = _serve_in_thread(running, stop, instrument, grammar, endpoint, faults.get(instrument, ()))
        addresses[instrument]["address"] = line.advertised(address)
    page = Page(place, SCREEN_ROWS, SCREEN_COLS)
    _thread(running, "display", lambda: browse(page, display_at, stop, faults.get("display", ())))
    cameras = stereo_pair(place)
    for device in cameras:
        device.fail(faults.get(f"cameras.{device.side}", ()))
    usb = running.enter_context(serve_usbip(cameras, line.host))
    for side, serial_number in SERIAL_NUMBERS.items():
        # The first frame of a new scene is rendered while the camera exposes: real seconds for virtual milliseconds.
        address = line.advertised(usb.url(serial_number))
        addresses[f"cameras.{side}"] = {"driver": "u3v", "address": address, "timeout_s": 60.0}
    addresses["light_source"]["lights"] = station_lights()
    addresses["cameras.left"]["output_line"] = "Line1"  # wired to the right camera's Line0
    known: dict[str, Any] = {"cameras": place.station_cameras(), "targets": place.station_targets()}
    return addresses, known


def _serve_in_thread(
    running: contextlib.ExitStack,
    stop: threading.Event,
    name: str,
    grammar: Grammar,
    endpoint: Endpoint,
    faults: tuple[Fault, ...],
) -> str:
    listening = threading.Event()
    _thread(
        running, name, lambda: serve(grammar, endpoint, stop, faults=faults, announce=lambda address: listening.set())
    )
    if not listening.wait(10.0):
        raise AddressError(f"bench: the {name} didn't start within 10 s; see the error above")
    return endpoint.address


def _thread(running: contextlib.ExitStack, name: str, work: Callable[[], None]) -> None:
    thread = threading.Thread(target=work, name=f"mock-{name}", daemon=True)
    thread.start()
    running.callback(thread.join, 5.0)


def station_toml(addresses: Mapping[str, Mapping[str, Any]], known: Mapping[str, Any]) -> str:
    """Return the station file (TOML): an address a table, the cameras' data sheets, the targets' nominal layout."""
    tables: dict[str, Any] = {"name": "mock bench", "cameras": {}}
    for instrument, at in addresses.items():
        family, _, side = instrument.partition(".")
        if side:
            tables[family][side] = {**at, "datasheet": known.get("cameras", {}).get(side, {})}
        else:
            tables[instrument] = dict(at)
    tables["targets"] = known.get("targets", {})
    return "\n".join(_toml_table((), tables)).lstrip("\n") + "\n"


def _toml_table(path: tuple[str, ...], table: Mapping[str, Any]) -> Iterator[str]:
    """Lines of one table: its values first, then its tables. What is None isn't known, and left out."""
    deeper = {key: value for key, value in table.items() if isinstance(value, Mapping) and len(path) < 4}
    plain = {key: value for key, value in table.items() if key not in deeper and value is not None}
    if path and (plain or not deeper):
        yield ""
        yield f"[{'.'.join(_toml_key(part) for part in path)}]"
    for key, value in plain.items():
        yield f"{_toml_key(key)} = {_toml_value(value)}"
    for key, value in deeper.items():
        yield from _toml_table((*path, str(key)), value)


def _toml_key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _toml_value(key)


def _toml_value(value: Any) -> str:
    if isinstance(value, Mapping):
        entries = (f"{_toml_key(str(k))} = {_toml_value(v)}" for k, v in value.items() if v is not None)
        return "{" + ", ".join(entries) + "}"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if hasattr(value, "tolist"):
        return _toml_value(value.tolist())
    return "[" + ", ".join(_toml_value(item) for item in value) + "]"


def _write(path: Path, text: str) -> None:
    """Whole or not at all: another process may be waiting for this file."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_text(text, encoding="utf-8")
        temporary.replace(path)
    except OSError as error:
        raise _Unusable(
            f"{path}: can't be written ({error.strerror}); give a path in a folder that is there"
        ) from error


@contextlib.contextmanager
def _one_line_errors() -> Iterator[None]:
    try:
        yield
    except (_Unusable, AddressError, FaultSpecError) as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(2) from None


@contextlib.contextmanager
def _ended_by_signals(stop: threading.Event) -> Iterator[None]:
    """SIGTERM, SIGINT and SIGHUP end the loop that waits on `stop`; what was set before comes back afterwards."""
    numbers = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _wait_for_parent(stop: threading.Event) -> None:
    """Set `stop` once standard input ends: whoever started the bench is gone, or wants it gone."""
    descriptor = sys.stdin.fileno()
    while not stop.is_set():
        if select.select([descriptor], [], [], 0.2)[0] and not os.read(descriptor, 4096):
            stop.set()


def _bench_faults(specs: list[str]) -> dict[str, tuple[Fault, ...]]:
    families = ("monochromator", "spectroradiometer", "light_source", "display", "stage")
    instruments = (*families, "cameras.left", "cameras.right")
    faults: dict[str, tuple[Fault, ...]] = {}
    for spec in specs:
        instrument, separator, what = spec.partition(":")
        if not separator or instrument not in instruments:
            raise _Unusable(f"--fault {spec}: write INSTRUMENT:SPEC with one of {', '.join(instruments)}")
        faults[instrument] = faults.get(instrument, ()) + parse_faults(what, frames=instrument.startswith("cameras."))
    return faults


def _host_and_port(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit() or int(port) > 65535:
        raise _Unusable(f"--tcp {text}: not an address; write HOST:PORT, as in 127.0.0.1:5025")
    return host, int(port)


def _free_port() -> int:
    """Return a port that nobody listens at now: the display's driver will."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


def _say(line: str) -> None:
    print(line, flush=True)
