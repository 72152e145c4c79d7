"""Commands of the documentation: each is one that the command line, the Makefile or the service has, with options and
routes that they have; those that need neither a bench nor root nor minutes are run, PostgreSQL among them."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import httpx
import pytest
from typer.core import TyperGroup

from lab.cli.entry import command_tree
from tests.postgresql import database, postgresql
from tests.test_docs import PAGES, ROOT, text_of

BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
#: `calibench ...` in a line of a block, without what a shell does with its output.
CALIBENCH = re.compile(
    r"(?:^|[\s(\"])(?:\S*/|\$)?calibench +(?!calibench |--shell)((?:[a-z]|--)(?:[^|;&>()\n\"']|\"[^\"]*\"|'[^']*')*)"
)
CURL = re.compile(r"^curl .*", re.MULTILINE)
PYTHON = re.compile(r"^(?:\S*/)?python3? ", re.MULTILINE)
MAKE = re.compile(r"^make +([^#\n]*)", re.MULTILINE)
#: Why the commands of a page aren't run from the page itself.
NOT_RUN = {
    "CONTRIBUTING.md": "CI runs make lint, chromium, aravis, peers and test; the others take minutes to hours",
    "README.md": "CI runs make test; the first run is tests/lab/test_pipeline.py's",
    "docs/explanation/chain-of-light.md": "tests/lab/cli/test_cli.py simulates",
    "docs/explanation/diagnosis.md": "minutes; tests/lab/cli/test_cli.py saves a model and takes it as baseline",
    "docs/explanation/evidence.md": "minutes; tests/lab/inference",
    "docs/explanation/examples/emva1288-ccd.md": "recordings of others; tests/test_real_recordings.py where they are",
    "docs/explanation/examples/flea3.md": "recordings of others; tests/test_real_recordings.py where they are",
    "docs/explanation/examples/low-pass-and-infrared-filter.md": "tests/lab/diagnose/test_example.py",
    "docs/how-to/add-a-capture-kind.md": "tests/lab/capture_kinds/test_new_kind.py",
    "docs/how-to/add-a-measurement.md": "tests/test_add_pages.py",
    "docs/how-to/add-an-effect.md": "tests/test_add_pages.py",
    "docs/how-to/back-up-and-upgrade.md": "root and systemd; tests/lab/capture/test_backup.py and tests/deploy",
    "docs/how-to/calibrate-my-camera.md": "a bench; tests/lab/cli/test_cli.py captures on the mock one",
    "docs/how-to/certify-a-calibration.md": "a history of sessions; tests/lab/calibration/test_life.py",
    "docs/how-to/install-in-a-lab.md": "root and systemd; tests/deploy/test_lab_files.py",
    "docs/how-to/predict-a-change.md": "minutes; tests/lab/twin",
    "docs/how-to/run-in-ci.md": "minutes; tests/deploy/test_wheel.py and api/pytest_plugin.py's own tests",
    "docs/how-to/settle-a-doubt.md": "minutes; tests/lab/test_resolve.py",
    "docs/how-to/soak-a-bench.md": "hours: make soak",
    "docs/how-to/use-a-cluster.md": "a cluster; tests/lab/test_workers.py starts one",
    "docs/how-to/use-a-light-source.md": "a bench; tests/lab/capture/test_lamp_on_bench.py",
    "docs/how-to/use-argyll.md": "an instrument; tests/drivers/spectroradiometer/test_argyll.py",
    "docs/how-to/use-an-object-store.md": "an object store; tests/lab/formats/test_object_store.py",
    "docs/how-to/use-my-recordings.md": "minutes; tests/lab/formats/importers/test_raw_folder.py",
    "docs/how-to/write-an-extension.md": "installs a package; tests/lab/test_extensions.py",
    "docs/proof-twin.md": "hours: make twin",
    "docs/proof-unlisted.md": "hours: make proof-unlisted; tests/evaluation/test_unlisted.py makes two cases",
    "docs/proof.md": "hours: make proof; tests/evaluation/test_sealed.py makes and scores a few",
    "docs/reference/standards.md": "minutes; tests/lab/standards and tests/lab/cli",
    "docs/reference/command-line.md": "written by docs/write_tables.py from the command line itself",
    "docs/reference/lens.md": "lenses of the reader; tests/lab/predict/test_lens.py",
    "docs/reference/simulate.md": "tests/lab/cli/test_cli.py simulates",
    "docs/reference/mock-bench.md": "a bench; tests/mocks/test_command.py",
    "docs/reference/instruments.md": "a bench; tests/lab/cli/test_devices.py and tests/mocks/test_command.py",
    "docs/tutorial.md": "minutes; tests/lab/test_pipeline.py",
    "docs/test-a-driver.md": "tests/test_write_a_driver.py",
    "docs/write-a-driver.md": "tests/test_write_a_driver.py",
}
#: Pages that are run here, and which of their blocks: those with one of these words make their own inputs.
RUN = {
    "docs/how-to/bring-your-own-recordings.md": ("<<'PY'",),
    "docs/how-to/bring-pictures-and-tables.md": ("<<'PY'", "simulate slanted-edge", "simulate colorchecker24"),
    "docs/reference/camera-file.md": ("--write-camera",),
    "docs/reference/scenes.md": (),  # pictures and cubes of the reader; test_scenes_are_listed
    "docs/reference/rest.md": (),  # test_keys_and_service_on_postgresql
    "docs/reference/rest-recordings.md": (),  # tests/api/routes
    "docs/reference/rest-sessions.md": (),  # tests/api/routes
    "docs/reference/rest-stations.md": (),  # tests/api/routes
}


def blocks(page: Path) -> list[str]:
    """Blocks of a page that aren't files or what a program answers."""
    return [text for kind, text in BLOCK.findall(text_of(page)) if kind in ("", "sh")]


