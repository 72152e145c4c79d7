"""A stage at the end of a TCP line: an operator's terminal, a carousel, or the mock bench.

    PLACE edge-1   -> OK edge-1
    PLACED?        -> edge-1
    LIST?          -> cap,sphere,...
    anything else  -> ERROR and why

Requests end LF, answers CR LF.
"""

from __future__ import annotations

from drivers.errors import Garbled, InstrumentError, Refused
from drivers.instrument import Identity, Recorder
from drivers.stage.base import Stage
from drivers.transport import Transport, WireInstrument, shown


class OperatorStage(WireInstrument, Stage):
    """The operator at `address` (`socket://host:port`); `place_timeout_s`: longest time to place a target."""

    def __init__(
        self, address: str, *, timeout_s: float = 5.0, place_timeout_s: float = 600.0, recorder: Recorder | None = None
    ) -> None:
        super().__init__(Transport(address, "target stage", timeout_s=timeout_s, recorder=recorder))
        self.place_timeout_s = place_timeout_s

    def identity(self) -> Identity:
        self.connect()
        return Identity("", "operator")

    def place(self, target: str) -> None:
        if not target or not target.isprintable() or target.strip() != target:
            raise InstrumentError(f"{self._transport.name}: {target!r} is no name of a target; give one of its list")
        with self._conversation():
            answer = self._ask(f"PLACE {target}", self.place_timeout_s)
            if answer != f"OK {target}":
                raise Garbled(
                    f"{self._transport.name}: answered 'PLACE {target}' with {shown(answer.encode())}; check what "
                    "stands there"
                )

    def placed(self) -> str:
        with self._conversation():
            return self._ask("PLACED?")

    def targets(self) -> tuple[str, ...]:
        with self._conversation():
            return tuple(name for name in self._ask("LIST?").split(",") if name)

    def stop(self) -> None:
        """End the wait for a target that another thread is in."""
        self._transport.interrupt()
        with self._lock:
            self._transport.resume()

    def _establish(self) -> None:
        answer = self._ask("PLACED?")
        if "PLACED?" in answer:  # an echo, or a complaint about it
            raise Garbled(
                f"{self._transport.name}: answered 'PLACED?' with {shown(answer.encode())}; check that a stage is at "
                "this address"
            )
        self._transport.drain()  # what was asked before the connection was opened anew may be answered now, too

    def _make_safe(self) -> None:
        """It emits nothing and moves nothing by itself."""

    def _ask(self, request: str, timeout_s: float | None = None) -> str:
        self._transport.write(request.encode("utf-8") + b"\n")
        answer = self._transport.read_until(b"\n", timeout_s, request).decode("utf-8", "replace").strip()
        if answer.startswith("ERROR"):
            reason = answer.removeprefix("ERROR").strip() or "no reason given"
            raise Refused(f"{self._transport.name}: refused {request!r}: {reason}", 1)
        return answer
