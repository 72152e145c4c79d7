"""Halts at random moments, packing included: the shutter's own answer "closed" is told within 2 s, each time.

Real processes: `calibench serve` and `calibench bench`, started once. Two sessions take turns: one captures, the other
has only its packing left once it was halted there. The page follows the session through a wire of its own; before one
halt in five that wire is cut. Afterwards the monochromator is asked on its own line. `make halts` takes HALTS of them,
by default 20; HALTS_SEED draws others."""

from __future__ import annotations

import contextlib
import os
import random
import socket
import struct
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import pytest

from api.client import ServiceClient, ServiceProblem
from api.keys import Permission, create_key
from api.safety import StationSafety
from api.schemas import Halted, SessionStart
from lab.bench_process import mock_bench
from lab.capture.store import Store
from tests.api.conftest import served, shutter_is_open

HALTS = int(os.environ.get("HALTS", "20"))
SEED = int(os.environ.get("HALTS_SEED", "1"))
#: Wanted: the shutter is confirmed closed so long (s) after the halt was asked. And the longest wait for anything.
CONFIRMED_S, PATIENCE_S = 2.0, 60.0
#: What is under way when the halt comes, and how often that is sought.
PHASES = {"connecting": 2, "capturing": 4, "packing": 3, "paused": 1, "idle": 1}
pytestmark = [pytest.mark.slow, pytest.mark.timeout(30 * HALTS + 600)]


class Wire:
    """What joins the page to the service, and can be cut: every connection through it is reset at once."""

    def __init__(self, port: int) -> None:
        self._to = port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._ends: list[socket.socket] = []
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                page = self._listener.accept()[0]
                service = socket.create_connection(("127.0.0.1", self._to))
                self._ends += (page, service)
                for one, other in ((page, service), (service, page)):
                    threading.Thread(target=self._carry, args=(one, other), daemon=True).start()

    def _carry(self, one: socket.socket, other: socket.socket) -> None:
        with one, other, contextlib.suppress(OSError):
            while data := one.recv(1 << 16):
                other.sendall(data)
            other.shutdown(socket.SHUT_RDWR)

    def cut(self) -> None:
        """Reset every connection; those that come later are carried again."""
        ends, self._ends = self._ends, []
        for end in ends:
            with contextlib.suppress(OSError):
                end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def close(self) -> None:
        self._listener.close()
        self.cut()


@dataclass
class Seen:
    """What became of the halts: seconds until "closed" was told by phase, and what the station's state read
    afterwards."""

    closed_s: dict[str, list[float]] = field(default_factory=dict)
    afterwards: Counter[str] = field(default_factory=Counter)
    cut: int = 0
    wrong: list[str] = field(default_factory=list)

    def told(self) -> str:
        """One line with the quantiles."""
        every = sorted(one for some in self.closed_s.values() for one in some)
        at = {share: every[min(len(every) - 1, int(share * len(every)))] for share in (0.5, 0.9, 0.99)}
        worst = ", ".join(f"{phase} {len(some)} (at most {max(some):.2f} s)" for phase, some in self.closed_s.items())
        return (
            f"halts: {sum(one <= CONFIRMED_S for one in every)} of {len(every)} confirmed closed within "
            f"{CONFIRMED_S:g} s; median {at[0.5]:.2f} s, 90 % {at[0.9]:.2f} s, 99 % {at[0.99]:.2f} s, at most "
            f"{every[-1]:.2f} s; {worst}; page cut before {self.cut}; "
            f"afterwards {dict(self.afterwards)}; seed {SEED}, load of the machine {os.getloadavg()[0]:.1f}"
        )