def calibench_commands() -> list[tuple[str, str]]:
    """Each page's name and each command of it."""
    return [
        (str(page.relative_to(ROOT)), found.strip())
        for page in PAGES
        if page.name != "command-line.md"
        for block in blocks(page)
        for found in CALIBENCH.findall(re.sub(r" +# .*", "", block))
    ]


def complaint(words: list[str]) -> str:
    """What the command line says of a command that it doesn't take; a file that isn't there is no fault of a page."""
    return complaint_of(command_tree(), words)


def complaint_of(command: Any, words: list[str]) -> str:
    """What a command tree says of words that it doesn't take."""
    context, name = None, "calibench"
    try:
        while True:
            context = command.make_context(name, list(words), parent=context)
            if not isinstance(command, TyperGroup):
                return ""
            rest = [*context._protected_args, *context.args]
            if not rest:  # a group that does something by itself
                return ""
            name, command, words = command.resolve_command(context, rest)
    except Exception as error:
        if not hasattr(error, "format_message"):  # only errors of usage have it; typer has its own, or click's
            raise
        told = str(error.format_message())
        return "" if "does not exist" in told else told or "a command is missing"


def test_a_command_that_there_is_not_is_noticed() -> None:
    assert "--jsn" in complaint(["fit", "set", "--jsn", "fit.json"])
    assert "fitt" in complaint(["fitt", "set"])
    assert complaint(["fit", "SET", "--json", "fit.json"]) == ""


def test_each_calibench_command_is_taken() -> None:
    commands = calibench_commands()
    assert len(commands) > 100
    wrong = []
    for page, text in commands:
        plain = re.sub(r"[\[\]]|\.\.\.|\|\S+", "", text)  # [--option] may be left out
        plain = re.sub(r"\b[NS]\b|\$\w+", "1", plain)  # a number that the reader or the shell gives
        if told := complaint(shlex.split(plain)):
            wrong.append(f"{page}: calibench {text}: {told}")
    assert wrong == []


def test_each_example_of_a_help_is_taken() -> None:
    pending, examples = [command_tree()], []
    while pending:
        command = pending.pop()
        pending += getattr(command, "commands", {}).values()
        examples += re.findall(r"Example: calibench (.+)", command.help or "")
    assert len(examples) > 35
    assert {text: found for text in examples if (found := complaint(shlex.split(text)))} == {}


def test_each_target_is_the_makefile_s() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z][\w-]*):", makefile, re.MULTILINE))
    for page in PAGES:
        for block in blocks(page):
            for line in MAKE.findall(block):
                named = [word for word in shlex.split(line) if "=" not in word]
                assert set(named) <= targets, f"{page}: make {line}"


def test_each_curl_asks_a_route_of_the_service() -> None:
    described = json.loads((ROOT / "docs" / "reference" / "openapi.json").read_text(encoding="utf-8"))["paths"]
    routes = {
        (re.compile(re.sub(r"\{[^}]+\}", r"[^/]+", path) + "$"), method.upper())
        for path, methods in described.items()
        for method in methods
    }
    asked = 0
    for page in PAGES:
        for block in blocks(page):
            for line in CURL.findall(re.sub(r" +# .*", "", block)):
                words = shlex.split(line)
                url = next(word for word in words if word.startswith(("$URL", "http://127.0.0.1:8000")))
                path = re.sub(r"^\$URL", "/api/v1", url.removeprefix("http://127.0.0.1:8000")).partition("?")[0]
                sends = any(word in ("-d", "--data-binary") for word in words) and "-G" not in words
                method = words[words.index("-X") + 1] if "-X" in words else "POST" if sends else "GET"
                assert any(route.match(path) and method == of for route, of in routes), f"{page}: {line}"
                asked += 1
    assert asked > 40


