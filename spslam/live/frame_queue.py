"""The queue between camera and loop: it keeps the newest frames and drops those that came too long ago."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

from spslam.errors import DatasetError
from spslam.live.source import LiveFrame

CAPACITY = 16  # frames; bounds memory where the loop stands still

Item = LiveFrame | DatasetError


class FrameQueue:
    """Frames in order. One that has waited for longer than a limit is dropped if a newer one is there.

    Args:
        max_wait_s: the limit. So the wait of a frame that is taken is at most this, unless it is the newest.
        capacity: most frames that wait; the oldest is dropped for a newer one.
        clock: the time, s.

    Attributes:
        dropped: frames dropped so far.
    """

    def __init__(
        self, max_wait_s: float, capacity: int = CAPACITY, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._max_wait_s, self._capacity, self._clock = max_wait_s, capacity, clock
        self._items: deque[Item] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self.dropped = 0

    def put(self, item: Item) -> None:
        """Adds the newest frame; never waits."""
        with self._changed:
            if len(self._items) >= self._capacity:
                self._items.popleft()
                self.dropped += 1
            self._items.append(item)
            self._changed.notify()

    def take(self, timeout_s: float) -> Item | None:
        """The oldest frame that is not too late, once there is one; None after the timeout, and when none will come."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._closed, timeout_s)
            while len(self._items) > 1 and self._is_late(self._items[0]):
                self._items.popleft()
                self.dropped += 1
            return self._items.popleft() if self._items else None

    def close(self) -> None:
        """No more frames will come."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def __len__(self) -> int:
        return len(self._items)

    @property
    def is_over(self) -> bool:
        """Whether it is closed and all its frames are taken."""
        with self._changed:
            return self._closed and not self._items

    def _is_late(self, item: Item) -> bool:
        return isinstance(item, LiveFrame) and self._clock() - item.complete_s > self._max_wait_s
