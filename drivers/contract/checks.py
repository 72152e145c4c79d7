"""One contract for every driver: identify, limits, safe state, time-out, unplug, replug, stop in mid-motion, two at
once.

`check_driver` runs it over a driver and the peer at its other end. It is what `calibench devices contract` runs, and
what the project's own tests run over every driver that has an entry point.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

from drivers.contract.families import CONTRACTS, NotMet, require
from drivers.contract.peer import Peer
from drivers.errors import InstrumentError
from drivers.instrument import Instrument
from drivers.registry import driver as driver_of

#: Longest time (s) for a call to end, well or badly, and for an instrument to work again once its trouble is over.
LIMIT_S = 30.0
#: How long (s) a long call is given to be under way before it is stopped.
_UNDER_WAY_S = 0.5


@dataclass(frozen=True)
class Outcome:
    """One check: what it asks, how it ended, and in words why if it didn't hold or wasn't run."""

    asks: str
    ended: Literal["met", "not met", "left out"]
    why: str = ""


class _LeftOut(Exception):
    """The peer can't do what a check needs."""


class _Subject:
    """A driver under check, and its peer."""

    def __init__(self, family: str, name: str, peer: Peer) -> None:
        self.contract = CONTRACTS[family]
        self.peer = peer
        self._make = driver_of(family, name)

    def make(self, address: str | None = None) -> Any:
        made = self._make(self.peer.address if address is None else address, **self.peer.settings)
        if not isinstance(made, self.contract.kind):
            raise NotMet(f"it is a {type(made).__name__}, not a {self.contract.kind.__name__}")
        return made

    def needs_mock(self) -> None:
        if not self.peer.can_fail:
            raise _LeftOut("no program can silence or unplug this instrument")


def check_driver(family: str, name: str, peer: Peer) -> Iterator[Outcome]:
    """Run the contract of a family over one driver, check by check. Raises `InstrumentError` for an unknown family or
    driver."""
    if family not in CONTRACTS:
        raise InstrumentError(f"{family}: no such family; there are {', '.join(CONTRACTS)}")
    subject = _Subject(family, name, peer)
    for asks, check in _CHECKS.items():
        try:
            _run_bounded(lambda check=check: check(subject), 4 * LIMIT_S)  # type: ignore[misc]
        except _LeftOut as reason:
            yield Outcome(asks, "left out", str(reason))
        except NotMet as found:
            yield Outcome(asks, "not met", str(found))
        except Exception as error:
            yield Outcome(asks, "not met", f"{type(error).__name__}: {' '.join(str(error).split())}")
        else:
            yield Outcome(asks, "met")


def _identify(subject: _Subject) -> None:
    driver = subject.make()
    driver.close()  # touches nothing, raises nothing
    with driver:
        identity = driver.identity()
        require(bool(identity.maker or identity.model), f"its identity is empty: {identity}")
        require(driver.identity() == identity, "its identity changes")
    driver.close()
    with subject.make() as again:
        require(again.identity() == identity, "another driver object finds another identity")


def _limits(subject: _Subject) -> None:
    with subject.make() as driver:
        subject.contract.settings(driver)


def _safe_state(subject: _Subject) -> None:
    with subject.make() as driver:
        subject.contract.everyday(driver)
        driver.stop()
        subject.contract.require_safe(driver)
        driver.stop()
        subject.contract.everyday(driver)
    with subject.make() as driver:
        subject.contract.require_safe(driver)


def _time_out(subject: _Subject) -> None:
    subject.needs_mock()
    driver = subject.make()
    driver.connect()
    subject.peer.mute(True)
    try:
        _fails_in_one_line(lambda: subject.contract.everyday(driver), "a silent instrument")
    finally:
        subject.peer.mute(False)
    _works_again(lambda: subject.contract.everyday(driver), "it answered again")
    driver.close()


