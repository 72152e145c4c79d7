"""docker-compose.yml: what its services run exists, they find each other, and what is inside stays inside."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from dask.config import collect_env
from typer.main import get_command

from lab.capture.settings import Settings
from lab.cli.entry import add_commands, app
from lab.jobs import check_scheduler

ROOT = Path(__file__).parents[2]
FILE = ROOT / "docker-compose.yml"
COMPOSE: dict[str, Any] = yaml.safe_load(FILE.read_text())
SERVICES: dict[str, Any] = COMPOSE["services"]


def test_docker_takes_the_file() -> None:
    """`docker compose config` where there is one; it needs no daemon."""
    docker = shutil.which("docker")
    if docker is None or subprocess.run([docker, "compose", "version"], capture_output=True, check=False).returncode:
        pytest.skip("no docker compose")
    done = subprocess.run(
        [docker, "compose", "config", "--quiet"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_it_has_what_a_laboratory_needs() -> None:
    assert set(SERVICES) == {"service", "database", "certificate", "scheduler", "worker", "bench"}
    known = {"default", *COMPOSE["networks"]}
    for name, one in SERVICES.items():
        assert set(one.get("networks", ())) <= known, name
        for other, on in one.get("depends_on", {}).items():
            assert other in SERVICES, name
            assert on["condition"] != "service_healthy" or "healthcheck" in SERVICES[other], name
        for volume in one.get("volumes", ()):
            assert volume.split(":")[0] in COMPOSE["volumes"], name
        assert one["image"] == "calibench" or name == "database"


@pytest.mark.parametrize("name", ["service", "bench"])
def test_calibenchs_commands_have_their_options(name: str) -> None:
    add_commands()
    program, command, *arguments = shlex.split(SERVICES[name]["command"])
    assert program == "calibench"
    context = get_command(app).make_context("calibench", [command], resilient_parsing=True)
    found = context.command.get_command(context, command)  # type: ignore[attr-defined]
    known = {option for parameter in found.params for option in (*parameter.opts, *parameter.secondary_opts)}
    assert {argument for argument in arguments if argument.startswith("--")} <= known


@pytest.mark.parametrize("name", ["scheduler", "worker"])
def test_dasks_commands_have_their_options(name: str) -> None:
    from distributed.cli import dask_scheduler, dask_worker

    program, command, *arguments = shlex.split(SERVICES[name]["command"])
    found = {"scheduler": dask_scheduler.main, "worker": dask_worker.main}[command]
    known = {option for parameter in found.params for option in (*parameter.opts, *parameter.secondary_opts)}
    assert program == "dask" and {argument for argument in arguments if argument.startswith("--")} <= known
    assert (Path(sys.executable).parent / "dask").exists()


def test_dask_reads_the_certificates_and_speaks_tls_alone() -> None:
    keys = {name: value for name, value in COMPOSE["x-dask"].items() if name.startswith("DASK_")}
    comm = collect_env(keys)["distributed"]["comm"]
    from dask.config import get

    assert comm["require-encryption" if "require-encryption" in comm else "require_encryption"] is True
    tls = {part.replace("_", "-") for part in comm["tls"]}
    assert tls == {"ca-file", "scheduler", "worker", "client"} <= set(get("distributed.comm.tls"))
    for part in ("scheduler", "worker", "client"):
        assert comm["tls"][part] == {"cert": "/tls/certificate.pem", "key": "/tls/key.pem"}
    for name in ("service", "scheduler", "worker"):
        assert SERVICES[name]["environment"].items() >= keys.items()
        assert "tls:/tls:ro" in SERVICES[name]["volumes"]


def test_the_services_find_each_other_and_the_inside_is_closed() -> None:
    environment = SERVICES["service"]["environment"]
    fields = {f"CALIBENCH_{name.upper()}" for name in Settings.model_fields}
    assert {name for name in environment if name.startswith("CALIBENCH_")} <= fields | {"CALIBENCH_DATABASE_URL"}
    scheduler = environment["CALIBENCH_SCHEDULER"]
    check_scheduler(scheduler)
    assert scheduler in SERVICES["worker"]["command"] and "scheduler" in scheduler
    assert re.search(r"@database/calibench$", environment["CALIBENCH_DATABASE_URL"])
    assert COMPOSE["networks"]["inside"]["internal"] is True
    for name in ("database", "scheduler", "worker"):
        assert SERVICES[name]["networks"] == ["inside"] and "ports" not in SERVICES[name]
    assert all(port.startswith("127.0.0.1:") for port in SERVICES["service"]["ports"])
    # Jobs name the data folder by its path: workers have it under the same.
    assert SERVICES["worker"]["environment"]["CALIBENCH_DATA"] == environment["CALIBENCH_DATA"]
