"""Series of frames from cameras that stream: pairs of the same trigger, matched by the frames' numbers and the cameras'
clocks.

A frame counts for a trigger, as the cameras number them from the start of the series. A number that was skipped is a
frame that got lost on the way; a number that came before is a frame that came twice; a frame that is damaged is torn.
What a camera didn't hear has no number: it shows in the clocks. Each trigger without a whole frame of every camera is
given again, so that a series has all of its pairs."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime

from drivers.camera.base import Frame, StreamingCamera
from drivers.errors import Garbled, InstrumentError, NoAnswer, Refused, Repeated

#: Triggers in a row that may fail before a series ends with the last failure.
MOST_LOST = 3
_LAST_OF_16_BIT = 0xFFFF


def frames_between(before: int, now: int) -> int:
    """Count the frames that were numbered between two; below 0 for one that comes out of order.

    before, now : frame numbers. GigE Vision's 16-bit numbers go from 65535 to 1; a camera that doesn't count says 0

    >>> frames_between(3, 4), frames_between(65535, 1), frames_between(4, 3)
    (0, 0, -2)
    """
    if before == now == 0:
        return 0
    if now < before <= _LAST_OF_16_BIT and before - now > _LAST_OF_16_BIT // 2:
        now += _LAST_OF_16_BIT
    return now - before - 1


@dataclass
class _Side:
    """One camera in the series: which trigger its latest frame belongs to."""

    camera: StreamingCamera
    name: str
    trigger: int = -1
    frame_id: int | None = None
    matched_ns: int | None = None  # its clock at the start of the pair before
    frame: Frame | None = field(default=None, repr=False)  # of `trigger`; None: taken, or torn

    def since_ns(self) -> int | None:
        """Time on its own clock from the pair before to its frame; None where the camera doesn't report it."""
        if self.frame is None or self.frame.camera_time_ns is None or self.matched_ns is None:
            return None
        return self.frame.camera_time_ns - self.matched_ns


