"""Pictures and figures of captures, which never change: made once for all who look at the same session."""

from __future__ import annotations

import functools
import threading

import numpy as np
from numpy.typing import NDArray

from api.preview import Form, preview
from lab.capture.store import Store
from lab.formats.recording_set import DataSheet
from lab.quick_look.frame_figures import FrameFigures, frame_figures

FRAMES, PICTURES, FIGURES = 4, 256, 1024


class Pictures:
    """Keeps the newest that were asked for. One is made at a time: a page full of pictures takes one core, not all of
    them."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._making = threading.Lock()
        self._frame = functools.lru_cache(FRAMES)(self._loaded)
        self._picture = functools.lru_cache(PICTURES)(self._made_picture)
        self._figures = functools.lru_cache(FIGURES)(self._made_figures)

    def picture(self, session_id: str, capture_id: int, width_px: int, stretch: bool, form: Form) -> bytes:
        """A capture as `preview` shows it. Raises InputError where its frame is missing or damaged."""
        with self._making:
            return self._picture(session_id, capture_id, width_px, stretch, form)

    def figures(self, session_id: str, capture_id: int) -> FrameFigures:
        """The figures of a capture's frame. Raises InputError as `picture`."""
        with self._making:
            return self._figures(session_id, capture_id)

    def _loaded(self, session_id: str, capture_id: int) -> tuple[NDArray[np.uint16], DataSheet]:
        recordings = self._store.recording_set(session_id, (capture_id,))
        (capture,) = recordings.captures()
        return recordings.frame(capture), recordings.camera(capture.side)

    def _made_picture(self, session_id: str, capture_id: int, width_px: int, stretch: bool, form: Form) -> bytes:
        frame, camera = self._frame(session_id, capture_id)
        return preview(frame, camera, width_px, stretch, form)

    def _made_figures(self, session_id: str, capture_id: int) -> FrameFigures:
        return frame_figures(*self._frame(session_id, capture_id))