def test_each_page_with_commands_is_run_or_says_why_not() -> None:
    with_commands = {
        str(page.relative_to(ROOT))
        for page in PAGES
        if any(kind.search(block) for block in blocks(page) for kind in (CALIBENCH, CURL, MAKE, PYTHON))
    }
    assert with_commands == set(RUN) | set(NOT_RUN)
    for page, reason in NOT_RUN.items():
        for file in re.findall(r"(?:tests|docs|api)/[\w/.]+\w", reason):
            assert (ROOT / file).exists(), f"{page}: {file}"


# --- run --------------------------------------------------------------------------------------------------------------


@pytest.fixture
def desk(tmp_path: Path) -> dict[str, str]:
    """An environment in which `calibench`, `.venv/bin/calibench` and `.venv/bin/python` are this project's."""
    programs = tmp_path / ".venv" / "bin"
    programs.mkdir(parents=True)
    calls = {
        "python": "",
        "calibench": " -c 'import sys; from lab.cli import main; sys.exit(main(sys.argv[1:]))'",
    }
    for name, code in calls.items():
        (programs / name).write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)}{code} "$@"\n')
        (programs / name).chmod(0o755)
    path = f"{programs}{os.pathsep}{os.environ['PATH']}"
    return os.environ | {"PATH": path, "PYTHONPATH": str(ROOT), "CALIBENCH_DATA": str(tmp_path / "data")}


@pytest.mark.extra  # commands in processes of their own
@pytest.mark.parametrize(
    ("page", "block"),
    [
        pytest.param(page, block, id=f"{Path(page).stem}-{number}")
        for page, words in RUN.items()
        for number, block in enumerate(blocks(ROOT / page))
        if any(word in block for word in words)
    ],
)
def test_a_block_that_makes_its_inputs_runs(page: str, block: str, desk: dict[str, str], tmp_path: Path) -> None:
    done = subprocess.run(
        ["sh", "-euc", block], cwd=tmp_path, env=desk, capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, f"{page}:\n{block}\n{done.stdout}\n{done.stderr}"


@pytest.mark.extra
def test_keys_and_service_on_postgresql(desk: dict[str, str], tmp_path: Path) -> None:
    """docs/reference/rest.md: the registry in PostgreSQL, by the one variable that it names; keys and the service."""
    text = text_of(ROOT / "docs" / "reference" / "rest.md")
    variable = re.search(r"`(\w+)=postgresql://USER@HOST/NAME`", text)
    assert variable is not None
    with postgresql() as server, database(server, "docs") as url:
        environment = desk | {variable[1]: url}

        def calibench(*words: str) -> str:
            return subprocess.run(
                [str(tmp_path / ".venv/bin/calibench"), *words],
                env=environment,
                capture_output=True,
                text=True,
                timeout=120,
                check=True,
            ).stdout

        for command in ("key create ada --scope operate", "key list", "key remove ada"):
            assert f"calibench {command}" in text
        key = calibench("key", "create", "ada", "--scope", "operate")
        token = re.search(r"calibench_\S+", key)
        assert token is not None and "ada" in calibench("key", "list")
        with subprocess.Popen(
            [str(tmp_path / ".venv/bin/calibench"), "serve", "--port", "0", "--no-first-key"],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        ) as service:
            try:
                watch = threading.Timer(120.0, service.kill)
                watch.start()
                assert service.stdout is not None
                at = next(found for line in service.stdout if (found := re.search(r"http://[\d.]+:\d+", line)))
                watch.cancel()
                headers = {"Authorization": f"Bearer {token[0]}"}
                with httpx.Client(base_url=at[0], headers=headers, timeout=30.0) as client:
                    assert client.get("/api/v1/me").json() == {"name": "ada", "scope": "operate"}
                    calibench("key", "remove", "ada")
                    assert client.get("/api/v1/me").status_code == 401
            finally:
                service.terminate()
                service.communicate(timeout=60)
        assert not list((tmp_path / "data").glob("*.sqlite*")), "the registry is in PostgreSQL"
