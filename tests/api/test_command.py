"""`calibench serve` and `calibench key`, as processes see them."""

from __future__ import annotations

import re
import signal
import socket
from pathlib import Path

import httpx
import pytest
from typer.testing import CliRunner

from api.command import commands
from api.keys import stored_keys
from lab.capture.store import Store
from lab.cli import main
from tests.api.conftest import served

KEY = re.compile(r"calibench_[A-Za-z0-9_-]{43}")


def run(*arguments: str) -> str:
    result = CliRunner().invoke(commands, list(arguments))
    assert result.exit_code == 0, result.output
    return result.output


def test_keys_are_made_listed_and_taken_away(tmp_path: Path) -> None:
    data = ["--data", str(tmp_path)]
    secret = run("key", "create", "ada", "--scope", "operate", *data).strip()
    assert KEY.fullmatch(secret)
    assert run("key", "list", *data) == "ada  operate\n"
    assert secret not in run("key", "remove", "ada", *data)
    assert run("key", "list", *data) == ""


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["serve", "--host", "0.0.0.0"], "key create"),
        (["serve", "--host", "::"], "key create"),
        (["serve", "--host", "192.0.2.1"], "key create"),
        (["serve", "--tls-key", "nothing.pem"], "both"),
        (["serve", "--tls-key", "nothing.pem", "--tls-certificate", "nothing.pem"], "nothing.pem"),
        (["key", "remove", "nobody"], "nobody"),
        (["key", "create", "a b"], "a b"),
    ],
)
def test_wrong_use_is_one_line_and_exit_2(
    tmp_path: Path, arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Store(tmp_path).close()  # keys are those of a registry that is there
    assert main([*arguments, "--data", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert said in error and len(error.strip().splitlines()) == 1
    store = Store(tmp_path)
    assert stored_keys(store) == []  # no key was made behind anyone's back
    store.close()


def test_the_first_start_prints_a_key_once_and_no_log_shows_one(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with served(data) as (url, process, output):
        (secret,) = KEY.findall(output.read_text())
        with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {secret}"}) as client:
            assert client.get("/api/v1/me").json() == {"name": "first", "scope": "admin"}
            # A client that ignores all advice; the log must not keep what it did.
            assert client.get("/api/v1/me", params={"key": secret}).status_code == 422  # a key is no query parameter
            assert client.get(f"/{secret}").status_code == 404
            assert client.post("/login", json={"key": secret}).status_code == 200
        process.send_signal(signal.SIGTERM)
        assert process.wait(20.0) == 0  # in good order, as systemd expects it
        text = output.read_text()
        assert KEY.findall(text) == [secret] and "calibench_***" in text
        assert "Traceback" not in text and "ERROR" not in text
    with served(data) as (url, process, output):
        assert not KEY.search(output.read_text())
        with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {secret}"}) as client:
            assert client.get("/api/v1/me").status_code == 200
        process.send_signal(signal.SIGINT)
        assert process.wait(20.0) in (130, -signal.SIGINT)


def test_a_port_that_is_taken_is_said(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["serve", "--port", str(port), "--data", str(tmp_path)]) == 2
    assert "choose another --port" in capfd.readouterr().err
