"""Pictures and figures of captures, which never change: made once for all who look at the same session."""

from __future__ import annotations

import functools
import threading

import numpy as np
from numpy.typing import NDArray

from api.preview import Form, preview
from api.upload import Inbox, is_recordings
from lab.capture.store import Store
from lab.formats.recording_set import DataSheet, RecordingSet
from lab.quick_look.curves import FrameFigures, frame_figures

FRAMES, PICTURES, FIGURES, SETS = 4, 256, 1024, 4


class Pictures:
    """Keeps the newest that were asked for. One is made at a time: a page full of pictures takes one core, not all of
    them. `source`: a session's id, or that of recordings that were sent in, whose captures are numbered from 1."""

    def __init__(self, store: Store, inbox: Inbox) -> None:
        self._store, self._inbox = store, inbox
        self._sent = functools.lru_cache(SETS)(self._read)
        self._making = threading.Lock()
        self._frame = functools.lru_cache(FRAMES)(self._load)
        self._picture = functools.lru_cache(PICTURES)(self._make_picture)
        self._figures = functools.lru_cache(FIGURES)(self._make_figures)

    def recordings(self, recordings_id: str) -> RecordingSet:
        """Return recordings that were sent in, read once for all who look at them. Raises InputError where there are
        none.
        """
        self._inbox.folder(recordings_id)
        return self._sent(recordings_id)

    def frame(self, source: str, capture_id: int) -> NDArray[np.uint16]:
        """Return the raw frame of a capture, as `picture` finds it."""
        with self._making:
            return self._frame(source, capture_id)[0]

    def _read(self, recordings_id: str) -> RecordingSet:
        recordings = self._inbox.recordings(recordings_id)
        recordings.cache_bytes = 0  # `_frame` keeps some
        return recordings

    def picture(self, source: str, capture_id: int, width_px: int, stretch: bool, form: Form) -> bytes:
        """Return a capture as `preview` shows it. Raises InputError where its frame is missing or damaged."""
        with self._making:
            return self._picture(source, capture_id, width_px, stretch, form)

    def figures(self, source: str, capture_id: int) -> FrameFigures:
        """Return the figures of a capture's frame. Raises InputError as `picture`."""
        with self._making:
            return self._figures(source, capture_id)

    def _load(self, source: str, capture_id: int) -> tuple[NDArray[np.uint16], DataSheet]:
        if is_recordings(source):
            recordings = self.recordings(source)
            capture = recordings.captures()[capture_id - 1]
        else:
            recordings = self._store.recording_set(source, (capture_id,))
            (capture,) = recordings.captures()
        return recordings.frame(capture), recordings.camera(capture.side)

    def _make_picture(self, source: str, capture_id: int, width_px: int, stretch: bool, form: Form) -> bytes:
        frame, camera = self._frame(source, capture_id)
        return preview(frame, camera, width_px, stretch, form)

    def _make_figures(self, source: str, capture_id: int) -> FrameFigures:
        return frame_figures(*self._frame(source, capture_id))
