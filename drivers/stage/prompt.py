"""A person at the terminal as stage: asked to put a target in place and to confirm it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping

from drivers.errors import InstrumentError, Interrupted
from drivers.instrument import Identity, Recorder
from drivers.stage.base import Stage


class PromptStage(Stage):
    """Asks on the terminal.

    `instructions`: target -> what to do, where its name doesn't say it. `ask` shows a question and returns the answer,
    by default on the terminal. There is no time-out: only a closed terminal ends the wait.
    """

    def __init__(
        self,
        address: str = "",
        *,
        instructions: Mapping[str, str] | None = None,
        ask: Callable[[str], str] | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        self._instructions = dict(instructions or {})
        self._ask = ask
        self._record = recorder or (lambda direction, data: None)
        self._placed = ""

    def connect(self) -> None:
        if self._ask is None and not (sys.stdin and sys.stdin.isatty()):
            raise InstrumentError(
                "target stage: nobody can be asked, the input is no terminal; run it in one, or use the stage driver "
                "'operator'"
            )

    def identity(self) -> Identity:
        return Identity("", "prompt")

    def place(self, target: str) -> None:
        if target == self._placed:
            return
        self.connect()
        what = self._instructions.get(target, f"put {target} in front of the cameras")
        question = f"{target}: {what}, then press Enter (q to stop): "
        self._record("sent", question.encode("utf-8"))
        try:
            answer = (self._ask or input)(question)
        except (EOFError, OSError) as error:
            raise InstrumentError(
                f"target stage: the terminal was closed while waiting for {target}; start again and it resumes"
            ) from error
        self._record("received", answer.encode("utf-8"))
        if answer.strip().lower() in {"q", "quit"}:
            raise Interrupted(f"target stage: stopped at {target} by the operator; start again and it resumes")
        self._placed = target

    def instruct(self, instructions: Mapping[str, str]) -> None:
        """Instructions for targets that have none yet: those of the station file come first."""
        self._instructions = {**instructions, **self._instructions}

    def placed(self) -> str:
        return self._placed

    def targets(self) -> tuple[str, ...]:
        return ()

    def stop(self) -> None:
        """Nothing moves."""

    def close(self) -> None:
        """Nothing is held."""
