"""What all instruments have in common: their identity, and the transcript of their conversations."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, Self

#: Called with every piece of a conversation as it happens: the transcript of a session is made of these.
Recorder = Callable[[Literal["sent", "received"], bytes], None]


#: A setting's value as an instrument reports it.
Setting = str | bool | int | float


@dataclass(frozen=True)
class Identity:
    """An instrument's identity as it reports it; an empty string where it doesn't."""

    maker: str
    model: str
    serial_number: str = ""
    firmware: str = ""


class Instrument(ABC):
    """A connected instrument.

    Creating one sends nothing. `connect` does, and every later call reconnects after a failure. Every call ends within
    its time-out, by `drivers.errors.InstrumentError` if necessary.
    """

    @abstractmethod
    def connect(self) -> None:
        """Open the connection, check the instrument's identity, and bring it into a known state."""

    @abstractmethod
    def identity(self) -> Identity:
        """Return maker, model, serial number and firmware as the instrument reports them."""

    def settings(self) -> Mapping[str, Setting]:
        """Return every setting that bears on what is measured, by its name, as the instrument reports it now."""
        return {}

    def found(self) -> Mapping[str, Setting]:
        """Return what a setting was before this driver changed it, by its name, while that isn't restored."""
        return {}

    def departures(self) -> tuple[str, ...]:
        """Return what of it can't be set as a measurement wants it, in words: it belongs to all that is recorded
        with it."""
        return ()

    @abstractmethod
    def stop(self) -> None:
        """Bring the instrument into its safe state now, from any thread: motion ends, shutters close, screens go
        dark."""

    @abstractmethod
    def close(self) -> None:
        """Bring it into its safe state and close the connection, in any case; may be called twice.

        Raises `InstrumentError` where light may get out still: a shutter that says it is open, or that was opened and
        doesn't answer."""

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close()
        except Exception as unsafe:
            if error is None:
                raise
            error.add_note(str(unsafe))
