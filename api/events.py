"""Server-sent events. The first event holds the present state, so a client may connect at any time."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Any

import anyio
from pydantic import BaseModel
from sse_starlette.event import ServerSentEvent
from sse_starlette.sse import EventSourceResponse

KEEP_ALIVE_S = 15.0


def event(name: str, content: BaseModel) -> ServerSentEvent:
    """Return an event of a stream.

    name : of the event
    content : its data

    >>> from lab.formats.results import FitResult
    >>> event("end", FitResult(source="my-camera", cameras={})).event
    'end'
    """
    return ServerSentEvent(event=name, data=content.model_dump_json())


def stream(events: Callable[[anyio.Event], AsyncIterator[ServerSentEvent]]) -> EventSourceResponse:
    """Return the streaming response. A comment every 15 s keeps proxies from closing the connection. `events` is given
    an event that is set when the service stops, and ends then."""
    stopping = anyio.Event()
    return EventSourceResponse(
        events(stopping), ping=KEEP_ALIVE_S, send_timeout=30.0, shutdown_event=stopping, shutdown_grace_period=2.0
    )


async def watch_state(
    look: Callable[[], BaseModel],
    over: Callable[[Any], bool],
    name: str,
    stopping: anyio.Event,
    changed: Callable[[], None],
    every_s: float = 0.5,
) -> AsyncIterator[ServerSentEvent]:
    """Yield the state now and after each change; the last event is called `end`. `look` reads the registry every
    `every_s` seconds, because other processes write to it, too; `changed` is called before a change of its `state` is
    told."""
    last_sent: Any = None
    while True:
        present: Any = await asyncio.to_thread(look)
        ended = over(present)
        if present != last_sent:
            if last_sent is None or present.state != last_sent.state:
                changed()
            yield event(name, present)
            last_sent = present
        if ended:
            yield event("end", present)
            return
        with anyio.move_on_after(every_s):
            await stopping.wait()
            return


def describe_events(*events: tuple[str, type[BaseModel], str]) -> dict[int | str, dict[str, Any]]:
    """Return OpenAPI's description of a stream.

    events : name, type of the data, and when it is sent, of each

    >>> list(describe_events(("end", BaseModel, "when it is over")))
    [200]
    """
    lines = [f"- `{name}`: {when}; its data is a `{model.__name__}`." for name, model, when in events]
    schema = {
        "type": "string",
        "description": "Server-sent events.",
        "x-events": {name: {"$ref": f"#/components/schemas/{model.__name__}"} for name, model, _ in events},
    }
    return {
        200: {
            "description": "Server-sent events, with a comment every 15 s.\n\n" + "\n".join(lines),
            "content": {"text/event-stream": {"schema": schema}},
        }
    }
