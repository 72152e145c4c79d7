"""The typed client, and the pytest plugin that hands it out."""

from __future__ import annotations

import ast
import json
import re
import socket
import subprocess
import sys
import tomllib
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import api.client
import lab.fit
from api.client import OtherVersion, ServiceClient, ServiceProblem, ServiceUnreachable, connect
from api.pytest_plugin import FitReference
from api.schemas import Health, SessionStart, StoredSession
from lab.capture.session import Progress
from lab.errors import InputError
from lab.formats.results import FitResult
from tests.api.conftest import Running
from tests.lab.calibration.test_life import fitted, limits

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "docs" / "examples" / "ci"


def test_a_session_is_captured_fitted_and_certified(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lab.fit, "fit_recording_set", lambda *_: fitted(2.0))
    with ServiceClient(running.url, running.keys["admin"]) as client:
        assert client.health().status == "ok" and client.me().scope == "admin"
        assert [station.name for station in client.stations()] == ["fakes"]
        session = client.capture("fakes", quick=True, sequences=("dark",), name="nightly")
        assert session.state == "finished" and session.name == "nightly"
        captures = list(client.captures(session.id, side="left"))
        assert captures and {one.side for one in captures} == {"left"}
        np.testing.assert_array_equal(client.frame(captures[0]), running.store.frame(captures[0].id))
        assert client.fit(session.id) == fitted(2.0)
        (calibration,) = client.calibrations()
        done = client.certify(calibration.id, limits())
        assert done.state == "certified" and done.certified_by == "admin"
        history = client.history(calibration.cameras["left"], "noise read_noise_e")
        assert [point.value for point in history.points] == [2.0]
        assert [one.id for one in client.sessions()] == [session.id] and len(list(client.jobs())) == 1


def test_pages_are_followed(shared: Running) -> None:
    with ServiceClient(shared.url, shared.keys["read"]) as client:
        session = next(client.sessions())
        every = [one.id for one in client.captures(session.id)]
        assert len(every) > 4
        assert [one.id for one in client.captures(session.id, limit="3")] == every


def test_what_is_refused_is_an_exception_with_the_services_line(shared: Running) -> None:
    with ServiceClient(shared.url, shared.keys["read"]) as client:
        with pytest.raises(ServiceProblem, match="no session 'none'") as missing:
            client.session("none")
        assert missing.value.status == 404
        with pytest.raises(ServiceProblem, match="needs 'operate'"):
            client.capture("fakes")
    with (
        ServiceClient(shared.url, "calibench_wrong") as client,
        pytest.raises(ServiceProblem, match="401: no valid key"),
    ):
        client.me()


#: What a client of a program has no use for: the page's login.
OF_THE_PAGE = {("POST", "/login"), ("POST", "/logout"), ("GET", "/halt")}
#: Methods of the client that ask, and how; an archive's path gets the ending of the file that it is written to.
ASKS = {"_get": "GET", "_pages": "GET", "_events": "GET", "_fetch": "GET", "_post": "POST", "_send": "POST"}


def asked_by_the_client() -> set[tuple[str, str]]:
    """(method, path) of every request that the client's source has, parameters as `{}`."""
    found = set()
    for call in ast.walk(ast.parse(Path(api.client.__file__).read_text())):
        if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Attribute):
            continue
        texts = [ast.unparse(one).strip("f'\"") for one in call.args if isinstance(one, ast.Constant | ast.JoinedStr)]
        paths = [re.sub(r"{.*?}", "{}", one.replace("{self.url}", "")) for one in texts if "/" in one]
        if call.func.attr == "get" and paths == ["{}/health"]:
            continue
        how = ASKS.get(call.func.attr) or next(
            (one for one in texts if one in ("GET", "PUT", "POST", "PATCH", "DELETE")), "GET"
        )
        ending = ".{}" if call.func.attr == "_fetch" else ""
        found |= {(how, f"{path}{ending}") for path in paths}
    return found


def test_the_client_has_a_method_for_every_operation() -> None:
    described = json.loads((ROOT / "docs" / "reference" / "openapi.json").read_text())["paths"]
    wanted = {
        (method.upper(), re.sub(r"{.*?}", "{}", path.removeprefix("/api/v1")))
        for path, methods in described.items()
        for method in methods
    }
    assert wanted - asked_by_the_client() == OF_THE_PAGE


