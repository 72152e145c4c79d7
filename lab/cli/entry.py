"""The application of all commands, and the entry point `main` that turns errors into exit codes."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from functools import cache
from importlib import metadata
from typing import Annotated, Any

import typer
from rich.markup import escape

from lab.cli import (
    backups,
    calibrations,
    capturing,
    devices,
    diagnosis,
    effects,
    fitting,
    recordings,
    simulation,
    standards,
)
from lab.cli.console import EXIT_INPUT, EXIT_INTERNAL, EXIT_INTERRUPTED, err, out, warn
from lab.cli.help import complete_help
from lab.cli.twin import commands as twin
from lab.errors import CannotWrite, DeviceError, InputError, Terminated, failure_of_environment
from sim.extensions import extensions, installed, refuse

app = typer.Typer(
    name="calibench",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


for _group in (capturing, fitting, standards, diagnosis, recordings, backups, simulation):
    app.registered_commands += _group.commands.registered_commands
app.add_typer(effects.commands)
app.add_typer(effects.check_command)
app.add_typer(twin)
app.add_typer(calibrations.calibrations)
app.add_typer(devices.devices)
app.add_typer(devices.station)


#: Commands that were removed, and what took their place.
REMOVED = {"challenge": "in a checkout of the project, run `python -m evaluation`"}


def _tell_version(asked: bool) -> None:
    if asked:
        out.print(f"calibench {metadata.version('calibench')}")
        raise typer.Exit


@app.callback()
def everywhere(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_tell_version, help="print the version and end")
    ] = False,
) -> None:
    """Captures with, calibrates and explains cameras."""


@cache
def add_commands() -> None:
    """Add the commands of the entry points `calibench.commands`, once a process: those of `api`, `mocks` and other
    packages. Warns where the installation, older than the files, has none."""
    if not installed("commands"):
        warn(("the commands of the service and of the mocks aren't installed; install calibench again (`make setup`)",))
    for name, commands in extensions("commands"):
        if not isinstance(commands, typer.Typer):
            refuse("commands", name, f"{commands!r} is no typer.Typer")
            continue
        app.registered_commands += commands.registered_commands
        app.registered_groups += commands.registered_groups


def command_tree() -> Any:
    """Return all commands, those of entry points among them, with their whole help."""
    add_commands()
    return complete_help(typer.main.get_command(app))


@contextlib.contextmanager
def _ended_as_by_ctrl_c() -> Iterator[None]:
    """Within it, SIGTERM interrupts as Ctrl-C does: a command ends the processes that it started."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, frame: Any) -> None:
        raise Terminated

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    if words and words[0] in REMOVED:
        err.print(f"[red]calibench:[/] {words[0]}: this command was removed; {REMOVED[words[0]]}")
        return EXIT_INPUT
    return run_command_line(command_tree, "calibench", arguments)


def run_command_line(commands: Callable[[], Any], program: str, arguments: list[str] | None) -> int:
    """Run a command line; return its exit code, errors among them, each reported in one line.

    Args:
        commands: returns the click command; an interruption while it loads counts, too.
        program: as it is called; its last word begins the lines of errors.
        arguments: None: those of this process.
    """
    speaker = program.rsplit(maxsplit=1)[-1]
    try:
        with _ended_as_by_ctrl_c():
            code = commands().main(arguments, prog_name=program, standalone_mode=False)
    except (InputError, DeviceError, CannotWrite) as error:
        if os.environ.get("CALIBENCH_DEBUG"):
            traceback.print_exc()
        for line in str(error).splitlines():
            err.print(f"[red]{speaker}:[/] {escape(line)}")
        return error.exit_code
    except KeyboardInterrupt:
        code = EXIT_INTERRUPTED
    except Exception as error:
        usage = getattr(error, "format_message", None)
        if usage is not None:
            context = getattr(error, "ctx", None)
            command = context.command_path if context is not None else program
            text = usage() if usage().endswith((".", "?")) else f"{usage()}."
            err.print(f"[red]{speaker}:[/] {escape(text)} See `{command} --help`.")
            return EXIT_INPUT
        if os.environ.get("CALIBENCH_DEBUG"):
            traceback.print_exc()
        if (failure := failure_of_environment(error)) is not None:
            err.print(f"[red]{speaker}:[/] {escape(str(failure))}")
            return EXIT_INPUT
        text = " ".join(str(error).split())
        err.print(
            f"[red]{speaker}:[/] {type(error).__name__}: {escape(text)}: a defect of calibench; "
            "report it with what CALIBENCH_DEBUG=1 shows"
        )
        return EXIT_INTERNAL
    if code == EXIT_INTERRUPTED:
        err.print(f"[red]{speaker}:[/] interrupted")
    return int(code or 0)
