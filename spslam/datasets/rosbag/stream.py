"""The images of a topic, read when they are asked for."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from spslam.datasets.recording import ImageStream
from spslam.datasets.rosbag.bag import Bag, TopicIndex, explained
from spslam.datasets.rosbag.messages import decode_color_message, decode_depth_message
from spslam.datasets.sequential import SequentialItems


class TopicStream(ImageStream):
    """Color or depth images of a topic.

    Messages are read in order as long as they are asked for in about that order, and looked for by their time of
    recording otherwise. Each stream has the bag open for itself; a copy of it in another process opens it again.

    Args:
        path: of the bag.
        topic: of `Image` or `CompressedImage` messages.
        index: of the topic.
        is_depth: what the images are.
        units_per_meter: of depth; see `decode_depth_message`.
    """

    def __init__(
        self, path: Path, topic: str, index: TopicIndex, is_depth: bool, units_per_meter: float | None = None
    ) -> None:
        self.topic, self.index = topic, index
        self._path, self._is_depth, self._units = path, is_depth, units_per_meter
        self._messages = SequentialItems(_Messages(path, topic, index.recorded_ns))

    def __len__(self) -> int:
        return len(self.index.seconds)

    def times(self) -> np.ndarray:
        return self.index.seconds.copy()

    def read(self, number: int) -> np.ndarray:
        name = self.describe(number)
        bag, content = self._messages.take(int(self.index.places[number]), name)
        message = bag.parse(self.topic, content)
        with explained(self._path):  # a bag has definitions of its own, and so any fields
            if self._is_depth:
                return decode_depth_message(message, name, self._units)
            return decode_color_message(message, name)

    def describe(self, number: int) -> str:
        return f"{self._path}, {self.topic}, message {int(self.index.places[number])}"


class _Messages:
    """Gives the messages of a topic from a place in the order of recording on, with the bag that parses them.

    The bag is opened once, by the first call; a copy in another process opens it anew.
    """

    def __init__(self, path: Path, topic: str, recorded_ns: np.ndarray) -> None:
        self._path, self._topic, self._recorded_ns = path, topic, recorded_ns
        self._bag: Bag | None = None

    def __call__(self, place: int) -> Iterator[tuple[int, tuple[Bag, bytes]]]:
        bag = self._bag = self._bag or Bag(self._path)
        start = int(self._recorded_ns[place])
        # Messages that were recorded at the same time come before it.
        first = int(np.searchsorted(self._recorded_ns, start))
        for number, (_, content) in enumerate(bag.raw(self._topic, start), start=first):
            yield number, (bag, content)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_bag": None}