def types_of_the_client() -> dict[tuple[str, str], str]:
    """(method, path) -> name of the class that the client reads the answer as."""
    found = {}
    for call in ast.walk(ast.parse(Path(api.client.__file__).read_text())):
        if not isinstance(call, ast.Call):
            continue
        called = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
        if called not in ("_get", "_pages", "_post", "_send", "_read", "_read_list") or len(call.args) < 2:
            continue
        model, asked = call.args[:2]
        if not isinstance(model, ast.Name) or model.id == "model":
            continue
        method = ASKS.get(called, "GET")
        inside = [one for one in ast.walk(asked) if isinstance(one, ast.Constant | ast.JoinedStr)]
        texts = [ast.unparse(one).strip("f'\"") for one in inside]
        if called in ("_read", "_read_list"):
            method = next((one for one in texts if one in ("PUT", "POST", "PATCH", "DELETE")), method)
        if paths := [one for one in texts if "/" in one]:
            found[method, re.sub(r"{.*?}", "{}", paths[0].replace("{self.url}", ""))] = model.id
    return found


def name_of(schema: dict[str, Any]) -> str | None:
    """Class of a described answer, or of the items of a list; None for what has none, or several."""
    schema = schema.get("items", schema)
    return schema["$ref"].rpartition("/")[2].removesuffix("-Output") if "$ref" in schema else None


def test_the_clients_types_are_those_of_the_openapi_document() -> None:
    described = json.loads((ROOT / "docs" / "reference" / "openapi.json").read_text())["paths"]
    types, compared = types_of_the_client(), 0
    for path, methods in described.items():
        for method, operation in methods.items():
            key = (method.upper(), re.sub(r"{.*?}", "{}", path.removeprefix("/api/v1")))
            for status, response in operation["responses"].items():
                schema = response.get("content", {}).get("application/json", {}).get("schema")
                if status.startswith("2") and schema is not None and name_of(schema) and key in types:
                    assert types[key] == name_of(schema), key
                    compared += 1
    assert compared > 0.8 * len(types) > 40  # the others are events, and results whose path serves several kinds


