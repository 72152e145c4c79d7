"""The stage abstraction: which target stands in front of the cameras, whoever puts it there."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping

from drivers.instrument import Instrument


class Stage(Instrument):
    """Something, or someone, that places targets."""

    @abstractmethod
    def place(self, target: str) -> None:
        """Put a target in front of the cameras and return once it stands there."""

    @abstractmethod
    def placed(self) -> str:
        """The target that stands there; an empty string if nobody knows."""

    @abstractmethod
    def targets(self) -> tuple[str, ...]:
        """Names of the targets at hand; empty if the stage can't tell."""

    def instruct(self, instructions: Mapping[str, str]) -> None:
        """Tell what an operator does for each target. A stage that moves by itself needs no instruction."""
