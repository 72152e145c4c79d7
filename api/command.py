"""`calibench serve`, and `calibench key` for the keys that open it."""

from __future__ import annotations

import contextlib
import copy
import os
import socket
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from api.keys import Permission, check_bind, create_key, is_loopback, stored_keys
from lab.capture.data_folder import open_store, store_to_read
from lab.errors import InputError, NoRoom, Terminated

if TYPE_CHECKING:
    from lab.capture.store import Store

commands = typer.Typer()
key = typer.Typer(no_args_is_help=True, help="Keys for the REST service.")
commands.add_typer(key, name="key")

Folder = Annotated[
    Path | None, typer.Option("--data", metavar="DIR", help="the data folder (CALIBENCH_DATA, else calibench-data)")
]
FIRST_KEY = "first"
#: Longest wait (s), before the service is loaded, for the stations of sessions whose process died to be made safe.
RESCUE_FIRST_S = 4.0
#: Switch interval (s) of Python's threads: short, as a session's steps and the service's answers alternate often.
SWITCH_S = 0.001
_ANY = ("0.0.0.0", "::", "")  # addresses that listen everywhere and name no computer


def _first_key(store: Store) -> None:
    secret = create_key(store, FIRST_KEY, Permission.ADMIN)
    typer.echo(f"first start: the key '{FIRST_KEY}' (scope admin), shown only this once:\n\n    {secret}\n")


def logging_config() -> dict[str, Any]:
    """Return uvicorn's logging configuration, with a filter that removes keys from URLs."""
    from uvicorn.config import LOGGING_CONFIG

    config = copy.deepcopy(LOGGING_CONFIG)
    config["filters"] = {"hide_keys": {"()": "api.keys.HideKeys"}, "escape": {"()": "api.keys.EscapeControls"}}
    for handler in config["handlers"].values():
        handler["filters"] = ["hide_keys", "escape"]
    for name in ("api", "lab"):
        config["loggers"][name] = {"handlers": ["default"], "level": "INFO", "propagate": False}
    return config


def _listening(host: str, port: int) -> socket.socket:
    try:
        addresses = socket.getaddrinfo(host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, _, _, _, address = addresses[0]
        return socket.create_server(address[:2], family=family, backlog=128)
    except OSError as error:
        raise InputError(
            f"{host}:{port}: can't be listened at ({error.strerror}); choose another --port or --host, or end what "
            "uses it"
        ) from error


@commands.command()
def serve(
    host: Annotated[
        str, typer.Option(metavar="HOST", help="where to listen; others than this computer need a key first")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="where to listen; 0: a free one")] = 8000,
    allow_host: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="a name under which others reach it; may be repeated")
    ] = None,
    webhook_host: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="a host to which webhooks of sessions may be sent; may be repeated"),
    ] = None,
    create_first_key: Annotated[
        bool | None,
        typer.Option(
            "--create-first-key/--no-first-key",
            help="make and print an admin key if there is none; without either: only on loopback",
        ),
    ] = None,
    tls_certificate: Annotated[Path | None, typer.Option(metavar="FILE", help="PEM; serves https")] = None,
    tls_key: Annotated[Path | None, typer.Option(metavar="FILE", help="PEM, the certificate's private key")] = None,
    data: Folder = None,
) -> None:
    """Run the REST service and the operator's page. The first start on loopback makes a key and prints it.

    Example: calibench serve --port 8000 --data calibench-data
    """
    if (tls_certificate is None) != (tls_key is None):
        raise InputError("--tls-certificate and --tls-key belong together; give both")
    for file in (tls_certificate, tls_key):
        if file is not None and not os.access(file, os.R_OK):
            raise InputError(f"{file}: can't be read; give a PEM file")
    from lab.capture.recovery import Recovery
    from lab.capture.room import Room
    from lab.capture.safe_at_start import wait_until_safe_at_start
    from lab.capture.settings import Settings
    from lab.capture.tables import use_alone

    settings = Settings() if data is None else Settings(data=data)
    if (lack := Room(settings.data).look()) is not None:
        typer.echo(f"calibench: {lack}; until then halts and deletions work, and nothing new is started", err=True)
    try:
        store = open_store(data)
    except NoRoom:
        if settings.registry_file is None or not settings.registry_file.is_file():
            raise
        use_alone(settings.registry_file)
        store = open_store(data)
        typer.echo(
            "calibench: no other process can use the registry until this one ends; restart it when there is room",
            err=True,
        )
    wanted = is_loopback(host) if create_first_key is None else create_first_key
    makes_key = wanted and not stored_keys(store)
    if not makes_key:
        check_bind(host, stored_keys(store))
    with (
        _listening(host, port) as line,
        contextlib.closing(Recovery(store, made_safe=wait_until_safe_at_start())) as recovery,
    ):
        # Before the service itself is loaded, which takes seconds: an instrument that wasn't reached at once may be
        # unsafe.
        recovery.start(RESCUE_FIRST_S)

        import uvicorn

        from api.app import create_app

        if makes_key and lack is None:
            _first_key(store)
        names = {name.strip("[]").lower() for name in [*(allow_host or []), host] if name not in _ANY}
        webhook_hosts = {name.lower() for name in webhook_host or []}
        app = create_app(store, hosts=names, webhook_hosts=webhook_hosts, recovery=recovery)
        sys.setswitchinterval(SWITCH_S)
        server = uvicorn.Server(
            uvicorn.Config(
                app,
                log_config=logging_config(),
                server_header=False,
                ws="none",
                proxy_headers=False,
                timeout_graceful_shutdown=5,
                ssl_certfile=tls_certificate,
                ssl_keyfile=tls_key,
            )
        )
        shown = "127.0.0.1" if host in _ANY else f"[{host}]" if ":" in host else host
        url = f"{'http' if tls_certificate is None else 'https'}://{shown}:{line.getsockname()[1]}"
        typer.echo(f"operator's page: {url}/    REST: {url}/docs")
        with contextlib.suppress(Terminated):  # uvicorn raises the signal again, once it has ended in good order
            server.run(sockets=[line])


@key.command("create")
def create(
    name: Annotated[str, typer.Argument(help="name of the key's owner")],
    scope: Annotated[Permission, typer.Option(help="what it allows; each includes read")] = Permission.READ,
    data: Folder = None,
) -> None:
    """Make a key and print it. It can't be printed again.

    Example: calibench key create robot --scope operate
    """
    typer.echo(create_key(open_store(data), name, scope))


@key.command("list")
def list_keys(data: Folder = None) -> None:
    """List names and scopes of all keys.

    Example: calibench key list
    """
    for stored in stored_keys(store_to_read(data)):
        typer.echo(f"{stored.name}  {stored.scope}")


@key.command("remove")
def remove(name: Annotated[str, typer.Argument(help="name of the key's owner")], data: Folder = None) -> None:
    """Remove a key and the logins of the operator's page that were made with it.

    Example: calibench key remove robot
    """
    store_to_read(data).remove_key(name)
    typer.echo(f"removed: {name}")
