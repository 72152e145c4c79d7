"""A person as stage."""

from __future__ import annotations

import pytest

from drivers.errors import InstrumentError, Interrupted
from drivers.stage.prompt import PromptStage


def test_the_person_is_asked_once_for_each_target() -> None:
    asked: list[str] = []

    def ask(question: str) -> str:
        asked.append(question)
        return ""

    stage = PromptStage(instructions={"cap": "put the caps on both lenses"}, ask=ask)
    for target in ("cap", "cap", "sphere"):
        stage.place(target)
        assert stage.placed() == target
    assert asked == [
        "cap: put the caps on both lenses, then press Enter (q to stop): ",
        "sphere: put sphere in front of the cameras, then press Enter (q to stop): ",
    ]


def test_the_station_files_instruction_comes_before_the_targets_own() -> None:
    asked: list[str] = []
    stage = PromptStage(instructions={"cap": "put the caps on"}, ask=lambda question: asked.append(question) or "")
    stage.instruct({"cap": "close every lens", "sphere": "turn to the sphere"})
    for target in ("cap", "sphere"):
        stage.place(target)
    assert [question.split(",")[0] for question in asked] == ["cap: put the caps on", "sphere: turn to the sphere"]


def test_the_person_can_stop() -> None:
    stage = PromptStage(ask=lambda question: "q")
    with pytest.raises(Interrupted, match="stopped at sphere by the operator"):
        stage.place("sphere")
    assert stage.placed() == ""


def test_a_closed_terminal_is_one_error() -> None:
    def closed(question: str) -> str:
        raise EOFError

    with pytest.raises(InstrumentError, match="terminal was closed while waiting for sphere"):
        PromptStage(ask=closed).place("sphere")


def test_without_a_terminal_nobody_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", None)
    with pytest.raises(InstrumentError, match="the input is no terminal"):
        PromptStage().connect()


def test_who_runs_the_session_may_ask_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", None)
    asked: list[tuple[str, str]] = []
    stage = PromptStage(instructions={"cap": "put the caps on"})
    stage.ask_by(lambda target, instruction: asked.append((target, instruction)))
    stage.connect()
    for target in ("cap", "cap", "sphere"):
        stage.place(target)
        assert stage.placed() == target
    assert asked == [("cap", "put the caps on"), ("sphere", "put sphere in front of the cameras")]


@pytest.mark.parametrize("place_timeout_s", [0.0, -1.0, float("nan")])
def test_a_time_out_that_is_none_is_refused(place_timeout_s: float) -> None:
    with pytest.raises(InstrumentError, match=r"place_timeout_s is .*above 0 s"):
        PromptStage(place_timeout_s=place_timeout_s)
