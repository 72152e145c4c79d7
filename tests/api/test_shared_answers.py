"""Answers that are made once for many clients while a session runs."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from starlette.types import Message, Receive, Scope, Send

from api import shared_answers
from api.keys import Permission, StoredKey, digest
from api.security import Gate
from api.shared_answers import Shared, SharedAnswers
from tests.api.conftest import Running, until_state

KEY = "calibench_good"
LIST = "/api/v1/sessions"


class Counting:
    """An application that answers how often it was asked; it answers when `go_on` is set."""

    def __init__(self, status: int = 200, size: int = 0) -> None:
        self.asked, self.status, self.size = 0, status, size
        self.go_on = asyncio.Event()
        self.go_on.set()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self.asked += 1
        body = str(self.asked).encode().ljust(self.size)
        await self.go_on.wait()
        await send({"type": "http.response.start", "status": self.status, "headers": [(b"x-total-count", b"7")]})
        await send({"type": "http.response.body", "body": body, "more_body": False})


class Served:
    """The middleware before an application, while a session runs, or not."""

    def __init__(self, app: Counting, busy: bool = True) -> None:
        self.app, self.shared, self.busy = app, Shared(), busy
        stored = [StoredKey("a", Permission.READ, digest(KEY))]
        gate = Gate(lambda anew: stored, lambda: True)
        self.whole = SharedAnswers(app, self.shared, "/api/v1", lambda: self.busy, gate)

    async def ask(self, path: str = LIST, method: str = "GET", key: str = KEY, **headers: str) -> tuple[bytes, Any]:
        """The body and the headers of an answer."""
        told: list[Message] = []

        async def send(message: Message) -> None:
            told.append(message)

        async def receive() -> Message:
            return {"type": "http.request"}

        sent = {"authorization": f"Bearer {key}"} | {name.replace("_", "-"): value for name, value in headers.items()}
        scope = {
            "type": "http",
            "method": method,
            "path": path,
            "query_string": b"",
            "headers": [(name.encode(), value.encode()) for name, value in sent.items()],
        }
        await self.whole(scope, receive, send)
        return told[1]["body"], told[0]["headers"]


async def many(served: Served, clients: int = 5) -> list[bytes]:
    """What clients are answered who ask while the first answer is being made."""
    served.app.go_on.clear()
    asking = [asyncio.create_task(served.ask()) for _ in range(clients)]
    for _ in range(10):
        await asyncio.sleep(0)
    served.app.go_on.set()
    return [body for body, _ in await asyncio.gather(*asking)]


def test_one_answer_for_all_who_ask_at_a_time() -> None:
    async def checked() -> None:
        served = Served(Counting())
        assert await many(served) == [b"1"] * 5
        # Later, too, with all its headers; what is asked for otherwise is another answer.
        assert await served.ask() == (b"1", [(b"x-total-count", b"7")])
        assert (await served.ask(f"{LIST}/a/captures"))[0] == b"2"
        # Half a second later it is made anew.
        for answer in served.shared._answers.values():
            answer.until_s = 0.0
        assert (await served.ask())[0] == b"3"

    asyncio.run(checked())


def test_what_changes_is_seen_by_the_next_request() -> None:
    async def checked() -> None:
        served = Served(Counting())
        assert (await served.ask())[0] == b"1"
        assert (await served.ask("/api/v1/halt", "POST"))[0] == b"2"
        assert (await served.ask())[0] == b"3"
        served.shared.forget()  # as a session's change of state does
        assert (await served.ask())[0] == b"4"
        # An answer that was begun before a change is given to nobody who asks after it.
        served.app.go_on.clear()
        served.shared.forget()
        before = asyncio.create_task(served.ask())
        await asyncio.sleep(0)
        served.shared.forget()
        after = asyncio.create_task(served.ask())
        await asyncio.sleep(0)
        served.app.go_on.set()
        assert {(await before)[0], (await after)[0]} == {b"5", b"6"}

    asyncio.run(checked())


@pytest.mark.parametrize(
    "asked",
    [
        {"path": "/api/v1/me"},
        {"path": "/api/v1/devices"},
        {"path": "/api/v1/sessions/a/events"},
        {"path": "/api/v1/sessions/a/archive.tar"},
        {"key": "calibench_wrong"},
        {"if_none_match": '"a"'},
    ],
)
def test_what_isnt_shared(asked: dict[str, str]) -> None:
    async def checked() -> None:
        served = Served(Counting())
        assert [(await served.ask(**asked))[0] for _ in range(2)] == [b"1", b"2"]  # type: ignore[arg-type]

    asyncio.run(checked())


def test_refusals_long_answers_and_an_idle_service_share_nothing() -> None:
    async def checked(served: Served) -> None:
        assert [body.strip() for body in await many(served, 3)] == [b"1", b"2", b"3"]

    async def all_three() -> None:
        await checked(Served(Counting(status=404)))
        await checked(Served(Counting(size=shared_answers.LARGEST_BYTES + 1)))
        await checked(Served(Counting(), busy=False))

    asyncio.run(all_three())


def test_a_client_of_a_running_session_sees_what_it_does(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    """Answers are shared for a minute: pause and abort are seen at once all the same."""
    monkeypatch.setattr(shared_answers, "FRESH_S", 60.0)
    running.bench.delay_s = 0.02
    with running.client() as client, running.client(None) as nobody:
        started = client.post(LIST, json={"station": "fakes", "quick": True, "sequences": ["dark"]}).json()["id"]
        until_state(client, started, "running")
        assert nobody.get(LIST).status_code == 401
        assert client.post(f"{LIST}/{started}/pause").json()["state"] in ("pausing", "paused")
        until_state(client, started, "paused")
        assert client.get(LIST).json()[0]["state"] == "paused"
        route = 'route="/sessions/{session_id}",status="200"'
        assert route in client.get("/metrics").text
        client.post(f"{LIST}/{started}/abort")
        until_state(client, started, "interrupted")
        running.store.remove_key("read")
        with running.client("read") as removed:
            assert removed.get(LIST).status_code == 401
