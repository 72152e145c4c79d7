"""When the sessions of the queue are expected to start, by the rules by which they are started."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest

from lab.capture.queue import QueuedSession, expected_times

NOW = datetime(2030, 1, 1, 22, 0, tzinfo=UTC)
LATE = NOW.replace(hour=23, minute=30)


def minutes(number: float) -> timedelta:
    return timedelta(minutes=number)


def waits(id: str, not_before: datetime | None = None, held: str | None = None) -> QueuedSession:
    return QueuedSession(id=id, name=id, station="", place=1, not_before=not_before, held=held)


@pytest.mark.parametrize(
    ("queue", "busy_until", "starts"),
    [
        # Two of one station at the same time: the second after the first.
        ([waits("a", LATE), waits("b", LATE)], {}, {"a": LATE, "b": LATE + minutes(10)}),
        # One without a time that comes later doesn't wait for one that isn't due.
        ([waits("a", LATE), waits("b")], {}, {"a": LATE, "b": NOW}),
        # It may run beyond that time: then the earlier one waits for it.
        ([waits("a", NOW + minutes(5)), waits("b")], {}, {"a": NOW + minutes(20), "b": NOW}),
        (
            [waits("a", LATE), waits("b", LATE + minutes(5)), waits("c")],
            {},
            {"a": LATE, "b": LATE + minutes(10), "c": NOW},
        ),
        # One that is held keeps back who comes later on its instruments, and no others.
        ([waits("a", held="halted"), waits("b"), waits("other")], {}, {"other": NOW}),
        ([waits("a"), waits("b")], {"shutter": NOW + minutes(3)}, {"a": NOW + minutes(3), "b": NOW + minutes(13)}),
        ([waits("a"), waits("other", LATE)], {"shutter": None}, {"other": LATE}),
        ([], {"shutter": LATE}, {}),
    ],
)
def test_each_starts_when_the_queue_lets_it(
    queue: list[QueuedSession], busy_until: dict[str, datetime | None], starts: dict[str, datetime]
) -> None:
    addresses = {one.id: frozenset({"other shutter"} if one.id == "other" else {"shutter", "left"}) for one in queue}
    taken = {one.id: 1200.0 if one.id == "b" and one.not_before is None else 600.0 for one in queue}
    found = expected_times(queue, addresses, taken, busy_until, NOW)
    assert {id: start for id, (start, _) in found.items()} == starts
    assert all(end - start == timedelta(seconds=taken[id]) for id, (start, end) in found.items())
