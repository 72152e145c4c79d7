"""The light source abstraction: a lamp that can be dimmed, of one or several channels (LEDs of several colours)."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from abc import abstractmethod
from collections.abc import Iterator

from drivers.errors import Disconnected, InstrumentError, Interrupted, NoAnswer
from drivers.found_settings import FoundSettings, Hold
from drivers.instrument import Identity, Instrument, Recorder

_LOOK_S = 0.05


class LightSource(Instrument):
    """A lamp. `stop` leaves it dark, `close` as bright as it was found: where another lit it, it shines on."""

    @abstractmethod
    def channels(self) -> tuple[str, ...]:
        """Return the names of what can be dimmed apart; one at least."""

    @abstractmethod
    def set_level(self, level: float, channel: str | None = None) -> None:
        """Light a channel (None: the first) at a share 0..1 of its most, and return once it is steady.

        Raises `InstrumentError` outside 0..1 or for a channel that it hasn't got.
        """

    @abstractmethod
    def level(self, channel: str | None = None) -> float:
        """Return the share 0..1 at which a channel is lit; 0 where it is off."""


class SteppedLamp(LightSource):
    """A lamp of one channel with whole steps of brightness, set and read back by its protocol.

    `timeout_s`: longest time for an answer; `settle_s`: longest time until it is steady.
    """

    def __init__(
        self, address: str, *, timeout_s: float = 5.0, settle_s: float = 60.0, recorder: Recorder | None = None
    ) -> None:
        self.address, self._timeout_s, self._settle_s = address, timeout_s, settle_s
        self._record: Recorder = recorder or (lambda direction, data: None)
        self._who = f"light source {address}"
        self._lock = threading.RLock()
        self._stopped = threading.Event()
        self._hold = Hold()
        self._found: FoundSettings | None = None
        self._identity = Identity("", "")
        self._steps = 0.0
        self._until = 0.0
        self._calls = 0

    # --- what reaches the lamp ----------------------------------------------------------------------------------------

    @abstractmethod
    def _open(self) -> tuple[Identity, float]:
        """Find it; returns who it is, and its highest step."""

    @abstractmethod
    def _read(self) -> float:
        """Return the step at which it is lit; 0 where it is off."""

    @abstractmethod
    def _light(self, step: float) -> None:
        """Light it at a step above 0."""

    @abstractmethod
    def _darken(self) -> None:
        """Switch it off."""

    @abstractmethod
    def _is_steady(self) -> bool:
        """Return whether its light doesn't change any more."""

    @abstractmethod
    def _release(self) -> None:
        """Let it go; may raise whatever it likes."""

    # --- the abstraction ----------------------------------------------------------------------------------------------

    def connect(self) -> None:
        with self._lock, self._timed():
            self._drop()
            try:
                self._identity, self._steps = self._open()
                name = f"light_source-{self._identity.serial_number or self.address}"
                self._hold.take(name, self._who)
                self._found = FoundSettings(name, self._who)
                self._restore(self._found)  # what a process that was killed, or an unplugged lamp, left changed
            except InstrumentError:
                self._drop()
                self._hold.let_go()
                raise

    def identity(self) -> Identity:
        with self._used():
            return self._identity

    def channels(self) -> tuple[str, ...]:
        return ("light",)

    def level(self, channel: str | None = None) -> float:
        self._check_channel(channel)
        with self._used():
            return self._read() / self._steps

    def set_level(self, level: float, channel: str | None = None) -> None:
        self._check_channel(channel)
        if not (math.isfinite(level) and 0.0 <= level <= 1.0):
            raise InstrumentError(f"{self._who}: a level of {level} is outside 0..1; ask for a share of its brightest")
        with self._used() as kept:
            kept.note("step", self._read())
            self._go(round(level * self._steps))

    def _check_channel(self, channel: str | None) -> None:
        if channel is not None and channel not in self.channels():
            raise InstrumentError(f"{self._who}: no channel {channel!r}; it has {', '.join(self.channels())}")

    def _go(self, step: float) -> None:
        """Light it at a step, wait until it is steady, and read it back."""
        self._light(step) if step > 0 else self._darken()
        until = time.monotonic() + self._settle_s
        while not self._is_steady():
            if time.monotonic() > until:
                raise NoAnswer(f"{self._who}: not steady within {self._settle_s:g} s; look at it, or state settle_s")
            if self._stopped.wait(_LOOK_S):
                raise Interrupted(f"{self._who}: stopped while it settles; start again")
            self._until = time.monotonic() + self._timeout_s
        if (reading := self._read()) != step:
            raise InstrumentError(f"{self._who}: it was set to step {step:g} and reads {reading:g}; check the lamp")

    def _restore(self, kept: FoundSettings) -> None:
        if "step" in kept:
            self._go(float(kept.get("step", 0.0)))
            kept.forget("step")

    def stop(self) -> None:
        """Darken it at once."""
        self._stopped.set()
        with self._lock, self._timed():
            self._stopped.clear()
            if self._found is None:
                return
            with self._dropping():
                self._found.note("step", self._read())
                self._go(0)

    def close(self) -> None:
        self._stopped.set()
        with self._lock, self._timed():
            self._stopped.clear()
            try:
                if self._found is not None:
                    self._restore(self._found)
            except InstrumentError as error:
                raise InstrumentError(f"{error}; it may be lit still: switch it off by hand") from error
            finally:
                self._drop()
                self._hold.let_go()

    # --- inside -------------------------------------------------------------------------------------------------------

    def _left_s(self) -> float:
        """Return how long (s) an answer may take: the time-out, and what is left of the call under way; 0.01 at
        least."""
        return max(0.01, min(self._timeout_s, self._until - time.monotonic()))

    @contextlib.contextmanager
    def _timed(self) -> Iterator[None]:
        """Let a call that asks many things end within twice the time-out; a call within a call has that one's end."""
        if self._calls == 0:
            self._until = time.monotonic() + 2 * self._timeout_s
        self._calls += 1
        try:
            yield
        finally:
            self._calls -= 1

    @contextlib.contextmanager
    def _used(self) -> Iterator[FoundSettings]:
        """The lamp, connected anew after a failure."""
        with self._lock, self._timed():
            if self._found is None:
                self.connect()
            assert self._found is not None
            with self._dropping():
                yield self._found

    @contextlib.contextmanager
    def _dropping(self) -> Iterator[None]:
        """Connect anew after a failure of what reaches it."""
        try:
            yield
        except (Disconnected, NoAnswer):
            self._drop()
            raise

    def _drop(self) -> None:
        self._found = None
        with contextlib.suppress(Exception):  # it may be gone
            self._release()
