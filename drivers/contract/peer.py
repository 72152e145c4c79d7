"""What stands at the other end while a driver is checked: a mock that can be silenced and unplugged, or a real
instrument.

A package that has drivers offers the peers of their checks by entry points of the group `calibench.peers`, under the
drivers' names (`family.name`): a callable without arguments that returns a running `Peer`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from types import TracebackType
from typing import Any, Self

from drivers.errors import InstrumentError

GROUP = "calibench.peers"


class Peer(ABC):
    """A running instrument that does what the checks ask of it. `address`, `settings`: what its driver is made with."""

    address: str
    settings: dict[str, Any]
    #: Whether it can be silenced and unplugged.
    can_fail = True

    @abstractmethod
    def mute(self, silent: bool) -> None:
        """Hear and say nothing, as if it hung; or go on."""

    @abstractmethod
    def unplug(self) -> None:
        """Be gone, whatever is under way."""

    @abstractmethod
    def plug(self) -> None:
        """Be back at the same address."""

    @abstractmethod
    def slow(self, slowly: bool) -> bool:
        """Take seconds for what takes an instrument long (a motion, a measurement, an exposure); False: it can't."""

    @abstractmethod
    def close(self) -> None:
        """End it."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class RealInstrument(Peer):
    """An instrument at its address: nobody silences or unplugs it, and what needs that is left out."""

    can_fail = False

    def __init__(self, address: str, settings: dict[str, Any]) -> None:
        self.address, self.settings = address, settings

    def mute(self, silent: bool) -> None:
        """Do nothing: nobody silences or unplugs a real instrument."""

    def unplug(self) -> None:
        """Do nothing: nobody silences or unplugs a real instrument."""

    def plug(self) -> None:
        """Do nothing: it is plugged in."""

    def slow(self, slowly: bool) -> bool:
        return False

    def close(self) -> None:
        """Do nothing: it stays there."""


def peers() -> dict[str, EntryPoint]:
    """Return the peers that installed packages offer, by the driver's name (`family.name`).

    >>> "monochromator.cornerstone260" in peers()
    True
    """
    return {point.name: point for point in entry_points(group=GROUP)}


def start_peer(reference: str) -> Peer:
    """Return the peer that a reference makes.

    reference : `module:callable`

    Raises `InstrumentError` where there is none.

    >>> with start_peer("mocks.peers:prompt_stage") as peer:
    ...     isinstance(peer, Peer)
    True
    """
    module, _, name = reference.partition(":")
    try:
        make: Callable[[], Peer] = getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise InstrumentError(f"peer {reference!r} can't be loaded: {error}; write module:callable") from error
    return make()
