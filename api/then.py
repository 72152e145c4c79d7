"""What follows a session's end: an analysis, a comparison with the certified calibration, a word to a webhook.

It is asked for with the session and kept in the registry, so it survives the service. `then_state` of a session's row
is `waiting` until the session has finished, `running` while its job is, `done` or `failed` afterwards.
"""

from __future__ import annotations

import json
import logging
import threading
import urllib.request
from collections.abc import Callable, Collection
from dataclasses import dataclass
from datetime import UTC
from typing import Any
from urllib.parse import urlsplit

import sqlalchemy as sa
from fastapi import HTTPException

from api.live import LiveSessions
from api.schemas import SessionStart, Then, ThenState
from lab.calibration.life import calibration, rig_of
from lab.capture.store import Store
from lab.capture.tables import CalibrationRow, SessionRow
from lab.errors import CannotWrite, InputError
from lab.fit.compare import compare
from lab.formats.results import FitResult
from lab.jobs import JobRunner
from lab.pipeline import STEPS
from lab.resolve import ResolveLimits

log = logging.getLogger(__name__)
#: How often (s) it is looked whether something follows, and how long (s) a webhook may take to answer.
LOOK_S, ANSWER_S = 1.0, 10.0
ENDED_EARLY = ("interrupted", "failed")


def keep_request(store: Store, session_id: str, asked: SessionStart) -> None:
    """Keep what a session was asked to start with, and what follows its end."""
    with store.transaction() as db:
        row = db.get_one(SessionRow, session_id)
        row.request = asked.model_dump(mode="json", exclude={"queue"}, exclude_none=True)
        row.then_state = None if asked.then is None else "waiting"


def read_request(store: Store, session_id: str) -> SessionStart | None:
    """Return what a session was asked to start with, with the name, the notes and the time that it has now; None where
    it wasn't started by a service."""
    with store.reading() as db:
        row = db.get_one(SessionRow, session_id)
        kept, at, words = row.request, row.not_before, {"name": row.name, "notes": row.notes}
    if kept is None:
        return None
    start = SessionStart.model_validate({name: of for name, of in kept.items() if name != "not_before"} | words)
    zoned = at if at is None or at.tzinfo is not None else at.replace(tzinfo=UTC)
    return start.model_copy(update={"queue": at is not None, "not_before": zoned})


def then_of(store: Store, session_id: str) -> ThenState | None:
    """Return how far that is which follows a session's end; None where nothing was asked for."""
    with store.reading() as db:
        row = db.get_one(SessionRow, session_id)
        state, kept, asked = row.then_state, row.then or {}, row.request
    if state is None or asked is None:
        return None
    then = Then.model_validate(asked["then"])
    words = then.in_words
    if state != "waiting":
        words = f"{words}: {kept.get('words') or state}"
    names = () if then.kind is None else STEPS[then.kind]
    steps = [
        {"name": name, "state": "waiting"}
        for name in names
        if name != "capture" and (name != "resolve" or then.resolve)
    ]
    more = {name: kept.get(name) for name in ("job_id", "comparison", "told")}
    return ThenState.model_validate(
        {"state": state, "steps": steps if state == "waiting" else (), "words": words, **more}
    )


def check_webhook(url: str | None, hosts: Collection[str]) -> None:
    """Check the address that is notified of a session's end. Raises 422 for a host that the service wasn't started
    with.

    url : None: nobody is notified
    hosts : of `calibench serve --webhook-host`

    >>> check_webhook("https://lab.example/ended", ["lab.example"])
    """
    if url is None:
        return
    host = (urlsplit(url).hostname or "").lower()
    if host not in hosts:
        known = f"it has {', '.join(sorted(hosts))}" if hosts else "it has none"
        raise HTTPException(
            422,
            f"then.webhook: {host!r} isn't a host that the service tells; {known}, `calibench serve --webhook-host`",
        )


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *_: Any) -> None:
        """Follow none: it could lead to any host."""


def _tell(url: str, message: dict[str, Any]) -> str:
    """Send a message to a webhook; what came of it, in words."""
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}), _NoRedirect)
    request = urllib.request.Request(url, json.dumps(message).encode(), {"Content-Type": "application/json"})
    try:
        with opener.open(request, timeout=ANSWER_S) as answer:
            return f"told, answered {answer.status}"
    except OSError as error:
        return f"the webhook wasn't told: {error}"


@dataclass(frozen=True)
class _Following:
    """A session of which something follows: its row as it is needed."""

    id: str
    name: str
    state: str
    then_state: str
    then: dict[str, Any]
    asked: Then


