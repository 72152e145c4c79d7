"""A service of one's own on this computer, in a process of its own: `calibench.local_service`."""

from __future__ import annotations

import contextlib
import re
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

from api.client import ServiceClient
from api.keys import Permission, create_key
from lab.capture.store import Store

#: How long (s) the service may take to start and to end.
START_S, END_S = 120.0, 30.0
_ADDRESS = re.compile(r"operator's page: (http://\S+)/")


@contextlib.contextmanager
def service_process(data: Path) -> Iterator[str]:
    """Run `calibench serve` on a data folder within the block, in a process of its own; yield its address."""
    command = [sys.executable, "-m", "calibench", "serve", "--data", str(data), "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    address: list[str] = []
    lines: list[str] = []
    ready = threading.Event()

    def listen() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            lines.append(line)
            if match := _ADDRESS.search(line):
                address.append(match[1])
            if "Uvicorn running" in line or "startup complete" in line:
                ready.set()
        ready.set()

    listener = threading.Thread(target=listen, daemon=True)
    listener.start()
    try:
        if not ready.wait(START_S) or not address or process.poll() is not None:
            raise RuntimeError("calibench serve doesn't start: " + "".join(lines[-20:]))
        yield address[0]
    finally:
        process.terminate()
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        listener.join(END_S)
        process.stdout.close()


@contextlib.contextmanager
def local_service(
    station: str | Path | None = None,
    data: str | Path | None = None,
    *,
    name: str = "",
    progress: bool | None = None,
) -> Iterator[ServiceClient]:
    """Start a service on this computer for the block, on a free port of the loopback address.

    station : a station file that it drives; None: it has those of the data folder
    data : the data folder, made where it isn't there; None: a temporary one
    name : the station's name in the service; empty: the file's, without `.toml`
    progress : show a bar while a session or a job runs; None: on a terminal and in a notebook

    Yields a client with a key that may do everything; the service ends with the block. Raises RuntimeError where the
    service doesn't start.

    >>> import calibench
    >>> with calibench.local_service() as client:
    ...     client.health().status
    'ok'
    """
    with contextlib.ExitStack() as stack:
        folder = Path(data or stack.enter_context(tempfile.TemporaryDirectory(prefix="calibench-")))
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.closing(Store(folder)) as store:
            key = create_key(store, "local", Permission.ADMIN)
        if station is not None:
            (folder / "stations").mkdir(exist_ok=True)
            place = folder / "stations" / f"{name or Path(station).stem}.toml"
            place.unlink(missing_ok=True)
            place.symlink_to(Path(station).resolve())
        url = stack.enter_context(service_process(folder))
        yield stack.enter_context(ServiceClient(url, key, progress=progress))
