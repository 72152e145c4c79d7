"""What all instruments have in common: who they are, and how their wire is written down."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, Self

#: Called with every piece of a conversation as it happens: the transcript of a session is made of these.
Recorder = Callable[[Literal["sent", "received"], bytes], None]


@dataclass(frozen=True)
class Identity:
    """Who an instrument says it is; what it doesn't say is an empty string."""

    maker: str
    model: str
    serial_number: str = ""
    firmware: str = ""


class Instrument(ABC):
    """A connected instrument.

    Building one touches no wire; `connect` does, and every later call reconnects by itself after a failure. Every call
    ends within its time-out, with `drivers.errors.InstrumentError` if it must.
    """

    @abstractmethod
    def connect(self) -> None:
        """Open the line, check that the right instrument answers, and bring it into a known state."""

    @abstractmethod
    def identity(self) -> Identity:
        """Maker, model, serial number and firmware as the instrument reports them."""

    @abstractmethod
    def stop(self) -> None:
        """Bring the instrument into its safe state now, from any thread: motion ends, shutters close, screens go dark."""

    @abstractmethod
    def close(self) -> None:
        """Bring it into its safe state and let go of the line. Never raises; closing twice is fine."""

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