class FrameStream:
    """`count` frames of each camera, of one trigger each, exposed together: the first camera leads, as in
    `capture_together`.

    The cameras are configured and stay armed. `interval_s`: least time from one trigger to the next. `in_flight`:
    triggers that are given before the frames of the first of them are there, which needs an interval that the cameras
    keep up with; the first of a series is always given alone, as it sets the clocks against one another. `on_loss` is
    notified of everything that got lost, in one line each. The next trigger is given before a pair is handed out: while
    a pair is kept, the next one is exposed.

    Raises ValueError for several triggers in flight without an interval.
    """

    def __init__(
        self,
        cameras: Sequence[StreamingCamera],
        count: int,
        *,
        interval_s: float = 0.0,
        in_flight: int = 1,
        on_loss: Callable[[str], None] = lambda line: None,
    ) -> None:
        if in_flight > 1 and interval_s <= 0.0:
            raise ValueError(
                f"{in_flight} triggers in flight at an interval of {interval_s} s; give one that the cameras keep up "
                "with"
            )
        self._sides = [
            _Side(camera, "camera " + (camera.identity().serial_number or str(n))) for n, camera in enumerate(cameras)
        ]
        self.left = count
        self._interval_s, self._in_flight, self._on_loss = interval_s, in_flight, on_loss
        self._given: deque[datetime] = deque()  # the triggers whose pairs aren't settled
        self._settled = 0  # triggers before those
        self._next_s = 0.0
        self._lost_in_a_row = 0
        self._armed = False

    def __iter__(self) -> Iterator[tuple[Frame, ...]]:
        while self.left:
            yield self.next()

    def next(self) -> tuple[Frame, ...]:
        """Return the next pair. Raises the failure of the last trigger after `MOST_LOST` lost ones in a row, and what
        no repetition mends."""
        try:
            while True:
                with self._starting_anew():
                    self._trigger(waiting=True)
                    pair = self._pair()
                    if pair is None:
                        continue
                    self.left -= 1
                    self._lost_in_a_row = 0
                    with self._starting_anew():
                        self._trigger(waiting=False)
                    return pair
        except BaseException:
            self.close()
            raise

    @contextlib.contextmanager
    def _starting_anew(self) -> Iterator[None]:
        """After what leaves open which frames are still to come, all cameras start anew."""
        try:
            yield
        except (NoAnswer, Garbled, Refused) as error:
            self._lose(error)
            self._disarm()

    def close(self) -> None:
        """Discard what was triggered and not handed out; the cameras stay connected."""
        self.left = 0
        if self._given:
            self._disarm()

    # --- triggers ---------------------------------------------------------------------------------------------------

    def _trigger(self, *, waiting: bool) -> None:
        """Give triggers up to `in_flight`, as many as there are pairs wanted. `waiting`: at least one, when its time
        has come."""
        leader, *others = self._sides
        while len(self._given) < min(self.left, self._in_flight if self._clocks_known() else 1):
            wait_s = self._next_s - time.monotonic()
            if wait_s > 0.0:
                if not waiting or self._given:
                    return
                time.sleep(wait_s)
            if not self._armed:
                self._arm()
            self._next_s = time.monotonic() + self._interval_s
            self._given.append(datetime.now(UTC))
            leader.camera.fire()
            for side in others:
                side.camera.follow()

    def _clocks_known(self) -> bool:
        return self._armed and self._settled > 0

    def _arm(self) -> None:
        leader, *others = self._sides
        for side in others:
            side.camera.arm("line")
        leader.camera.arm("software")
        for side in self._sides:
            side.trigger, side.frame_id, side.matched_ns, side.frame = -1, None, None, None
        self._settled = 0
        self._armed = True

    def _disarm(self) -> None:
        self._given.clear()
        self._armed = False
        for side in self._sides:
            side.camera.disarm()

    # --- frames -----------------------------------------------------------------------------------------------------

    def _pair(self) -> tuple[Frame, ...] | None:
        """Return the frames of the oldest trigger that is still open; None if one of them got lost."""
        for side in self._sides:
            while side.trigger < self._settled:
                self._receive(side)
        late = self._find_missed()
        if late is not None:
            self._count_on(late, 1, f"{late.name}: it didn't hear a trigger; use a longer interval, and check its line")
        newest = max(side.trigger for side in self._sides)
        if newest > self._settled:
            self._settle(newest)
            return None
        fired = self._given[0]
        self._settle(self._settled + 1)
        frames = [side.frame for side in self._sides if side.frame is not None]
        if len(frames) < len(self._sides):
            return None
        for side, frame in zip(self._sides, frames, strict=True):
            side.matched_ns, side.frame = frame.camera_time_ns, None
        return tuple(replace(frame, time=fired) for frame in frames)

    def _receive(self, side: _Side) -> None:
        """The next frame of one camera, and which trigger it belongs to."""
        try:
            frame: Frame | None = side.camera.next_frame()
        except Repeated as error:
            self._on_loss(str(error))
            return
        except Garbled as error:
            self._lose(error)
            side.trigger += 1
            side.frame = None
            if side.frame_id is not None:
                side.frame_id += 1
            return
        assert frame is not None
        skipped = 0 if side.frame_id is None else frames_between(side.frame_id, frame.frame_id)
        if skipped < 0:
            raise NoAnswer(f"{side.name}: frame {frame.frame_id} came after frame {side.frame_id}; it is started anew")
        side.trigger, side.frame_id, side.frame = side.trigger + 1, frame.frame_id, frame
        if skipped:
            lost = f"{skipped} frame{'s' if skipped > 1 else ''} before frame {frame.frame_id} got lost"
            self._count_on(side, skipped, f"{side.name}: {lost}; use another cable or port")

    def _count_on(self, side: _Side, triggers: int, why: str) -> None:
        """A camera's frame belongs to a later trigger. Raises NoAnswer if none such was given: nobody knows what it
        shows then."""
        if side.trigger + triggers >= self._settled + len(self._given):
            raise NoAnswer(why)
        side.trigger += triggers
        self._lose(why)

    def _settle(self, trigger: int) -> None:
        """Close all triggers before this one, with a pair or without."""
        while self._settled < trigger:
            self._settled += 1
            self._given.popleft()

    def _find_missed(self) -> _Side | None:
        """Return a wired camera whose frame began half an interval later than the others': it belongs to another
        trigger.

        The interval is the least one; without one, the time since the pair before, as then each trigger waits for a
        pair."""
        since = [
            (since_ns, side)
            for side in self._sides
            if not side.camera.follows_by_software and (since_ns := side.since_ns()) is not None
        ]
        if len(since) < 2:
            return None
        least_ns = min(since_ns for since_ns, _ in since)
        most_ns, late = max(since, key=lambda interval_and_side: interval_and_side[0])
        interval_ns = 1e9 * self._interval_s or least_ns
        return late if most_ns - least_ns > 0.5 * interval_ns else None

    def _lose(self, what: InstrumentError | str) -> None:
        """Tell of a lost trigger. Raises the failure where too many in a row got lost."""
        self._lost_in_a_row += 1
        error = what if isinstance(what, InstrumentError) else NoAnswer(what)
        if self._lost_in_a_row > MOST_LOST:
            raise error
        self._on_loss(f"{error}; it is taken again")
