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

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from api.client import ServiceClient
    from lab.capture.station import Station
    from lab.formats.results import FitResult


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
    """A running mock bench. `conceals`: as the option states it."""

    station_file: Path
    conceals: tuple[str, ...]


@pytest.fixture(scope="session")
def calibench_bench(pytestconfig: pytest.Config) -> Iterator[MockBench]:
    """A mock bench in a process of its own, healthy but for what `--calibench-conceal` says."""
    from lab.bench_process import mock_bench

    conceals = tuple(pytestconfig.getoption("--calibench-conceal") or ())
    with mock_bench(conceals, () if conceals else ("--healthy",)) as file:
        yield MockBench(file, conceals)


@pytest.fixture(scope="session")
def calibench_station(calibench_bench: MockBench) -> Station:
    """The bench's station."""
    from lab.capture.station import read_station

    return read_station(calibench_bench.station_file)


@pytest.fixture(scope="session")
def calibench_client(calibench_bench: MockBench, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceClient]:
    """A client of a service of its own, on an empty data folder, with the bench as the station `bench`."""
    from api.local_service import local_service

    with local_service(calibench_bench.station_file, tmp_path_factory.mktemp("calibench"), name="bench") as client:
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