class Desk:
    """The service as an operator has it: a key, a page that follows, and the halt."""

    def __init__(self, port: int, key: str, station: Path, rng: random.Random) -> None:
        self.key, self.station, self.rng = key, station, rng
        self.wire = Wire(port)
        self.client = ServiceClient(f"http://127.0.0.1:{port}", key)
        self.sessions: dict[str, str] = {}  # what it is for -> id

    def follow(self, session_id: str) -> None:
        """Follow a session as the page does, until it ends or the wire is cut."""

        def page() -> None:
            with (
                contextlib.suppress(httpx.HTTPError, ServiceProblem, OSError),
                ServiceClient(self.wire.url, self.key) as one,
            ):
                for _ in one.follow_session(session_id):
                    pass

        threading.Thread(target=page, daemon=True).start()

    def state(self, session_id: str) -> str:
        return str(self.client.session(session_id).state)

    def until(self, session_id: str, *states: str) -> str:
        """Wait for one of these states, or an end."""
        end = time.monotonic() + PATIENCE_S
        while (state := self.state(session_id)) not in (*states, "finished", "failed", "interrupted"):
            assert time.monotonic() < end, f"session {session_id} is {state}, not {' or '.join(states)}"
            time.sleep(0.02)
        return state

    def under_way(self, what: str) -> str:
        """Id of a session that runs from now on: a new one, or that which was halted before."""
        found = self.sessions.get(what)
        session = None if found is None else self.client.session(found)
        captured = session is not None and session.steps_done == session.steps  # packing is left
        if found is None or self.state(found) == "finished" or (captured and what == "capturing"):
            start = SessionStart(station="bench", quick=True, sequences=("dark", "flat"))
            found = self.sessions[what] = self.client.start_session(start).id
        else:
            self.client.resume(found)
        self.follow(found)
        return found

    def reach(self, phase: str) -> tuple[str, str]:
        """Bring a session into a phase, up to a random moment of it; the session's id, and the phase that it is in."""
        if phase == "idle":
            return "", phase
        session_id = self.under_way("packing" if phase == "packing" else "capturing")
        if phase == "connecting":
            time.sleep(self.rng.uniform(0.0, 0.5))
        elif phase == "packing":
            if self.until(session_id, "packing") == "packing":
                time.sleep(self.rng.uniform(0.0, 0.5))
        elif self.until(session_id, "running", "packing") == "running":
            time.sleep(self.rng.uniform(0.0, 2.5))
            if phase == "paused" and self.state(session_id) == "running":
                with contextlib.suppress(ServiceProblem):  # it has come to its packing meanwhile
                    self.client.pause(session_id)
                time.sleep(self.rng.uniform(0.0, 1.0))
        return session_id, self.state(session_id)

    def safety(self) -> StationSafety | None:
        return self.client.station("bench").safety

    def halt(self) -> tuple[float, StationSafety | None]:
        """Ask for a halt through the page's wire; seconds until the service told "closed" by the shutter's own answer,
        in the halt's answer or at the station, and what the station's state reads at the end."""
        answered: list[StationSafety] = []

        page = ServiceClient(self.wire.url, self.key)

        def ask() -> None:
            with page:
                told = Halted.model_validate_json(page.request("POST", "/halt", json={}).content)
            answered.extend(station.safety for station in told.stations)

        asking = threading.Thread(target=ask)
        began_s = time.monotonic()
        since = time.time()
        asking.start()
        closed_s = PATIENCE_S
        while time.monotonic() < began_s + PATIENCE_S:
            last = not asking.is_alive()  # before the looks: an answer that came is looked at
            safety = self.safety()
            for one in (*answered, *([safety] if safety is not None else [])):
                if one.shutter == "closed" and one.at.timestamp() >= since:
                    closed_s = min(closed_s, time.monotonic() - began_s)
            settled = safety is not None and safety.state != "halting"
            if last and settled and (closed_s < PATIENCE_S or time.monotonic() > began_s + 20.0):
                break
            time.sleep(0.1)  # more would be a load of its own
        asking.join(PATIENCE_S)
        return closed_s, self.safety()


@contextlib.contextmanager
def desk(data: Path) -> Iterator[Desk]:
    (data / "stations").mkdir(parents=True)
    store = Store(data)
    key = create_key(store, "halts", Permission.ADMIN)
    store.close()
    with mock_bench(()) as bench:
        station = data / "stations" / "bench.toml"
        station.write_text(bench.read_text())
        with served(data) as (url, _, _):
            made = Desk(int(url.rpartition(":")[2]), key, station, random.Random(SEED))
            try:
                yield made
            finally:
                made.client.close()
                made.wire.close()


def test_each_halt_is_confirmed(tmp_path: Path) -> None:
    seen = Seen()
    print(f"\nhalts: {HALTS} with HALTS_SEED={SEED}")
    with desk(tmp_path / "data") as at:
        for number in range(1, HALTS + 1):
            wanted = at.rng.choices(list(PHASES), list(PHASES.values()))[0]
            session_id, phase = at.reach(wanted)
            if at.rng.random() < 0.2:
                at.wire.cut()
                seen.cut += 1
            closed_s, safety = at.halt()
            seen.closed_s.setdefault(phase, []).append(closed_s)
            reads = "nothing" if safety is None else f"{safety.state}, shutter {safety.shutter}"
            seen.afterwards[reads] += 1
            ended = at.until(session_id) if session_id else ""
            which = f"halt {number} while {phase}: "
            if closed_s > CONFIRMED_S:
                seen.wrong.append(f"{which}confirmed after {closed_s:.2f} s, the station reads {safety}")
            elif safety is None or (safety.state, safety.shutter) != ("safe", "closed"):
                seen.wrong.append(f"{which}afterwards the station reads {safety}")
            elif shutter_is_open(at.station):
                seen.wrong.append(f"{which}the service says closed, the shutter itself says open")
            if ended == "failed":
                seen.wrong.append(f"{which}the session failed: {at.client.session(session_id).error}")
            if seen.wrong and seen.wrong[-1].startswith(which):
                print(seen.wrong[-1])
    print(seen.told())
    assert seen.wrong == []