def _unplug(subject: _Subject) -> None:
    subject.needs_mock()
    driver = subject.make()
    driver.connect()
    subject.contract.everyday(driver)
    subject.peer.unplug()
    try:
        for _ in range(2):
            _fails_in_one_line(lambda: subject.contract.everyday(driver), "an unplugged instrument")
        second = subject.make()
        _fails_in_one_line(lambda: subject.contract.everyday(second), "a new driver of an unplugged instrument")
        second.close()
    finally:
        subject.peer.plug()
    _works_again(lambda: subject.contract.everyday(driver), "it was plugged in again")
    driver.close()


def _stop(subject: _Subject) -> None:
    subject.needs_mock()
    with subject.make() as driver:
        subject.contract.everyday(driver)
        if not subject.peer.slow(True):
            raise _LeftOut("nothing takes long with this peer")
        try:
            _stop_in_the_middle(subject, driver)
        finally:
            subject.peer.slow(False)
        _works_again(lambda: subject.contract.require_safe(driver), "it was stopped")
        subject.contract.everyday(driver)


def _stop_in_the_middle(subject: _Subject, driver: Instrument) -> None:
    ended: list[Exception | None] = []

    def act() -> None:
        try:
            subject.contract.takes_long(driver)
        except InstrumentError as error:
            ended.append(error)
        else:
            ended.append(None)

    worker = threading.Thread(target=act, daemon=True)
    worker.start()
    worker.join(_UNDER_WAY_S)
    require(worker.is_alive(), f"the long call ended within {_UNDER_WAY_S} s: the peer isn't slow")
    began = time.monotonic()
    _run_bounded(driver.stop, LIMIT_S)
    worker.join(LIMIT_S)
    require(not worker.is_alive(), "the call under way didn't end")
    require(
        ended[0] is not None, f"the call under way came to its end, {time.monotonic() - began:.1f} s after the stop"
    )
    require("\n" not in str(ended[0]), "the message has several lines")


def _two_at_once(subject: _Subject) -> None:
    with subject.make() as driver:
        failures: list[Exception] = []

        def act() -> None:
            try:
                for _ in range(3):
                    subject.contract.everyday(driver)
            except Exception as error:
                failures.append(error)

        threads = [threading.Thread(target=act, daemon=True) for _ in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(2 * LIMIT_S)
        require(not any(thread.is_alive() for thread in threads), "two threads wait for one another")
        require(not failures, f"two threads on one driver: {failures[0] if failures else ''}")
        second = subject.make()
        try:
            second.connect()
        except InstrumentError as error:
            require("\n" not in str(error), "the refusal of a second driver has several lines")
        second.close()
        _works_again(lambda: subject.contract.everyday(driver), "a second driver came and went")


_CHECKS: dict[str, Callable[[_Subject], None]] = {
    "says who it is, and is let go": _identify,
    "does what is within its limits and refuses what is beyond": _limits,
    "is safe after stop and close, and works on": _safe_state,
    "gives up on a silent instrument in time, and works again": _time_out,
    "tells that it is unplugged, and works once it is plugged in": _unplug,
    "stops in the middle of what takes long": _stop,
    "serves two threads, and survives a second driver": _two_at_once,
}


def _run_bounded(call: Callable[[], object], limit_s: float) -> None:
    """Run a call in a thread of its own; raise what it raised, or `NotMet` if it doesn't end."""
    raised: list[BaseException] = []

    def run() -> None:
        try:
            call()
        except BaseException as error:
            raised.append(error)

    worker = threading.Thread(target=run, daemon=True)
    worker.start()
    worker.join(limit_s)
    require(not worker.is_alive(), f"a call didn't end within {limit_s:g} s")
    if raised:
        raise raised[0]


def _fails_in_one_line(call: Callable[[], object], what: str) -> None:
    try:
        _run_bounded(call, LIMIT_S)
    except InstrumentError as error:
        require("\n" not in str(error), f"{what}: the message has several lines")
        return
    raise NotMet(f"{what}: no error")


def _works_again(call: Callable[[], object], after: str) -> None:
    until = time.monotonic() + LIMIT_S
    while True:
        try:
            _run_bounded(call, LIMIT_S)
        except InstrumentError as error:
            require(time.monotonic() < until, f"it doesn't work {LIMIT_S:g} s after {after}: {error}")
            time.sleep(0.05)
        else:
            return
