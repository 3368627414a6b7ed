"""What the run and its viewer's process tell each other.

The run sends the messages of this module over a socket, see `send`. The viewer answers with lines of JSON, `Request`s:
it asks for the next update and the next map when it has shown the last ones, so that at most one of each is on its way,
and a viewer that can't keep up is sent less. Either side detects by the closed socket that the other has ended.
"""

from __future__ import annotations

import json
import math
import pickle
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from spslam.camera import Camera
from spslam.config import Config

# Raised by a connection whose other end is closed.
DISCONNECTED = (EOFError, ConnectionError, OSError)
# Arrays from this size on are sent as they are.
_LARGE_BYTES = 1 << 16


Loop = tuple[int, int]


def closed_loops(lines: Iterable[Mapping[str, Any]]) -> list[Loop]:
    """Numbers of the frames of the loops that lines of log.jsonl say were closed; what is no such line has none."""
    found: list[Loop] = []
    for line in lines:
        loops = line.get("loops")
        for loop in loops if isinstance(loops, (list, tuple)) else ():
            source, target = (loop.get(end) if isinstance(loop, Mapping) else None for end in ("source", "target"))
            if isinstance(source, int) and isinstance(target, int) and loop.get("accepted") is True:
                found.append((source, target))
    return found


class Row(NamedTuple):
    """What is shown of one frame.

    Attributes:
        source_index: of the frame in the dataset.
        timestamp: s.
        lost: whether its pose is not to be trusted.
        error_probability: that its pose is wrong; NaN where it was not judged.
        residual_cm: of its pose; NaN where it was not tracked.
        mapped: whether it is a keyframe: fused into the map.
        relocalized: whether it was found against a stored frame that looks alike.
        voxels: allocated vertices of the map.
        fps: frames per second that the run makes.
        memory_mb: of the run's process; NaN where it is not known.
    """

    source_index: int
    timestamp: float
    lost: bool
    error_probability: float
    residual_cm: float
    mapped: bool
    relocalized: bool
    voxels: int
    fps: float
    memory_mb: float = math.nan

    @classmethod
    def of_log(cls, line: Mapping[str, Any]) -> Row:
        """From a line of log.jsonl; what it lacks is NaN, False or 0."""
        stages = ("wait_ms", "tracking_ms", "encode_ms", "mapping_ms", "other_ms")
        spent_ms = sum(_number(line, name, 0.0) for name in stages)
        return cls(
            int(_number(line, "index", -1)),
            _number(line, "timestamp"),
            bool(line.get("lost")),
            _number(line, "error_probability"),
            _number(line, "residual_cm"),
            # A live run optimizes the map after other frames as well.
            bool(line.get("encode_ms", line.get("mapping_iterations"))),
            bool(line.get("relocalized")),
            int(_number(line, "voxels", 0.0)),
            1e3 / spent_ms if spent_ms > 0 else math.nan,
        )


@dataclass(frozen=True)
class Begin:
    """The first message.

    Attributes:
        title: of the page.
        token: see `Listener`.
        host: see `Listener`.
        listening: file descriptor of the listening socket, open in both processes; None without a browser.
        recording: file to record to; None for none.
    """

    title: str
    token: str | None
    host: str
    listening: int | None
    recording: Path | None


@dataclass(frozen=True)
class RunBegins:
    """The run knows its frames; fields as in `spslam.run.observer.ObservedRun`, and of the map's scene.

    Attributes:
        settings: of the scene (`spslam.scene.scene.SceneSettings`).
        seed: of the scene.
    """

    name: str
    config: Config
    camera: Camera
    total: int | None
    data_dir: Path | None
    frames: slice | None
    can_read: bool
    can_pause: bool
    ground_truth: np.ndarray | None
    settings: Any
    seed: int


@dataclass(frozen=True)
class Update:
    """What came since the last update.

    Attributes:
        first: number of the first of them.
        rows: of the new frames.
        poses: float32 [len(rows), 7] T_world_camera, (w, x, y, z) and translation in m.
        color: uint8 [h, w, 3] RGB of the newest frame, reduced; None where the viewer reads it by itself.
        depth: float32 [h, w], m, of the same; None likewise.
        loops: numbers of the frames of loops that were closed meanwhile.
    """

    first: int
    rows: list[Row]
    poses: np.ndarray
    color: np.ndarray | None = None
    depth: np.ndarray | None = None
    loops: Sequence[Loop] = ()


@dataclass(frozen=True)
class MapSnapshot:
    """The map between two frames.

    Attributes:
        tensors: as `Scene.state_dict()`, as arrays.
        poses: float32 [F, 7] of all frames, as refined up to now.
    """

    tensors: dict[str, np.ndarray]
    poses: np.ndarray


@dataclass(frozen=True)
class RunEnds:
    """No frame comes after it; what came is to be shown, and recorded, to the end."""


Message = Begin | RunBegins | Update | MapSnapshot | RunEnds


@dataclass(frozen=True)
class Request:
    """What the viewer asks of the run; all defaults ask for nothing.

    Attributes:
        update: the next `Update`.
        map: the next `MapSnapshot`.
        paused: whether the run should wait between two frames; None leaves it as it is.
        step: one frame more, while it waits.
    """

    update: bool = False
    map: bool = False
    paused: bool | None = None
    step: bool = False

    def encode(self) -> bytes:
        """As JSON."""
        return json.dumps(vars(self)).encode()

    @classmethod
    def decode(cls, content: bytes) -> Request:
        """Reads what `encode` made."""
        return cls(**json.loads(content))


def unfinished(recording: Path, process: int) -> Path:
    """What a recording is called until it is complete, of the viewer's process of that number."""
    return recording.with_name(f".{recording.stem}.{process}.tmp{recording.suffix}")


def send(connection: Connection, message: Message) -> None:
    """Sends a message: pickled, and after it its large arrays, which are not copied for it.

    Raises:
        OSError: the other end is closed.
    """
    arrays: list[memoryview] = []

    def is_small(buffer: pickle.PickleBuffer) -> bool:
        content = buffer.raw()
        if content.nbytes >= _LARGE_BYTES:
            arrays.append(content)
        return content.nbytes < _LARGE_BYTES

    content = pickle.dumps(message, protocol=5, buffer_callback=is_small)
    connection.send_bytes(len(arrays).to_bytes(8, "little") + content)
    for array in arrays:
        connection.send_bytes(array)


def receive(connection: Connection) -> Message:
    """Receives what `send` sent; its arrays can be written to.

    Raises:
        EOFError, OSError: the other end is closed.
    """
    content = memoryview(connection.recv_bytes())
    count = int.from_bytes(content[:8], "little")
    arrays = [bytearray(connection.recv_bytes()) for _ in range(count)]
    return cast(Message, pickle.loads(content[8:], buffers=arrays))


def _number(line: Mapping[str, Any], name: str, missing: float = math.nan) -> float:
    value = line.get(name)
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else missing
