"""What the service keeps as a recording set and hands out as one: sessions, and recordings that were sent in. Handing
out and deleting is one shape for both."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from fastapi import Response

from api.archives import stream_archive
from api.errors import Conflict
from api.service import OVER, Service
from lab.calibration.life import check_nothing_rests_on
from lab.errors import InputError
from lab.formats.recording_set import ArchiveForm, RecordingSet, archive


@dataclass(frozen=True)
class KeptSet:
    """`what` it is, in words; `source`: what jobs on it are registered under; `read` and `remove` raise InputError
    where that can't be now."""

    what: str
    source: str
    read: Callable[[], RecordingSet]
    remove: Callable[[], None]

    def archive(self, form: ArchiveForm) -> Response:
        """Return the set as an archive. Raises Conflict where it can't be handed out now."""
        try:
            recordings = self.read()
        except InputError as error:
            raise Conflict(str(error)) from None
        recordings.cache_bytes = 0  # each frame is read once
        return stream_archive(archive(recordings, form), self.what.replace(" ", "-"), form)

    def delete(self, service: Service) -> None:
        """Delete it for ever. Raises Conflict while a job works on it, or where it can't be deleted now."""
        service.check_no_job(self.source, self.what)
        try:
            self.remove()
        except InputError as error:
            raise Conflict(str(error)) from None


def session_set(service: Service, session_id: str) -> KeptSet:
    """Return a session; 404 where there is none, Conflict where it is under way: what it has is still changing."""
    state = service.state(service.session(session_id))
    if state not in OVER:
        raise Conflict(f"session {session_id} is {state}; wait for its end or abort it")

    def read() -> RecordingSet:
        recordings = service.store.recording_set(session_id)
        if not recordings.captures():
            raise InputError(f"session {session_id}: nothing was captured yet; resume it")
        return recordings

    def remove() -> None:
        check_nothing_rests_on(service.store, session_id)
        service.store.delete_session(session_id)

    return KeptSet(f"session {session_id}", session_id, read, remove)


def find_sent_set(service: Service, recordings_id: str) -> KeptSet:
    """Return recordings that were sent in; 404 where there are none of that id."""
    folder = service.recordings(recordings_id)
    inbox = service.inbox
    return KeptSet(
        f"recordings {recordings_id}",
        str(folder),
        lambda: inbox.recordings(recordings_id),
        lambda: inbox.remove(recordings_id),
    )
