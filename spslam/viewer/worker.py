"""Work of which only the newest matters."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from spslam.viewer.priority import take_spare_time_only

Item = TypeVar("Item")


class NewestWorker(Generic[Item]):
    """A thread that works on the newest item given to it; what came in between is dropped.

    Args:
        work: called with each item that is worked on.
        name: of the thread.
        rest: called after each item, which is forgotten by then.
        spare_time_only: whether the thread waits for cores that have nothing else to do.
    """

    def __init__(
        self,
        work: Callable[[Item], None],
        name: str,
        rest: Callable[[], None] = lambda: None,
        spare_time_only: bool = False,
    ):
        self._work, self._rest, self._spare_time_only = work, rest, spare_time_only
        self._changed = threading.Condition()
        self._item: Item | None = None
        self._is_busy = self._has_ended = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def submit(self, item: Item) -> None:
        """Replaces the item that waits, if any; does nothing once closed."""
        with self._changed:
            if not self._has_ended:
                self._item = item
                self._changed.notify_all()

    def wait_until_idle(self, timeout_s: float) -> bool:
        """Waits until nothing is left to do; returns whether that is so."""
        with self._changed:
            return self._changed.wait_for(lambda: self._item is None and not self._is_busy, timeout_s)

    def close(self) -> None:
        """Ends after the item in work; what waits is dropped."""
        with self._changed:
            self._has_ended, self._item = True, None
            self._changed.notify_all()

    def _run(self) -> None:
        if self._spare_time_only:
            take_spare_time_only()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._item is not None or self._has_ended)
                if self._has_ended or self._item is None:
                    return
                item, self._item, self._is_busy = self._item, None, True
            try:
                self._work(item)
                del item  # maps are large
                self._rest()
            finally:
                with self._changed:
                    self._is_busy = False
                    self._changed.notify_all()