def test_an_answer_of_another_version_is_one_line(shared: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    with ServiceClient(shared.url, shared.keys["read"]) as client:
        monkeypatch.setattr(api.client, "Me", Health)
        with pytest.raises(OtherVersion, match=r"200: the answer isn't of this version \(Health\.\w+: .*\); install"):
            client.me()


def test_a_service_that_isnt_there_is_one_line_with_a_remedy() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with pytest.raises(ServiceUnreachable, match=rf"http://127.0.0.1:{port}/: .*refused; start `calibench serve`"):
        connect(f"http://127.0.0.1:{port}", "calibench_none")


def test_connecting_needs_a_key_that_the_service_takes(shared: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CALIBENCH_KEY", raising=False)
    with pytest.raises(InputError, match="no key"):
        connect(shared.url)
    with pytest.raises(ServiceProblem, match="401: no valid key"):
        connect(shared.url, "calibench_wrong")
    monkeypatch.setenv("CALIBENCH_KEY", shared.keys["read"])
    with connect(f"{shared.url}/") as client:
        assert client.me().scope == "read"


def test_a_bar_shows_how_far_a_session_is(running: Running, capsys: pytest.CaptureFixture[str]) -> None:
    with ServiceClient(running.url, running.keys["admin"], progress=True) as client:
        assert client.capture("fakes", quick=True, sequences=("dark",)).state == "finished"
    assert re.search(r"session \w+ +\d+%", capsys.readouterr().err)


def test_recordings_are_sent_from_memory_and_worked_on(
    running: Running, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lab.fit, "fit_recording_set", lambda *_: fitted(2.0))
    with ServiceClient(running.url, running.keys["admin"]) as client:
        session = client.capture("fakes", quick=True, sequences=("dark",))
        recordings = running.store.recording_set(session.id)
        sent = client.send_recordings(recordings)
        assert sent.id != session.id and len(list(client.recorded_captures(sent.id))) == len(recordings.captures())
        assert client.fit(sent) == client.fit(session) == client.fit(session.id) == fitted(2.0)


def test_a_run_and_a_job_are_followed_to_their_end(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lab.fit, "fit_recording_set", lambda *_: fitted(2.0))
    with ServiceClient(running.url, running.keys["admin"]) as client:
        started = client.start_session(SessionStart(station="fakes", quick=True, sequences=("dark",)))
        told = list(client.follow_session(started.id))
        assert isinstance(told[-1], StoredSession) and told[-1].state == "finished"
        assert any(isinstance(one, Progress) for one in told)
        *_, last = client.follow_job(client.start_job("fit", started.id).id)
        assert last.state == "done"
        with pytest.raises(ServiceProblem, match="no job"):
            next(client.follow_job("0123456789abcdef"))


def test_a_capture_is_looked_at(shared: Running) -> None:
    with ServiceClient(shared.url, shared.keys["read"]) as client:
        session = next(client.sessions())
        first = next(client.captures(session.id))
        assert client.stored_capture(session.id, first.id) == first
        assert client.preview(session.id, first.id, width_px=32).startswith(b"\x89PNG")
        means = [one.mean_dn for one in client.capture_figures(session.id, first.id).channels]
        frame = client.frame(first)
        np.testing.assert_allclose(np.mean(means), frame.mean(), rtol=1e-6)  # four channels of as many pixels
        assert client.ready().status == "ok" and "calibench" in client.metrics()
        assert client.effect(client.effects()[0].name) == client.effects()[0] and client.parameters()


# --- the plugin -------------------------------------------------------------------------------------------------------


def test_a_reference_is_written_kept_and_compared(tmp_path: Path) -> None:
    with pytest.raises(pytest.fail.Exception, match="--calibench-update"):
        FitReference(tmp_path, update=False).check(fitted(2.0))
    FitReference(tmp_path, update=True).check(fitted(2.0))
    kept = FitReference(tmp_path, update=False)
    kept.check(fitted(2.01))
    with pytest.raises(pytest.fail.Exception, match="left noise read_noise_e") as drifted:
        kept.check(fitted(2.2))
    assert "2 +- 0.01 -> 2.2 +- 0.01" in str(drifted.value)
    kept.check(fitted(2.2), fail_on=["noise read_noise_e>20%"])
    assert FitResult.model_validate_json((tmp_path / "reference.json").read_text()) == fitted(2.0)


def test_the_installed_plugin_is_this_one_and_loads_nothing_heavy() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["entry-points"]["pytest11"] == {"calibench": "api.pytest_plugin"}
    needed = {line.split(">")[0] for line in project["optional-dependencies"]["test"]}
    assert needed == {"pytest"}  # httpx came with the client
    code = "import sys, api.pytest_plugin; print(sorted({'numpy', 'httpx', 'fastapi', 'pydantic'} & set(sys.modules)))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert loaded.stdout.strip() == "[]"


def pytest_of_example(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    (folder / "pytest.ini").touch()
    (folder / "test_calibration.py").write_text((EXAMPLE / "test_calibration.py").read_text())
    installed = {found.name for found in entry_points(group="pytest11")}
    plugin = [] if "calibench" in installed else ["-p", "api.pytest_plugin"]  # an environment made before it was there
    plugin += ["-p", "no:cacheprovider", "-p", "no:schemathesis"]
    command = [
        sys.executable,
        "-c",
        f"import sys; sys.path.insert(0, {str(ROOT)!r}); import pytest; sys.exit(pytest.main(sys.argv[1:]))",
    ]
    return subprocess.run([*command, "-q", *plugin, *options], capture_output=True, text=True, cwd=folder, check=False)


def test_the_example_names_fixtures_that_there_are(tmp_path: Path) -> None:
    listed = pytest_of_example(tmp_path, "--setup-plan")
    assert listed.returncode == 0, listed.stdout + listed.stderr
    for fixture in ("calibench_bench", "calibench_client", "calibench_station", "calibench_reference"):
        assert f"{fixture}" in listed.stdout


@pytest.mark.slow
@pytest.mark.timeout(900)  # three benches, one after the other
def test_the_example_fails_on_a_drifted_figure_and_only_then(tmp_path: Path) -> None:
    made = pytest_of_example(tmp_path, "--calibench-update")
    assert made.returncode == 0, made.stdout
    again = pytest_of_example(tmp_path)
    assert again.returncode == 0, again.stdout
    drifted = pytest_of_example(tmp_path, "--calibench-conceal", "left:row_noise:noise_e=3")
    assert drifted.returncode == 1 and "left noise read_noise_e" in drifted.stdout, drifted.stdout
    assert "right" not in drifted.stdout.split("drifted against")[1]
