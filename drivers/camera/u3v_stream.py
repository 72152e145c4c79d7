"""The stream of a USB3 Vision camera: leader, payload and trailer put together to frames, by a thread that always has a
transfer waiting.

A leader is looked for before every frame, so that a frame which comes in part costs itself alone.

Source: A3, USB3 Vision 1.1, section 5.
"""

from __future__ import annotations

import contextlib
import errno
import queue
import struct
import threading
import time
from array import array
from dataclasses import dataclass

import numpy as np
import usb.core
from numpy.typing import NDArray

from drivers.camera.buffers import Grabbed
from drivers.camera.gencp import STATUS
from drivers.camera.pixel_format import PIXEL_FORMATS

LEADER_MAGIC, TRAILER_MAGIC = 0x4C563355, 0x54563355  # "U3VL", "U3VT"
LEADER = struct.Struct("<IHHQHHQIIIIIHH")  # 52 bytes
TRAILER = struct.Struct("<IHHQHHQI")  # 32 bytes

#: Frames that wait for whoever reads them; the camera itself drops the next ones.
BUFFERS = 4
#: How often (s) the thread looks whether it is to end, while nothing comes.
_LOOK_S = 0.1
#: Longest wait (s) for a transfer within a frame, after which it is looked whether the stream ends: shorter waits would
#: fall into transfers more often.
_WAIT_S = 1.0


@dataclass(frozen=True)
class StreamLayout:
    """The transfers of one frame (bytes), as the stream's registers (SIRM) were told."""

    leader_bytes: int
    trailer_bytes: int
    transfers: tuple[int, ...]


@dataclass(frozen=True)
class _Leader:
    frame_id: int
    camera_time_ns: int
    code: int
    cols: int
    rows: int
    padding: int

    @classmethod
    def of(cls, data: bytes) -> _Leader | None:
        """None if it is no leader."""
        if len(data) < LEADER.size or LEADER.unpack_from(data)[0] != LEADER_MAGIC:
            return None
        (_, _, _, frame_id, _, _, time_ns, code, cols, rows, _, _, padding, _) = LEADER.unpack_from(data)
        return cls(frame_id, time_ns, code, cols, rows, padding)

    @property
    def payload_bytes(self) -> int:
        """Bytes of the whole payload; 0 for a pixel format that isn't known."""
        layout = PIXEL_FORMATS.get(self.code)
        return 0 if layout is None else (layout.payload_bytes(self.cols) + self.padding) * self.rows


