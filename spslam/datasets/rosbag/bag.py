"""A bag and its messages: what is recorded, and the messages of a topic from any time on."""

from __future__ import annotations

import contextlib
import functools
import io
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from spslam.datasets.base import MAX_FRAMES
from spslam.errors import DatasetError, brief
from spslam.reading import open_regular

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

BAG_SUFFIXES = (".bag", ".mcap", ".db3")
METADATA_FILE = "metadata.yaml"
_NANOSECONDS = 1_000_000_000
_LONGEST_NAME = 1000
# What mends a bag whose recording was cut off, by its suffix; folders have none.
_HINTS = {
    ".bag": "; `rosbag reindex` mends a bag whose recording was cut off",
    ".mcap": "; `mcap recover` mends a file whose recording was cut off",
    "": "; `ros2 bag reindex` mends a bag whose recording was cut off",
}


@dataclass(frozen=True)
class TopicIndex:
    """When the messages of a topic were stamped and recorded.

    Attributes:
        seconds: float64 [N], the times in the messages' headers, s, ascending, none twice; of messages without such a
            time (all zeros) those of recording.
        recorded_ns: int64 [M], when each message was recorded, in order.
        places: int64 [N], for each of `seconds` the number of its message in order of recording.
        frame_id: of the first message.
    """

    seconds: np.ndarray
    recorded_ns: np.ndarray
    places: np.ndarray
    frame_id: str


def bag_files(path: Path) -> list[Path]:
    """What a path stands for: the bag file, a ROS 2 folder, or all ROS 1 bags of a folder (one split recording).

    Raises:
        DatasetError: there is no such path, or no bag in the folder.
    """
    if not path.exists():
        raise DatasetError(f"{path}: no such file or folder")
    if not path.is_dir():
        open_regular(path, DatasetError).close()
        if path.suffix not in BAG_SUFFIXES:
            raise DatasetError(f"{path}: a ROS bag must end in {', '.join(BAG_SUFFIXES)}")
        return [path]
    if (path / METADATA_FILE).is_file():
        return [path]
    for suffix in BAG_SUFFIXES:
        found = sorted(file for file in path.glob(f"*{suffix}") if file.is_file())
        if found and (suffix == ".bag" or len(found) == 1):
            return found
        if found:
            raise DatasetError(f"{path}: {len(found)} {suffix} files must have a {METADATA_FILE} beside them, got none")
    raise DatasetError(f"{path}: must contain a ROS bag ({', '.join(BAG_SUFFIXES)}), got none")


