"""A person as stage: asked to put a target in place and to confirm it, on the terminal or over the service."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping

from drivers.errors import InstrumentError, Interrupted
from drivers.instrument import Identity, Recorder
from drivers.stage.base import Stage


class PromptStage(Stage):
    """Asks on the terminal, or by what `ask_by` was given.

    `instructions`: target -> what to do, where its name doesn't say it. `place_timeout_s`: how long the person is
    waited for. `ask` shows a question and returns the answer, by default on the terminal.
    """

    def __init__(
        self,
        address: str = "",
        *,
        instructions: Mapping[str, str] | None = None,
        place_timeout_s: float = 3600.0,
        ask: Callable[[str], str] | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        if not place_timeout_s > 0.0:
            raise InstrumentError(
                f"target stage: place_timeout_s is {place_timeout_s!r}; give how long a person is waited for, above 0 s"
            )
        self.place_timeout_s = place_timeout_s
        self._instructions = dict(instructions or {})
        self._ask = ask
        self._elsewhere: Callable[[str, str], None] | None = None
        self._record = recorder or (lambda direction, data: None)
        self._placed = ""

    def connect(self) -> None:
        if self._ask is None and self._elsewhere is None and not (sys.stdin and sys.stdin.isatty()):
            raise InstrumentError(
                "target stage: nobody can be asked, the input is no terminal; run it in one, or by the service, which "
                "asks on its page"
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
        if self._elsewhere is not None:
            self._elsewhere(target, what)
            self._placed = target
            return
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
        """Take instructions for targets that have none yet: those of the station file come first."""
        self._instructions = {**instructions, **self._instructions}

    def ask_by(self, ask: Callable[[str, str], None]) -> None:
        """Ask by this, and not on the terminal."""
        self._elsewhere = ask

    def placed(self) -> str:
        return self._placed

    def targets(self) -> tuple[str, ...]:
        return ()

    def stop(self) -> None:
        """Do nothing: nothing moves."""

    def close(self) -> None:
        """Do nothing: nothing is held."""