class U3vStream:
    """Reads the stream endpoint on a thread of its own, from its making to `close`.

    `timeout_s`: longest time from a frame's leader to its end; it may be changed.
    """

    def __init__(self, device: usb.core.Device, endpoint: int, layout: StreamLayout, timeout_s: float) -> None:
        self._device, self._endpoint, self.timeout_s = device, endpoint, timeout_s
        self._head = array("B", bytes(max(layout.leader_bytes, layout.trailer_bytes)))
        self._pieces = [array("B", bytes(size)) for size in layout.transfers]
        self._leader: _Leader | None = None  # one that came where a trailer was due
        # The one given back last is filled next: of those that are never needed, no page is touched.
        self._free: queue.LifoQueue[NDArray[np.uint8]] = queue.LifoQueue()
        for _ in range(BUFFERS):
            self._free.put(np.empty(sum(layout.transfers), np.uint8))
        self._came: queue.SimpleQueue[Grabbed | usb.core.USBError] = queue.SimpleQueue()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="u3v-stream", daemon=True)
        self._thread.start()

    def get(self, timeout_s: float) -> Grabbed | None:
        """Return the next frame; None if none came in time. Raises the `USBError` that ended the stream."""
        with contextlib.suppress(queue.Empty):
            came = self._came.get(timeout=timeout_s)
            if isinstance(came, usb.core.USBError):
                self._came.put(came)
                raise came
            return came
        return None

    def close(self) -> None:
        """End the thread."""
        self._ending.set()
        self._thread.join(2 * _LOOK_S + min(2 * _WAIT_S, self.timeout_s))

    # --- the thread -------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while not self._ending.is_set():
                leader = self._next_leader()
                buffer = None if leader is None else self._next_buffer()
                if leader is not None and buffer is not None:
                    self._came.put(self._frame(leader, buffer))
        except usb.core.USBError as error:
            self._came.put(error)

    def _next_leader(self) -> _Leader | None:
        """Return the leader of the next frame; what comes before one belongs to a frame whose leader was lost. None if
        nothing comes."""
        leader, self._leader = self._leader, None
        if leader is not None:
            return leader
        try:
            return _Leader.of(self._read(self._head, _LOOK_S))
        except usb.core.USBTimeoutError:
            return None

    def _next_buffer(self) -> NDArray[np.uint8] | None:
        while not self._ending.is_set():
            with contextlib.suppress(queue.Empty):
                return self._free.get(timeout=_LOOK_S)
        return None

    def _read(self, into: array[int], timeout_s: float) -> bytes:
        count = self._device.read(self._endpoint, into, max(1, int(1000 * timeout_s)))
        return into[:count].tobytes()

    def _frame(self, leader: _Leader, buffer: NDArray[np.uint8]) -> Grabbed:
        """Return the rest of a frame; what is missing of it stands in its `damage`."""
        deadline = time.monotonic() + self.timeout_s
        at, trailer, late = 0, b"", ""
        try:
            for piece in self._pieces:
                count = self._fill(piece, deadline)
                if count < len(piece) and count >= TRAILER.size and _is(piece, TRAILER_MAGIC):
                    trailer = piece[:count].tobytes()
                    break
                if count < len(piece) and count >= LEADER.size and _is(piece, LEADER_MAGIC):
                    self._leader = _Leader.of(piece[:count].tobytes())
                    break
                buffer[at : at + count] = np.frombuffer(piece, np.uint8, count)
                at += count
                if count < len(piece):
                    break  # a short transfer ends the payload
            if not trailer and self._leader is None:
                trailer = self._head[: self._fill(self._head, deadline)].tobytes()
                self._leader = _Leader.of(trailer)
        except usb.core.USBTimeoutError:
            late = f", and nothing more for {self.timeout_s:g} s"
        return Grabbed(
            payload=buffer[:at],
            rows=leader.rows,
            cols=leader.cols,
            code=leader.code,
            frame_id=leader.frame_id,
            padding=leader.padding,
            damage=_damage(leader, at, trailer, late),
            camera_time_ns=leader.camera_time_ns,
            give_back=lambda: self._free.put(buffer),
        )

    def _fill(self, piece: array[int], deadline: float) -> int:
        """Read a transfer until the deadline or the stream's end; the bytes that came. A long exposure is waited for in
        parts, so that a stop needn't wait for its end: a wait that ends within the transfer is followed by another for
        the rest of it."""
        came = 0
        while True:
            began = time.monotonic()
            part = piece if came == 0 else piece[came:]
            wait_ms = min(self._left_ms(deadline), int(1000 * _WAIT_S))
            try:
                count = self._device.read(self._endpoint, part, wait_ms)
            except usb.core.USBTimeoutError:
                count = 0
            if came:
                piece[came : came + count] = part[:count]
            came += count
            now = time.monotonic()
            if came == len(piece) or (count and now - began < wait_ms / 1000):
                return came
            if now >= deadline or self._ending.is_set():
                if came:
                    return came
                raise usb.core.USBTimeoutError("nothing came in time", errno=errno.ETIMEDOUT)

    @staticmethod
    def _left_ms(deadline: float) -> int:
        return max(1, int(1000 * (deadline - time.monotonic())))


def _is(piece: array[int], magic: int) -> bool:
    return piece[:4].tobytes() == struct.pack("<I", magic)


def _damage(leader: _Leader, came: int, trailer: bytes, late: str) -> str:
    """Return what is wrong with a frame of which `came` bytes of payload came; nothing if it is whole."""
    expected = leader.payload_bytes
    if came < expected:
        return f"{came} of {expected} bytes came{late}"
    if len(trailer) < TRAILER.size or TRAILER.unpack_from(trailer)[0] != TRAILER_MAGIC:
        return f"its trailer was lost{late}"
    _, _, _, frame_id, status, _, valid, _ = TRAILER.unpack_from(trailer)
    if status:
        return f"{STATUS.get(status, hex(status))}, {valid} of {expected} bytes valid"
    if frame_id != leader.frame_id:
        return f"its trailer is that of frame {frame_id}"
    return "" if valid >= expected else f"{valid} of {expected} bytes are valid"
