"""The service on a real socket, on fake instruments."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import uvicorn

from api.app import create_app
from api.failed_keys import FailedKeys
from api.keys import Permission, create_key
from api.service import Limits
from drivers.monochromator.base import Monochromator
from lab.capture.station import drivers_of, read_station
from lab.capture.store import Store
from lab.formats.recording_set import Manifest, RecordingSet
from tests.lab.fake_bench import BLACK, COLS, ROWS, WHITE, Bench

STATION = f"""
name = "a bench of fakes"

[stage]
driver = "fake"
address = "stage"

[monochromator]
driver = "fake"
address = "monochromator"

[spectroradiometer]
driver = "fake"
address = "spectroradiometer"

[cameras.left]
driver = "fake"
address = "left"
datasheet = {{ rows = {ROWS}, cols = {COLS}, cfa = "RGGB", bit_depth = 12, black_level_dn = {BLACK}, white_level_dn = {WHITE} }}

[cameras.right]
driver = "fake"
address = "right"
datasheet = {{ rows = {ROWS}, cols = {COLS}, cfa = "RGGB", bit_depth = 12, black_level_dn = {BLACK}, white_level_dn = {WHITE} }}

[targets.cap]
kind = "cap"

[targets.sphere]
kind = "sphere"
"""  # noqa: E501


@dataclass
class Running:
    """A service under test: its address, its keys by scope, its store and instruments."""

    url: str
    keys: dict[str, str]
    store: Store
    bench: Bench
    app: Any

    def client(self, scope: str | None = "admin", **options: Any) -> httpx.Client:
        """A client with a key of that scope, or none."""
        headers = {"Authorization": f"Bearer {self.keys[scope]}"} if scope else {}
        return httpx.Client(base_url=self.url, headers=headers, timeout=30.0, **options)


@contextmanager
def serving(
    root: Path, *, limits: Limits | None = None, delay_s: float = 0.0, keys: dict[str, str] | None = None, port: int = 0
) -> Iterator[Running]:
    """The service in a thread of its own, with a key of each scope: those of before, or fresh ones."""
    store, bench = Store(root), Bench(delay_s)
    keys = keys or {scope.value: create_key(store, scope.value, scope) for scope in Permission}
    app = create_app(store, limits=limits, connect=bench.drivers)
    app.state.gate.failures = FailedKeys(most=1e6)  # all tests come from one address
    (store.root / "stations" / "fakes.toml").write_text(STATION)
    server = uvicorn.Server(uvicorn.Config(app, port=port, log_level="warning", ws="none", timeout_graceful_shutdown=2))
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        until = time.monotonic() + 20.0
        while not server.started:
            assert time.monotonic() < until and thread.is_alive()
            time.sleep(0.01)
        port = server.servers[0].sockets[0].getsockname()[1]
        yield Running(f"http://127.0.0.1:{port}", keys, store, bench, app)
    finally:
        server.should_exit = True
        thread.join(30.0)
        assert not thread.is_alive()
        store.close()


@contextmanager
def served(data: Path, *options: str, log: Path | None = None) -> Iterator[tuple[str, subprocess.Popen[str], Path]]:
    """The service as its own process: its address, the process, the file of its output (by default beside the
    data)."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    output = (log or data).with_suffix(".log")
    arguments = ["serve", "--data", str(data), "--port", str(port), *options]
    with output.open("w") as file:
        code = "import sys; from lab.cli import main; sys.exit(main(sys.argv[1:]))"
        process = subprocess.Popen(
            [sys.executable, "-c", code, *arguments],
            stdout=file,
            stderr=subprocess.STDOUT,
            text=True,
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
        )
    url = f"http://127.0.0.1:{port}"
    try:
        until = time.monotonic() + 60.0
        while True:
            try:
                httpx.get(f"{url}/health")
                break
            except httpx.TransportError:
                assert time.monotonic() < until and process.poll() is None, output.read_text()
                time.sleep(0.1)
        yield url, process, output
    finally:
        process.kill()
        process.wait(10.0)


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    """A service of one's own."""
    with serving(tmp_path) as service:
        yield service


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """A service for tests that change nothing, with one finished session."""
    with serving(tmp_path_factory.mktemp("data")) as service, service.client() as client:
        started = client.post("/api/v1/sessions", json={"station": "fakes", "quick": True, "sequences": ["dark"]})
        assert started.status_code == 201, started.text
        until_state(client, started.json()["id"], "finished")
        yield service


def until_state(client: httpx.Client, session_id: str, *states: str, patience_s: float = 20.0) -> dict[str, Any]:
    """Wait until a session is in one of these states."""
    return until(client, f"/api/v1/sessions/{session_id}", lambda found: found["state"] in states, patience_s)


def until(
    client: httpx.Client, path: str, reached: Callable[[dict[str, Any]], bool], patience_s: float = 20.0
) -> dict[str, Any]:
    """Wait until what a path answers is as wanted."""
    end = time.monotonic() + patience_s
    while True:
        found: dict[str, Any] = client.get(path).json()
        if reached(found):
            return found
        assert time.monotonic() < end, found
        time.sleep(0.02)


def events(client: httpx.Client, path: str, last: str = "end") -> list[tuple[str, dict[str, Any]]]:
    """(name, data) of a stream's events up to the one called `last`."""
    found: list[tuple[str, dict[str, Any]]] = []
    name = ""
    with client.stream("GET", path) as response:
        assert response.status_code == 200
        assert response.headers["content-type"].startswith("text/event-stream")
        for line in response.iter_lines():
            key, _, value = line.partition(": ")
            if key == "event":
                name = value
            elif key == "data":
                found.append((name, json.loads(value)))
                if name == last:
                    break
    return found


@pytest.fixture
def little_set() -> RecordingSet:
    """A recording set of two dark frames."""
    rng = np.random.default_rng(3)
    frames = {f"frames/{n}.npy": rng.integers(60, 70, (8, 10), dtype=np.uint16) for n in range(2)}
    camera = {"rows": 8, "cols": 10, "cfa": "MONO", "bit_depth": 12}
    captures = [
        {"id": f"d{n}", "kind": "dark", "side": "left", "frame": f"frames/{n}.npy", "exposure_s": 0.1} for n in range(2)
    ]
    manifest = Manifest.model_validate({"name": "two darks", "cameras": {"left": camera}, "captures": captures})
    return RecordingSet(manifest, frames)


def shutter_is_open(station: Path) -> bool:
    """As the monochromator itself says, on its own line, which nobody else may use now."""
    monochromator = drivers_of(read_station(station)).monochromator
    assert isinstance(monochromator, Monochromator)
    monochromator.connect()
    found = monochromator.shutter_is_open()
    monochromator._transport.close()  # type: ignore[attr-defined]  # `close` would close the shutter, too
    return found
