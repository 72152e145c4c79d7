"""Random faults over every driver that has a mock: silence, garbage, half an answer, a late one, a wrong echo, a
stalled endpoint, the link cut.

Each case connects a driver, opens its shutter where it has one, breaks one answer of one call, and asks: the error is
one line that names the instrument, no call takes longer than twice its time-out, the next call works, and the shutter
is read back closed at the end. `make faults` takes FAULTS cases, by default 100; FAULTS_SEED draws others. A case that
fails prints the line that repeats it alone: FAULTS_ONLY=DRIVER:SEED.

Drivers and peers share the computer with whatever else it does. A case that isn't met while its threads, and its
processes', waited for a CPU through most of it says nothing of the driver: it is run again, `ATTEMPTS` times in all,
and what it says then counts."""

from __future__ import annotations

import os
import random
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.contract.families import CONTRACTS, NotMet
from drivers.contract.peer import Peer, peers
from drivers.errors import InstrumentError
from drivers.registry import driver as driver_of
from drivers.registry import drivers
from mocks.bench import Bench
from mocks.peers import DisplayPeer, LinePeer, TetheredPeer, UsbPeer
from mocks.u3v import FAULTS as CAMERA_FAULTS
from mocks.u3v import U3vDevice
from mocks.wire import Fault, Grammar, Reply

CASES = int(os.environ.get("FAULTS", "100"))
SEED = int(os.environ.get("FAULTS_SEED", "1"))
ONLY = os.environ.get("FAULTS_ONLY", "")
#: What the machine may take beside the instrument's time (s): two cores carry the mocks, too.
OWN_S = 0.3
#: A case that waited for a CPU during this share of its time, as the system counts it, may be run so often in all.
STARVED, ATTEMPTS = 0.5, 4
#: Another name of the same driver.
AGAIN = {("spectroradiometer", "usb2000plus")}
#: Time-outs (s) of the peers that are shorter than the contract's: a silent motor is waited for once in each case.
SHORTER = {"move_timeout_s": 3.0, "place_timeout_s": 2.0}
#: Time-outs (s) that a driver takes no setting for.
STATED = {"spectroradiometer.ocean_optics": 3.0, "stage.prompt": 1.0}
#: Exposure (s) of the cameras' calls.
EXPOSURE_S = 0.005
pytestmark = [pytest.mark.slow, pytest.mark.timeout(20 * CASES + 600)]

Call = tuple[str, Callable[[Any], object]]
#: The calls of each family that speak to the instrument.
CALLS: dict[str, tuple[Call, ...]] = {
    "monochromator": (
        ("wavelength_nm", lambda one: one.wavelength_nm()),
        ("move_nm", lambda one: one.move_nm(450.0 if one.wavelength_nm() > 550.0 else 650.0)),
        ("open_shutter", lambda one: one.open_shutter()),
        ("close_shutter", lambda one: one.close_shutter()),
        ("shutter_is_open", lambda one: one.shutter_is_open()),
        ("select_filter", lambda one: one.select_filter(2)),
        ("slit_um", lambda one: one.slit_um()),
        ("set_slit_um", lambda one: one.set_slit_um(500.0)),
        ("bandwidth_nm", lambda one: one.bandwidth_nm()),
    ),
    "spectroradiometer": (("measure", lambda one: one.measure()),),
    "camera": (
        ("configure", lambda one: one.configure(CONTRACTS["camera"]._within(one, EXPOSURE_S))),  # type: ignore[attr-defined]
        ("capture", lambda one: one.capture()),
        ("sensor", lambda one: one.sensor()),
    ),
    "stage": (("place", lambda one: one.place((one.targets() or ("cap",))[0])), ("placed", lambda one: one.placed())),
    "display": (("show", lambda one: one.show(np.ones((2, 2), np.uint8), 4)),),
    "photodiode": (("measure_dark", lambda one: one.measure_dark()), ("measure", lambda one: one.measure(550.0))),
    "light_source": (("level", lambda one: one.level()), ("set_level", lambda one: one.set_level(0.5))),
}
#: The calls that every family has.
EVERY: tuple[Call, ...] = (
    ("identity", lambda one: one.identity()),
    ("settings", lambda one: one.settings()),
    ("stop", lambda one: one.stop()),
    ("close", lambda one: one.close()),
)
#: Calls that take the instrument long, and the settings that state how long.
LONG = {
    "move_nm": ("move_timeout_s",),
    "select_filter": ("move_timeout_s",),
    "set_slit_um": ("move_timeout_s",),
    "place": ("place_timeout_s",),
    "measure": ("measure_timeout_s", "fetch_timeout_s"),
}
#: Drivers whose shutter is a motion: a blank in the filter wheel, or a wavelength that lets nothing through.
SHUT_BY_MOTION = {"monochromator.sp2150", "monochromator.cm110"}
MOVES_ITS_SHUTTER = ("open_shutter", "close_shutter", "stop", "close")


