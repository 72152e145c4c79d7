"""Clients of the service in one process: some that poll what the operator's page asks for, some that follow a session's
events.

`python -m benchmarks.service_clients PORT SESSION POLLING STREAMING EVERY_S`, the key on standard input. It begins when
it says `ready`, ends when its standard input does, and prints the time of every answer (ms) by what was asked, as JSON.
Plain sockets: a client library would cost more than the service."""

from __future__ import annotations

import asyncio
import contextlib
import json
import random
import sys
import time
from collections import defaultdict

API = "/api/v1"


class Connection:
    """One connection that is kept open."""

    def __init__(self, port: int, key: str) -> None:
        self.port, self.key = port, key

    async def open(self) -> None:
        self.reader, self.writer = await asyncio.open_connection("127.0.0.1", self.port, limit=1 << 24)

    async def get(self, path: str) -> bytes:
        """The body of what a path answers; asserts that it is an answer."""
        length = await self.head(path)
        return await self.reader.readexactly(length)

    async def head(self, path: str) -> int:
        """Ask, and read until the body begins; its length."""
        asked = f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{self.port}\r\nAuthorization: Bearer {self.key}\r\n\r\n"
        self.writer.write(asked.encode())
        lines = (await self.reader.readuntil(b"\r\n\r\n")).decode().lower().split("\r\n")
        assert " 200 " in f"{lines[0]} ", (path, lines[0])
        return next((int(line.split(":")[1]) for line in lines if line.startswith("content-length")), 0)


async def poll(connection: Connection, session: str, every_s: float, told: dict[str, list[float]]) -> None:
    """Ask for one thing after the other, `every_s` apart."""
    await connection.open()
    asked = {
        "sessions": f"{API}/sessions?limit=50",
        "jobs": f"{API}/jobs?limit=50",
        "stations": f"{API}/stations",
        "session": f"{API}/sessions/{session}",
        "queue": f"{API}/queue",
        "newest capture": f"{API}/sessions/{session}/captures?order=newest&limit=1",
        "curves": f"{API}/sessions/{session}/curves",
    }
    await asyncio.sleep(random.random() * every_s)
    turn = random.randrange(len(asked))
    while True:
        began_s = time.perf_counter()
        name = list(asked)[turn % len(asked)]
        body = await connection.get(asked[name])
        told[name].append(1e3 * (time.perf_counter() - began_s))
        if name == "newest capture" and (found := json.loads(body)):
            for what in ("preview", "figures"):
                at_s = time.perf_counter()
                path = (
                    f"{found[0]['preview']}?width=640"
                    if what == "preview"
                    else found[0]["preview"].replace("preview.png", what)
                )
                await connection.get(path)
                told[what].append(1e3 * (time.perf_counter() - at_s))
        turn += 1
        await asyncio.sleep(max(0.0, every_s - (time.perf_counter() - began_s)))


async def follow(connection: Connection, session: str, told: dict[str, list[float]]) -> None:
    """Read a session's events to their end."""
    await connection.open()
    await connection.head(f"{API}/sessions/{session}/events")
    while line := await connection.reader.readline():
        if line.startswith(b"event: "):
            told["events"].append(0.0)


async def main() -> None:
    port, session, polling, streaming, every_s = sys.argv[1:]
    key = sys.stdin.readline().strip()
    told: dict[str, list[float]] = defaultdict(list)
    clients = [poll(Connection(int(port), key), session, float(every_s), told) for _ in range(int(polling))]
    clients += [follow(Connection(int(port), key), session, told) for _ in range(int(streaming))]
    working = asyncio.gather(*clients)
    await asyncio.sleep(0)
    print("ready", flush=True)
    ended = asyncio.get_running_loop().run_in_executor(None, sys.stdin.read)
    await asyncio.wait([working, ended], return_when=asyncio.FIRST_COMPLETED)
    if working.done():
        working.result()  # what went wrong
    working.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await working
    print(json.dumps(told))


if __name__ == "__main__":
    asyncio.run(main())
