"""Random access to what is read best in order: messages of a bag, frames of a video."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from typing import Any, Generic, TypeVar

from spslam.errors import DatasetError

Item = TypeVar("Item")
# Threads that read ahead ask for items slightly out of order: those passed over are kept.
_KEPT = 16
# Up to so many items are passed over rather than looked for anew.
_PASSED_OVER = 32


class SequentialItems(Generic[Item]):
    """Items by number, from any thread, of a source that gives them in order from any number on.

    Args:
        begin: gives numbers and items in ascending order, the first of them at the number asked for or before.
    """

    def __init__(self, begin: Callable[[int], Iterator[tuple[int, Item]]]) -> None:
        self._begin = begin
        self._lock = threading.Lock()
        self._items: Iterator[tuple[int, Item]] | None = None
        self._next = 0
        self._kept: OrderedDict[int, Item] = OrderedDict()

    def take(self, number: int, name: str) -> Item:
        """Item `number`.

        Args:
            number: of the item.
            name: what the error begins with.

        Raises:
            DatasetError: the source ends before it or passes it over, or whatever the source raises.
        """
        with self._lock:
            if number not in self._kept:
                if self._items is None or not self._next <= number <= self._next + _PASSED_OVER:
                    self._items = self._begin(number)
                self._read_up_to(number, name)
            return self._kept[number]

    def _read_up_to(self, number: int, name: str) -> None:
        items = self._items if self._items is not None else iter(())
        try:
            for found, item in items:
                self._kept[found] = item
                self._next = found + 1
                if len(self._kept) > _KEPT:
                    self._kept.popitem(last=False)
                if found >= number:
                    break
            if number not in self._kept:
                raise DatasetError(f"{name}: can't be read, though the index has it")
        except BaseException:
            self._items = None
            raise

    def __getstate__(self) -> dict[str, Any]:
        return {"_begin": self._begin}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["_begin"])  # type: ignore[misc]