# --- breaking an answer -----------------------------------------------------------------------------------------------


class _WrongEcho(Grammar):
    """A grammar of which one character comes back as another: the `at`-th that is echoed."""

    def __init__(self, whole: Grammar, at: int) -> None:
        self.whole, self._left = whole, at

    def __getattr__(self, name: str) -> Any:
        return getattr(self.whole, name)

    def receive(self, data: bytes) -> list[bytes]:
        return [piece if isinstance(piece, Reply) else self._broken(piece) for piece in self.whole.receive(data)]

    def _broken(self, echo: bytes) -> bytes:
        at, self._left = self._left, self._left - len(echo)
        return echo[: at - 1] + b"#" + echo[at:] if 1 <= at <= len(echo) else echo


@dataclass
class Broken:
    """A fault as it was set: what it is, in words, and how it is over."""

    kind: str
    mend: Callable[[], None]


def _timed(peer: Peer, kind: str, after_s: float) -> Broken:
    """Silence the peer, or cut the link, some time from now."""
    begin, end = (lambda: peer.mute(True), lambda: peer.mute(False)) if kind == "silence" else (peer.unplug, peer.plug)
    begun = threading.Event()
    lock = threading.Lock()

    def strike() -> None:
        with lock:
            if not over.is_set():
                begun.set()
                begin()

    def mend() -> None:
        over.set()
        with lock:
            timer.cancel()
            if begun.is_set():
                end()

    over = threading.Event()
    timer = threading.Timer(after_s, strike)
    timer.daemon = True
    if after_s > 0:
        timer.start()
    else:
        strike()
    return Broken(f"{kind} after {after_s:.2f} s", mend)


def _line_fault(peer: LinePeer, rng: random.Random, timeout_s: float) -> Broken:
    kinds = ["never", "wrong", "half", "late", "error", "drop", "unplug"]
    echoes = "cornerstone260" in type(peer.line.grammar).__name__.lower()
    kind = rng.choice([*kinds, "echo"] if echoes else kinds)
    at = rng.choice((1, 1, 1, 2, 2, 3, 4, 6))
    if kind == "echo":
        whole, at = peer.line.grammar, rng.randint(1, 12)
        peer.line.grammar = _WrongEcho(whole, at)
        return Broken(f"echo of character {at}", lambda: setattr(peer.line, "grammar", whole))
    value = {"late": rng.uniform(0.3, 2.5) * timeout_s, "unplug": rng.uniform(0.05, 1.0)}.get(kind)
    onwards = kind in ("never", "wrong") and rng.random() < 0.3
    peer.line.fail((Fault(kind, at, onwards, value),))
    told = f"{kind}{'' if value is None else f'={value:.2f}'}@{at}{'+' if onwards else ''}"

    def mend() -> None:
        peer.line.fail(())
        if kind == "unplug":
            time.sleep(1.1)  # it is plugged in again by itself

    return Broken(told, mend)