class ThenRunner:
    """Looks at what follows the sessions that have ended, in a thread of its own, from `start` to `close`."""

    def __init__(
        self, store: Store, live: LiveSessions, jobs: JobRunner, hosts: Collection[str], changed: Callable[[], None]
    ) -> None:
        self.hosts = frozenset(hosts)
        self._store, self._live, self._jobs, self._changed = store, live, jobs, changed
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._work, name="then", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def close(self) -> None:
        """End the thread; what follows is looked at again by the next service."""
        self._ended.set()
        if self._thread.ident is not None:
            self._thread.join(ANSWER_S + LOOK_S)

    def _work(self) -> None:
        while not self._ended.wait(LOOK_S):
            try:
                self.look()
            except CannotWrite as error:  # tried again
                log.debug("looking at what follows: %s", error)
            except Exception:
                log.exception("looking at what follows: a defect")

    def look(self) -> None:
        """Do what is due."""
        asked = sa.select(SessionRow).where(SessionRow.then_state.in_(("waiting", "running")))
        with self._store.reading() as db:
            following = [
                _Following(
                    row.id,
                    row.name,
                    row.state,
                    row.then_state,
                    dict(row.then or {}),
                    Then.model_validate(row.request["then"]),
                )
                for row in db.scalars(asked)
                if row.request is not None and row.then_state is not None
            ]
        for follows in following:
            if self._ended.is_set():
                return
            if follows.then_state == "running":
                self._look_at_job(follows)
            elif follows.state == "finished" and self._live.find(follows.id) is None:
                self._begin(follows)
            elif follows.state in ENDED_EARLY and self._live.find(follows.id) is None:
                self._tell_early_end(follows)
            elif "told_of" in follows.then:
                self._keep(follows, "waiting", {})  # it goes on

    def _begin(self, follows: _Following) -> None:
        if follows.asked.kind is None:
            self._end(follows, "done", follows.then, "")
            return
        try:
            capturer = (
                self._live.capturer(self._store.station(follows.id)) if follows.asked.kind == "pipeline" else None
            )
            limits = ResolveLimits() if follows.asked.resolve else None
            job_id = self._jobs.submit(follows.asked.kind, follows.id, resolve=limits, capturer=capturer)
        except InputError as error:
            self._end(follows, "failed", follows.then, str(error))
            return
        self._keep(follows, "running", {"job_id": job_id})

    def _look_at_job(self, follows: _Following) -> None:
        job = self._jobs.job(follows.then["job_id"])
        if not job.is_over:
            return
        if job.state != "done":
            self._end(
                follows, "failed", follows.then, f"job {job.id} is {job.state}: {job.error or 'without a reason'}"
            )
            return
        words, comparison = self._compare_with_certified(follows) if follows.asked.compare else ("", None)
        self._end(follows, "done", follows.then | ({"comparison": comparison} if comparison else {}), words)

    def _compare_with_certified(self, follows: _Following) -> tuple[str, str | None]:
        """Return how the newest fit of a session compares with the certified calibration of its cameras."""
        newest = calibration(self._store, follows.id)
        of_rig = (CalibrationRow.rig == rig_of(newest.cameras), CalibrationRow.certified.is_not(None))
        asked = sa.select(CalibrationRow.id).where(*of_rig).order_by(CalibrationRow.certified.desc())
        with self._store.reading() as db:
            ids = list(db.scalars(asked))
        certified = [id for id in ids if calibration(self._store, id).state == "certified"]
        if not certified:
            return "these cameras have no certified calibration to compare with", None
        a, b = (FitResult.model_validate(self._store.result(id).document) for id in (certified[0], newest.id))
        comparison = compare(a, b)
        number = sum(row.changed for row in comparison.changes) + sum(row.changed for row in comparison.projection)
        total = len(comparison.changes) + len(comparison.projection)
        page = f"/api/v1/comparisons/page?a={certified[0]}&b={newest.id}"
        return f"{number or 'none'} of {total} figures changed since the certified calibration {certified[0]}", page

    def _tell_early_end(self, follows: _Following) -> None:
        if follows.then.get("told_of") != follows.state:
            failure = self._notify(follows, {"words": f"the session is {follows.state}"})
            self._keep(follows, "waiting", {"told_of": follows.state, "told": failure})

    def _end(self, follows: _Following, state: str, then: dict[str, Any], words: str) -> None:
        kept = {key: value for key, value in then.items() if key != "told_of"} | {"words": words}
        self._keep(follows, state, kept | {"told": self._notify(follows, kept | {"then": state})})

    def _notify(self, follows: _Following, more: dict[str, Any]) -> str | None:
        url = follows.asked.webhook
        if url is None:
            return None
        if (urlsplit(url).hostname or "").lower() not in self.hosts:
            return "the webhook wasn't told: the service is no longer started with its host"
        return _tell(url, {"session": follows.id, "name": follows.name, "state": follows.state} | more)

    def _keep(self, follows: _Following, state: str, then: dict[str, Any]) -> None:
        with self._store.transaction() as db:
            row = db.get(SessionRow, follows.id)
            if row is not None:
                row.then_state, row.then = state, then
        self._changed()