class Bag:
    """A bag that is open for reading, from one thread at a time; use it in a `with` block or call `close`.

    Args:
        path: see `bag_files`.

    Attributes:
        path: as given.
        topics: type of the messages of each topic.
        counts: number of messages of each topic.

    Raises:
        DatasetError: `rosbags` is not installed, or the bag can't be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._reader = _open_reader(path)
        with self._explained():
            found = self._reader.topics
        self.topics = {name: _full_name(info.msgtype) for name, info in found.items() if info.msgtype is not None}
        self.counts = {name: info.msgcount for name, info in found.items()}

    def close(self) -> None:
        """Closes the files."""
        with contextlib.suppress(Exception):
            self._reader.close()

    def __enter__(self) -> Bag:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def raw(self, topic: str, start_ns: int | None = None) -> Iterator[tuple[int, bytes]]:
        """Times of recording (ns) and bytes of a topic's messages in order.

        Args:
            topic: one of `topics`.
            start_ns: from which time of recording on; all where None.

        Raises:
            DatasetError: the bag is damaged.
        """
        with self._explained():
            connections = [found for found in self._reader.connections if found.topic == topic]
            for _, recorded_ns, content in self._reader.messages(connections=connections, start=start_ns):
                yield recorded_ns, content

    def parse(self, topic: str, content: bytes) -> Any:
        """A message of a topic from its bytes; raises DatasetError where they are damaged."""
        with self._explained():
            return self._reader.deserialize(content, self.topics[topic])

    def messages(self, topic: str) -> Iterator[Any]:
        """All messages of a topic; see `raw`."""
        return (self.parse(topic, content) for _, content in self.raw(topic))

    def first(self, topic: str) -> Any:
        """The first message of a topic; raises DatasetError where there is none."""
        for message in self.messages(topic):
            return message
        raise DatasetError(f"{self.path}: topic {topic} must have messages, got none")

    def index(self, topic: str) -> TopicIndex:
        """The times of a topic's messages, from their headers; images are not decoded.

        Raises:
            DatasetError: no message, or a damaged bag.
        """
        stamps, recorded, frame_id = [], [], ""
        for recorded_ns, content in self.raw(topic):
            stamp_ns, name = _header(content, self._reader.is2, f"{self.path}, {topic}")
            frame_id = frame_id or name
            stamps.append(stamp_ns)
            recorded.append(recorded_ns)
            if len(stamps) > MAX_FRAMES:
                raise DatasetError(f"{self.path}: topic {topic} must have at most {MAX_FRAMES} messages")
        if not stamps:
            raise DatasetError(f"{self.path}: topic {topic} must have messages, got none")
        recorded_ns_all = np.array(recorded, dtype=np.int64)
        times = np.array(stamps, dtype=np.int64)
        seconds, places = np.unique(times if times.any() else recorded_ns_all, return_index=True)
        return TopicIndex(seconds / 1e9, recorded_ns_all, places, frame_id)

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        with explained(self.path):
            yield


def _full_name(kind: str) -> str:
    """`package/msg/Type`, also where a writer called it `package/Type`."""
    package, _, name = kind.partition("/")
    return f"{package}/msg/{name.removeprefix('msg/')}"


@contextlib.contextmanager
def explained(path: Path, hint: str = "") -> Iterator[None]:
    """Turns whatever `rosbags` raises on a damaged bag into one line that ends with `hint`."""
    try:
        yield
    except (DatasetError, GeneratorExit):
        raise
    except Exception as error:  # rosbags trusts what it reads, and raises whatever that comes to
        reason = brief(str(error) or type(error).__name__, 200)
        raise DatasetError(f"{path}: can't be read as a ROS bag: {reason}{hint}") from error


def topic_index(path: Path, topic: str) -> TopicIndex:
    """The index of a topic; read once per process for a bag that does not change."""
    files = bag_files(path)
    states = tuple((str(file), file.stat().st_mtime_ns, file.stat().st_size) for file in files)
    return _cached_index(path, topic, states)


@functools.lru_cache(maxsize=8)
def _cached_index(path: Path, topic: str, states: tuple) -> TopicIndex:
    with Bag(path) as bag:
        return bag.index(topic)


class _BoundedFile(io.BufferedReader):
    """A file of which nobody reads more than there is: a damaged length would have Python allocate as much first."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path, "rb"))
        self._size = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        left = max(self._size - self.tell(), 0)
        return super().read(left if size is None or size < 0 else min(size, left))


class _BoundedPath(type(Path())):  # type: ignore[misc]
    """A path whose file is opened as `_BoundedFile`."""

    def open(self, mode: str = "r", *args: Any, **options: Any) -> Any:
        return _BoundedFile(Path(self)) if mode == "rb" else super().open(mode, *args, **options)


def _open_reader(path: Path) -> AnyReader:
    files = [_BoundedPath(file) for file in bag_files(path)]
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise DatasetError(f"{path}: ROS bags need rosbags: pip install 'spslam[ros]'") from None
    with explained(path, _HINTS.get(files[0].suffix, _HINTS[""])):
        # Bags of ROS 2 before Iron don't hold the definitions of their messages.
        reader = AnyReader(files, default_typestore=get_typestore(Stores.LATEST))
        reader.open()
        return reader


def _header(content: bytes, is_ros2: bool, name: str) -> tuple[int, str]:
    """Time (ns) and frame of the header that a message begins with."""
    try:
        if is_ros2:  # CDR: four bytes of which the second's lowest bit says the byte order
            order = "<" if content[1] & 1 else ">"
            seconds, nanoseconds, length = struct.unpack_from(f"{order}iII", content, 4)
            start, length = 16, length - 1  # without the zero at its end
        else:
            _, seconds, nanoseconds, length = struct.unpack_from("<4I", content)
            start = 16
    except (struct.error, IndexError):
        raise DatasetError(f"{name}: a message must begin with a header, got {len(content)} bytes") from None
    if not 0 <= length <= _LONGEST_NAME:
        raise DatasetError(f"{name}: a message must begin with a header, got a damaged one")
    frame_id = content[start : start + length].decode("utf-8", "replace")
    return seconds * _NANOSECONDS + nanoseconds, frame_id.lstrip("/")
