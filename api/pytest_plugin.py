"""pytest fixtures for those who test a camera's calibration: a running mock bench, its station, a service with a
client, a reference.

An installation of calibench registers them; its extra `test` brings what they need. They are made when a test asks for
one, once a run.

`calibench_bench`      the mock bench, in a process of its own; `.station_file` is its station file
`calibench_station`    that station, as `lab.capture.station.Station`
`calibench_client`     an `api.client.ServiceClient` of a service that has the station as `bench`; its key may do
everything
`calibench_reference`  compares a fit with the reference that is kept beside the test, and fails where a figure drifted

Nothing heavy is imported before a fixture is used: the plugin is loaded by every pytest of the environment.
"""

from __future__ import annotations

import contextlib
import re
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from api.client import ServiceClient
    from lab.capture.station import Station
    from lab.formats.results import FitResult

#: How long (s) the service may take to start and to end.
START_S, END_S = 120.0, 30.0
_ADDRESS = re.compile(r"operator's page: (http://\S+)/")


def pytest_addoption(parser: pytest.Parser) -> None:
    """What the bench conceals, and whether references are written anew."""
    group = parser.getgroup("calibench")
    group.addoption(
        "--calibench-conceal",
        action="append",
        metavar="SIDE:EFFECT:PARAMETER=VALUE",
        help="what the mock bench conceals, as `calibench bench --conceal`; may be repeated. Without any: a healthy "
        "bench",
    )
    group.addoption(
        "--calibench-update",
        action="store_true",
        help="write the references of calibench_reference anew, and don't compare",
    )


@dataclass(frozen=True)
class MockBench:
    """A running mock bench. `conceals`: what it was told to."""

    station_file: Path
    conceals: tuple[str, ...]


@pytest.fixture(scope="session")
def calibench_bench(pytestconfig: pytest.Config) -> Iterator[MockBench]:
    """A mock bench in a process of its own, healthy but for what `--calibench-conceal` says."""
    from lab.cli.bench_process import mock_bench

    conceals = tuple(pytestconfig.getoption("--calibench-conceal") or ())
    with mock_bench(conceals, () if conceals else ("--healthy",)) as file:
        yield MockBench(file, conceals)


@pytest.fixture(scope="session")
def calibench_station(calibench_bench: MockBench) -> Station:
    """The bench's station."""
    from lab.capture.station import read_station

    return read_station(calibench_bench.station_file)


@contextlib.contextmanager
def service_process(data: Path) -> Iterator[str]:
    """`calibench serve` on a data folder, in a process of its own; its address."""
    command = [sys.executable, "-m", "lab.cli", "serve", "--data", str(data), "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    address: list[str] = []
    said: list[str] = []
    ready = threading.Event()

    def listen() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            said.append(line)
            if found := _ADDRESS.search(line):
                address.append(found[1])
            if "Uvicorn running" in line or "startup complete" in line:
                ready.set()
        ready.set()

    listener = threading.Thread(target=listen, daemon=True)
    listener.start()
    try:
        if not ready.wait(START_S) or not address or process.poll() is not None:
            raise RuntimeError("calibench serve doesn't start: " + "".join(said[-20:]))
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


@pytest.fixture(scope="session")
def calibench_client(calibench_bench: MockBench, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceClient]:
    """A client of a service of its own, on an empty data folder, with the bench as the station `bench`."""
    from api.client import ServiceClient
    from api.keys import Permission, create_key
    from lab.capture.store import Store

    data = tmp_path_factory.mktemp("calibench")
    with contextlib.closing(Store(data)) as store:
        key = create_key(store, "pytest", Permission.ADMIN)
    (data / "stations").mkdir(exist_ok=True)
    (data / "stations" / "bench.toml").symlink_to(calibench_bench.station_file)
    with service_process(data) as url, ServiceClient(url, key) as client:
        yield client


@dataclass(frozen=True)
class FitReference:
    """Fits that are kept beside a test, in `folder`. `update`: they are written, not compared."""

    folder: Path
    update: bool

    def check(self, fit: FitResult, name: str = "reference.json", fail_on: Sequence[str] = ("*",)) -> None:
        """Fail the test where a figure changed against the kept fit `name` beyond its uncertainty, and by more than the
        rule says.

        `fail_on`: rules as `calibench compare --fail-on` takes them, `[SIDE:]FIGURE[>AMOUNT[%]]`.
        """
        from lab.fit.compare import FailRule, compare, failures
        from lab.formats.result_file import read_result, write_result
        from lab.formats.results import FitResult

        file = self.folder / name
        rules = [FailRule.parse(text) for text in fail_on]
        if self.update:
            write_result(fit, file)
            return
        if not file.exists():
            pytest.fail(
                f"{file}: no reference yet; run `pytest --calibench-update` once and keep the file", pytrace=False
            )
        comparison = compare(read_result(FitResult, file), fit)
        if failed := failures(comparison, rules):
            rows = [
                f"  {row.side or ''} {row.name} {row.where}: {row.a:.6g} +- {row.a_std:.2g} -> {row.b:.6g} +- "
                f"{row.b_std:.2g}, "
                f"{row.significance_sigma:.1f} sigma"
                for row in comparison.changes
                if " ".join(part for part in (row.side, row.name, row.where) if part) in failed
            ]
            pytest.fail(
                "\n".join([f"{len(failed)} drifted against {file.name}: {', '.join(failed)}", *rows]), pytrace=False
            )


@pytest.fixture
def calibench_reference(request: pytest.FixtureRequest) -> FitReference:
    """Kept fits, beside the test's file."""
    return FitReference(request.path.parent, bool(request.config.getoption("--calibench-update")))
