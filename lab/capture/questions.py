"""What a session that runs waits for an operator to do: put a target there, turn the chart, set the aperture.

The question lies in the session's folder, `asks.json`, from before anybody is asked until it is answered or given up.
So the operator's page, REST and the command line show it and can confirm it, in whatever process. One that a killed
process left is asked by nobody; the session that is resumed asks anew."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path

from pydantic import Field, ValidationError

from lab.capture.durable_files import write_durably
from lab.capture.file_lock import Lock
from lab.capture.store import Store
from lab.errors import InputError
from lab.formats.result_file import result_json
from sim.parameters import Frozen

FILE = "asks.json"
#: How often (s) a session looks for the answer, and how long the file's lock is waited for.
LOOK_S, PATIENCE_S = 0.1, 5.0


class Question(Frozen):
    """What a session waits for an operator to do."""

    target: str = Field(description="name of the target, or of the state of what a hand changes")
    instruction: str = Field(description="what the operator has to do")
    since: datetime
    until: datetime = Field(description="when the session gives up waiting; it can be resumed, and asks again")


class _Kept(Question):
    """The file: the question, and who said that it is done (empty: nobody yet)."""

    confirmed_by: str = ""


def question_of(store: Store, session: str) -> Question | None:
    """Return what a session waits for now; None: nothing, or it has ended."""
    kept = _read(store.folder(session))
    if kept is None or kept.confirmed_by or not store.lock(session).is_held():
        return None
    return Question(**kept.model_dump(exclude={"confirmed_by"}))


def confirm(store: Store, session: str, target: str, by: str, since: datetime | None = None) -> None:
    """Say that what a session waits for is done. Raises InputError, one line, where it doesn't wait for this target
    now, or, with `since`, asked for it at another time."""
    if question_of(store, session) is None:  # also of no session: its folder isn't made
        raise InputError(f"session {session}: asks for nothing now; {target!r} isn't confirmed")
    folder = store.folder(session)
    with _lock_folder(folder):
        asked = question_of(store, session)
        if asked is None:
            raise InputError(f"session {session}: asks for nothing now; {target!r} isn't confirmed")
        if asked.target != target:
            raise InputError(f"session {session}: asks for {asked.target!r} now; {target!r} isn't confirmed")
        if since not in (None, asked.since):
            raise InputError(
                f"session {session}: asks for {target!r} since {asked.since.isoformat()}; the earlier question is over"
            )
        _write(folder, _Kept(**asked.model_dump(), confirmed_by=by))


def put_question(folder: Path, question: Question) -> None:
    """Ask, from now on, for the session of a folder."""
    with _lock_folder(folder):
        _write(folder, _Kept(**question.model_dump()))


def wait_for_answer(folder: Path, question: Question, timeout_s: float, check_goes_on: Callable[[], None]) -> str:
    """Return who confirmed a question that was put; empty: nobody within `timeout_s`. The question is withdrawn then,
    and where `check_goes_on`, called again and again, raises."""
    ends_s = time.monotonic() + timeout_s
    try:
        while True:
            check_goes_on()
            kept = _read(folder)
            if kept is not None and kept.since == question.since and kept.confirmed_by:
                return kept.confirmed_by
            if time.monotonic() >= ends_s:
                return ""
            time.sleep(LOOK_S)
    finally:
        withdraw(folder, question)


def withdraw(folder: Path, question: Question | None = None) -> None:
    """Take a question away; None: whichever is there."""
    if not (folder / FILE).exists():
        return
    with _lock_folder(folder):
        kept = _read(folder)
        if question is None or (kept is not None and kept.since == question.since):
            (folder / FILE).unlink(missing_ok=True)


def _read(folder: Path) -> _Kept | None:
    try:
        return _Kept.model_validate_json((folder / FILE).read_bytes())
    except (OSError, ValidationError):  # a file that isn't whole was never put
        return None


def _write(folder: Path, kept: _Kept) -> None:
    write_durably(folder / FILE, result_json(kept).encode("utf-8"))


@contextlib.contextmanager
def _lock_folder(folder: Path) -> Iterator[None]:
    lock = Lock(folder / ".asks.lock")
    if not lock.acquire(PATIENCE_S):
        raise InputError(f"{lock.path}: another process holds it for {PATIENCE_S:g} s; look for one that hangs")
    try:
        yield
    finally:
        lock.release()