def _usb_fault(peer: UsbPeer, rng: random.Random, timeout_s: float) -> Broken:
    device = peer.device
    if isinstance(device, U3vDevice):
        kind, times = rng.choice([*CAMERA_FAULTS]), rng.choice((1, 1, 2, 5))
        device.inject(kind, times)

        def let_be() -> None:
            with device.changed:
                device._faults.clear()
            if kind == "unplug":
                device.plug()

        return Broken(f"{kind} x {times}", let_be)
    kind = rng.choice(("never", "wrong", "half", "late", "error", "unplug"))
    at, value = rng.choice((1, 1, 1, 2, 2, 3, 4)), rng.uniform(0.3, 2.5) * timeout_s if kind == "late" else None
    onwards = kind in ("never", "wrong", "error") and rng.random() < 0.3
    device.fail((Fault(kind, at, onwards, 60.0 if kind == "unplug" else value),))

    def mend() -> None:
        device.fail(())
        time.sleep(value or 0.0)  # it hears nothing meanwhile
        if kind == "unplug":
            device.plug()

    return Broken(f"{kind}{'' if value is None else f'={value:.2f}'}@{at}{'+' if onwards else ''}", mend)


def _picture_fault(peer: TetheredPeer, rng: random.Random, timeout_s: float) -> Broken:
    kind = rng.choice(("late", "never", "half", "wrong", "unplug"))
    value = rng.uniform(0.3, 1.5) * timeout_s
    peer.camera.fail((Fault(kind, 1, value=value),))

    def mend() -> None:
        time.sleep(value if kind in ("late", "unplug") else 0.0)  # what was asked for comes, the folder is back
        peer.camera.fail(())

    return Broken(kind if kind not in ("late", "unplug") else f"{kind}={value:.2f}", mend)


