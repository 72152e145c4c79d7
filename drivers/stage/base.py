"""The stage abstraction: which target stands in front of the cameras."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping

from drivers.instrument import Instrument


class Stage(Instrument):
    """A device or a person that places targets. `place_timeout_s`: longest time to place one."""

    place_timeout_s: float = 600.0

    @abstractmethod
    def place(self, target: str) -> None:
        """Put a target in front of the cameras and return once it is there."""

    @abstractmethod
    def placed(self) -> str:
        """Return the target in place; an empty string if it isn't known."""

    @abstractmethod
    def targets(self) -> tuple[str, ...]:
        """Return the names of the available targets; empty if the stage doesn't report them."""

    def instruct(self, instructions: Mapping[str, str]) -> None:
        """Tell what an operator does for each target. A stage that moves by itself needs no instruction."""

    def ask_by(self, ask: Callable[[str, str], None]) -> None:
        """Have a person asked by `ask(target, instruction)`, which returns once it is done. A stage that asks nobody on
        a terminal needs nobody to ask for it."""
