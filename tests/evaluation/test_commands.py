"""`python -m evaluation`: its commands, refusals before the work, and that the product does without it."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from evaluation.__main__ import command_tree, main
from tests.test_docs import PAGES, ROOT, text_of
from tests.test_docs_commands import complaint_of

COMMANDS = ("make", "score", "calibrate", "observables", "live", "names", "twin")


def evaluation_commands() -> dict[str, str]:
    """Commands of the blocks of pages, of the Makefile and of the helps, each with where it stands."""
    commands = {}
    for page in (*PAGES, ROOT / "Makefile"):
        for text in re.findall(r"(?<!`)python -m evaluation +([a-z][^#`\n]*)", text_of(page)):
            plain = text.replace("$(if $(SEED),--seed $(SEED))", "--seed 1").replace("$(ARGS)", "")
            plain = re.sub(r"[\[\]]|\.\.\.", " ", plain)  # [--option] may be left out
            # a number or a file that the reader or the shell gives
            plain = re.sub(r"\"\$\$\(cat .*?seed\)\"|\$\(\w+\)|\b[NS]\b", "1", plain)
            commands[plain] = page.name
    for name, command in command_tree().commands.items():
        for text in re.findall(r"Example: python -m evaluation (.+)", command.help or ""):
            commands[text] = name
    return commands


def test_every_verb_is_a_command() -> None:
    assert set(COMMANDS) <= set(command_tree().commands)


def test_each_command_of_the_pages_is_taken() -> None:
    commands = evaluation_commands()
    assert len(commands) > 15
    wrong = {
        f"{place}: {text}": told
        for text, place in commands.items()
        if (told := complaint_of(command_tree(), shlex.split(text)))
    }
    assert wrong == {}


@pytest.mark.parametrize(
    "arguments",
    [
        ["make", "--seed", "1", "--out", "OUT"],
        ["make", "--seed", "1", "--out", "DIR", "--truths", "OUT"],
        ["score", "SET", "--truths", "FILE", "--json", "OUT"],
        ["score", "SET", "--truths", "FILE", "--page", "OUT"],
        ["observables", "--out", "OUT"],
    ],
)
def test_an_output_that_cannot_be_written_is_refused_first(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """No input is there, either: the line is of the output where that is looked at first."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    place = str(tmp_path / "file" / "of")
    assert main([word.replace("OUT", place) for word in arguments]) == 2
    line = capsys.readouterr().err
    assert line.startswith("evaluation: ") and place in line and line.count("\n") == 1, line
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_cluster_that_is_not_there_is_said_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lab.workers.CONNECT_TIMEOUT_S", 0.3)
    assert main(["make", "--seed", "1", "--out", "DIR", "--scheduler", "tcp://127.0.0.1:9"]) == 2
    line = capsys.readouterr().err
    assert line.startswith("evaluation: Dask scheduler tcp://127.0.0.1:9: not reached") and line.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["live", "names", "twin", "observables"])
def test_a_case_that_there_is_not_is_said_in_one_line(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    option = "--source" if command == "observables" else "--only"
    assert main([command, "--out", str(tmp_path / "out"), option, "nonsense"]) == 2
    line = capsys.readouterr().err
    assert line.startswith(f"evaluation: {option} nonsense: ") and not (tmp_path / "out").exists()


def test_the_product_runs_without_it() -> None:
    """Modules of every package of the product are imported in a process that can't import the evaluation."""
    code = (
        "import sys, pkgutil, importlib; sys.modules['evaluation'] = None\n"
        "import api, drivers, lab, mocks, sim, lab.jobs, lab.pipeline, lab.cli.entry, api.app, mocks.bench\n"
        "lab.cli.entry.command_tree()"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, timeout=120)