def _page_fault(peer: DisplayPeer, rng: random.Random, timeout_s: float) -> Broken:
    kind, page = rng.choice(("wrong", "half", "late")), peer.page
    whole, late_s = page.receive, rng.uniform(0.3, 2.0) * timeout_s

    def receive(message: str | bytes) -> list[str]:
        answers = whole(message)
        if kind == "late" and answers:
            time.sleep(late_s)
        return [{"wrong": '{"type": "error"}', "half": one[: len(one) // 2]}.get(kind, one) for one in answers]

    page.receive = receive  # type: ignore[method-assign]
    return Broken(kind, lambda: delattr(page, "receive"))


def break_something(peer: Peer, rng: random.Random, timeout_s: float) -> Broken:
    """Set a random fault of those that the peer knows; silence and a cut link at a random moment are known to all."""
    of_its_own: dict[type[Peer], Callable[[Any, random.Random, float], Broken]] = {
        LinePeer: _line_fault,
        UsbPeer: _usb_fault,
        TetheredPeer: _picture_fault,
        DisplayPeer: _page_fault,
    }
    own = of_its_own.get(type(peer))
    if own is not None and rng.random() < 0.75:
        return own(peer, rng, timeout_s)
    return _timed(peer, rng.choice(("silence", "cut")), rng.choice((0.0, 0.0, rng.uniform(0.0, 0.3))))


# --- waiting for a CPU ------------------------------------------------------------------------------------------------


def _waits_s() -> dict[str, float]:
    """Return how long (s) each thread of this process and of its children has been ready to run and wasn't run, by its
    place in /proc; nothing where the system doesn't tell."""
    parents: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError, ValueError):  # it ended meanwhile
            parents.setdefault(int(stat.read_text().rpartition(")")[2].split()[1]), []).append(int(stat.parent.name))
    family, waits = [os.getpid()], {}
    for pid in family:
        family += parents.get(pid, [])
        for told in Path(f"/proc/{pid}/task").glob("*/schedstat"):
            with suppress(OSError, ValueError):
                waits[str(told)] = 1e-9 * int(told.read_text().split()[1])
    return waits


# --- one case ---------------------------------------------------------------------------------------------------------


@dataclass
class Seen:
    """What became of the cases."""

    cases: Counter[str] = field(default_factory=Counter)
    outcomes: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    longest: dict[str, float] = field(default_factory=dict)  # the longest call by driver, in time-outs
    starved: int = 0  # cases that were run again


class Subject:
    """A driver, its peer, and the case under way."""

    def __init__(self, family: str, name: str, peer: Peer) -> None:
        self.family, self.driver_name, self.peer = family, f"{family}.{name}", peer
        settings = dict(peer.settings)
        settings |= {key: seconds for key, seconds in SHORTER.items() if key in settings}
        self._make, self.settings = driver_of(family, name), settings
        self.timeout_s = float(settings.get("timeout_s", STATED.get(self.driver_name, 2.0)))

    def made(self) -> Any:
        return self._make(self.peer.address, **self.settings)

    def stated_s(self, call: str, connecting: bool = False) -> float:
        """How long a call may take, as the station file states it: its own time-outs, or the one for an answer."""
        by_motion = self.driver_name in SHUT_BY_MOTION and call in MOVES_ITS_SHUTTER
        own = [float(self.settings.get(key) or 0.0) for key in LONG.get("move_nm" if by_motion else call, ())]
        exposure_s = 3 * EXPOSURE_S if self.family == "camera" else 0.0
        connect_s = (
            float(self.settings.get("connect_timeout_s", 0.0)) if connecting or self.family == "display" else 0.0
        )
        return max(self.timeout_s, sum(own)) + exposure_s + connect_s

    def names_it(self, message: str, model: str) -> bool:
        """Whether a message says which instrument it is about."""
        family = self.family.replace("_", " ")
        own = (
            family,
            self.peer.address,
            model,
            self.driver_name.partition(".")[2],
            "lamp",
            "spectrometer",
            "target stage",
        )
        return any(word and word.lower() in message.lower() for word in own)

    def light_is_shut(self) -> bool:
        """By the mock itself, which knows."""
        light = getattr(self.peer, "_light", None) or getattr(self.peer, "_bench", None)
        light = light or getattr(getattr(self.peer, "device", None), "_light", None)
        return not (isinstance(light, Bench) and light.light.shutter_open)

    def run(self, seed: int, seen: Seen) -> None:
        """One case, again where it was starved. What is wrong with it is added to `seen`."""
        for attempt in range(1, ATTEMPTS + 1):
            before, began_s, known = _waits_s(), time.monotonic(), len(seen.wrong)
            self._run(seed, seen)
            if len(seen.wrong) == known:
                return
            took_s = time.monotonic() - began_s
            waited_s = sum(max(0.0, now - before.get(thread, 0.0)) for thread, now in _waits_s().items())
            seen.wrong[known:] = [
                f"{line}; the case waited {waited_s:.1f} s of {took_s:.1f} s for a CPU" for line in seen.wrong[known:]
            ]
            if waited_s < STARVED * took_s or attempt == ATTEMPTS:
                return
            seen.starved += 1
            del seen.wrong[known:]

    def _run(self, seed: int, seen: Seen) -> None:
        rng = random.Random(seed)
        label, call = rng.choice(CALLS[self.family] * 2 + EVERY)
        driver = self.made()
        seen.cases[self.driver_name] += 1
        try:
            driver.connect()
        except InstrumentError as error:
            seen.wrong.append(
                f"{self.driver_name}: can't connect before the fault: {error} ({self.driver_name}:{seed})"
            )
            driver.close()
            return
        if self.family == "camera":
            CALLS["camera"][0][1](driver)
        model = driver.identity().model
        opened = self.family == "monochromator" and rng.random() < 0.7
        if opened:
            driver.move_nm(550.0)  # a CM110 has no shutter and opens at the wavelength that it was told
            driver.open_shutter()
        broken = break_something(self.peer, rng, self.timeout_s)
        what = f"{self.driver_name} {label} with {broken.kind}"

        def complain(why: str) -> None:
            seen.wrong.append(f"{what}: {why} (FAULTS_ONLY={self.driver_name}:{seed})")

        def timed(of: str, work: Callable[[], object], connecting: bool = False) -> InstrumentError | None:
            """Do it; what it raised, if that is an instrument's error."""
            began_s = time.monotonic()
            try:
                work()
            except InstrumentError as error:
                if "\n" in str(error) or not self.names_it(str(error), model):
                    complain(f"{of} says {str(error)!r}, which isn't one line that names the instrument")
                return error
            except NotMet as error:
                complain(f"{of}: {error}")
            except Exception as error:
                complain(f"{of} raised {type(error).__name__}: {error}")
            finally:
                took_s, stated_s = time.monotonic() - began_s, self.stated_s(of, connecting)
                share = took_s / stated_s
                seen.longest[self.driver_name] = max(seen.longest.get(self.driver_name, 0.0), share)
                if took_s > 2 * stated_s + OWN_S:
                    complain(f"{of} took {took_s:.1f} s, its time-out is {stated_s:g} s")
            return None

        failed = timed(label, lambda: call(driver))
        seen.outcomes["the call failed" if failed is not None else "the call got over it"] += 1
        broken.mend()
        if label != "close":
            again = timed("everyday", lambda: CONTRACTS[self.family].everyday(driver), connecting=True)
            if again is not None and failed is None:  # the call before said nothing, or nothing any more: it was this
                seen.outcomes["noticed by the next call"] += 1
                again = timed("everyday", lambda: CONTRACTS[self.family].everyday(driver), connecting=True)
            if again is not None:
                complain(f"the next call doesn't recover: {again}; it was {failed}")
        if (unclosed := timed("close", driver.close)) is not None and label != "close":
            complain(f"close afterwards: {unclosed}")
        if self.family == "monochromator":
            self.check_shutter(failed if label == "close" else unclosed, complain, seen)

    def check_shutter(self, of_close: InstrumentError | None, complain: Callable[[str], None], seen: Seen) -> None:
        """Read the shutter back: by the mock itself after a close that said nothing, and by a new driver."""
        if of_close is None and not self.light_is_shut():
            complain("the shutter is open after close")
        again = self.made()
        try:
            again.connect()
            if of_close is not None:  # it said that light may get out: the next user stops it first, as a session does
                again.stop()
            if again.shutter_is_open():
                complain("a new driver reads the shutter open")
            else:
                seen.outcomes["shutter read back closed"] += 1
        except InstrumentError as error:
            complain(f"a new driver can't read the shutter back: {error}")
        finally:
            again.close()


def _subjects() -> list[tuple[str, str]]:
    wanted = ONLY.partition(":")[0]
    every = [one for one in drivers() if one not in AGAIN]
    return [one for one in every if not wanted or ".".join(one) == wanted]


def test_each_fault_is_told_and_over(capsys: pytest.CaptureFixture[str]) -> None:
    seen, left_out = Seen(), []
    rng = random.Random(SEED)
    subjects = _subjects()
    share = -(-CASES // len(subjects))
    for family, name in subjects:
        seeds = [rng.randrange(10**9) for _ in range(share)]
        if ":" in ONLY:
            seeds = [int(ONLY.partition(":")[2])]
        point = peers().get(f"{family}.{name}")
        try:
            assert point is not None, f"{family}.{name} has no peer"
            peer = point.load()()
        except InstrumentError as error:  # a library or a program that isn't installed here
            left_out.append(f"{family}.{name} ({error})")
            continue
        with peer:
            if not peer.can_fail:
                left_out.append(f"{family}.{name} (its camera can't be made to fail)")
                continue
            subject = Subject(family, name, peer)
            for seed in seeds:
                before, began_s = len(seen.wrong), time.monotonic()
                subject.run(seed, seen)
                with capsys.disabled():
                    for line in seen.wrong[before:]:
                        print(f"\n  {line}", end="")
                    if time.monotonic() - began_s > 30.0:
                        print(f"\n  {family}.{name}:{seed} took {time.monotonic() - began_s:.0f} s", end="")
    with capsys.disabled():
        longest = ", ".join(f"{name} {times:.1f}" for name, times in sorted(seen.longest.items()))
        print(
            f"\nfaults: {sum(seen.cases.values())} over {len(seen.cases)} drivers, {len(seen.wrong)} wrong; "
            f"{dict(seen.outcomes)}; longest call in time-outs: {longest}; "
            f"{seen.starved} runs starved and taken again; seed {SEED}, load of the machine {os.getloadavg()[0]:.1f}"
        )
        for line in left_out:
            print(f"  left out: {line}")
    assert seen.cases
    assert seen.wrong == []
