"""Videos as image streams, decoded by PyAV (FFmpeg): frames by number, in order as fast as the decoder is."""

from __future__ import annotations

import contextlib
import functools
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spslam.datasets.base import MAX_FRAMES
from spslam.datasets.images import Size, check_image_size, depth_in_meters
from spslam.datasets.recording import ImageStream
from spslam.datasets.sequential import SequentialItems
from spslam.errors import DatasetError, brief
from spslam.reading import open_regular

VIDEO_SUFFIXES = (".mp4", ".mkv", ".mov", ".avi", ".webm", ".m4v")
# More keep the cores of a run busy with one image at a time.
_DECODER_THREADS = 2


@dataclass(frozen=True)
class VideoIndex:
    """The frames of a video track.

    Attributes:
        stamps: int64 [N], presentation times in the track's unit, ascending.
        seconds: float64 [N], s.
        size: (width, height).
        title: of the track, as its metadata has it.
    """

    stamps: np.ndarray
    seconds: np.ndarray
    size: Size
    title: str


class VideoStream(ImageStream):
    """Color or depth images of a video track.

    A rotation noted in the file is ignored: the depth images beside it aren't rotated either.

    Args:
        path: of the video.
        track: number of the video track, from 0.
        is_depth: whether frames are depth images of 16 bits.
        units_per_meter: of depth.
        seconds: times of the frames, float64 [N]; those of the video if None.

    Raises:
        DatasetError: PyAV is not installed, or there is no such track, or it can't be read, or it has B-frames in AVI.
    """

    def __init__(
        self,
        path: Path,
        track: int = 0,
        is_depth: bool = False,
        units_per_meter: float | None = None,
        seconds: np.ndarray | None = None,
    ) -> None:
        self.index = video_index(path, track)
        self._path, self._track = path, track
        self._is_depth, self._units = is_depth, units_per_meter
        self._seconds = self.index.seconds if seconds is None else seconds
        # A function of the module, not of this object: no cycle keeps the decoder when the stream is dropped.
        self._frames = SequentialItems(functools.partial(_decoded, path, track, self.index.stamps))

    def __len__(self) -> int:
        return len(self._seconds)

    def times(self) -> np.ndarray:
        return self._seconds.copy()

    def read(self, number: int) -> np.ndarray:
        name = self.describe(number)
        frame = self._frames.take(number, name)
        with explained(self._path):
            if self._is_depth:
                stored = frame.to_ndarray(format="gray16le")
                return depth_in_meters(stored, self._units)
            return frame.to_ndarray(format="rgb24")

    def describe(self, number: int) -> str:
        track = f", track {self._track}" if self._track else ""
        return f"{self._path}{track}, frame {number}"


def _decoded(path: Path, track: int, stamps: np.ndarray, number: int) -> Iterator[tuple[int, Any]]:
    """Frames from the key frame at or before a number on."""
    numbers = {int(stamp): place for place, stamp in enumerate(stamps)}
    with explained(path), open_video(path) as container:
        stream = container.streams.video[track]
        stream.thread_type, stream.codec_context.thread_count = "AUTO", _DECODER_THREADS
        container.seek(int(stamps[number]), stream=stream, backward=True)
        for frame in container.decode(stream):
            place = numbers.get(frame.pts) if frame.pts is not None else None
            if place is not None:
                yield place, frame


def video_index(path: Path, track: int = 0) -> VideoIndex:
    """The frames of a video track; read once per process for a file that does not change."""
    open_regular(path, DatasetError).close()
    return _cached_index(path, track, (path.stat().st_mtime_ns, path.stat().st_size))


@functools.lru_cache(maxsize=8)
def _cached_index(path: Path, track: int, state: tuple) -> VideoIndex:
    with explained(path), open_video(path) as container:
        if track >= len(container.streams.video):
            raise DatasetError(f"{path}: must have a video track {track}, got {len(container.streams.video)} of them")
        stream = container.streams.video[track]
        size = stream.codec_context.width, stream.codec_context.height
        check_image_size(size, str(path))
        # AVI has no presentation times, and those that FFmpeg guesses of B-frames give a number another frame's image.
        # They are no better in a copy of the stream in another container.
        if container.format.name == "avi" and stream.codec_context.has_b_frames:
            raise DatasetError(
                f"{path}: an AVI file with B-frames lacks the times of its frames; write another file in its place: "
                f"ffmpeg -i {shlex.quote(path.name)} -c:v ffv1 {shlex.quote(path.stem + '.mkv')}"
            )
        stamps = sorted(_stamps(container, stream, path))
        if not stamps:
            raise DatasetError(f"{path}: must contain frames, got none")
        unique = np.unique(np.array(stamps, dtype=np.int64))
        title = stream.metadata.get("title", "")
        return VideoIndex(unique, unique * float(stream.time_base), size, title)


def _stamps(container: Any, stream: Any, path: Path) -> list[int]:
    """Presentation times of all packets; nothing is decoded."""
    stamps = []
    for packet in container.demux(stream):
        if packet.pts is not None and packet.size and not packet.is_discard:
            stamps.append(int(packet.pts))
        if len(stamps) > MAX_FRAMES:
            raise DatasetError(f"{path}: a video must have at most {MAX_FRAMES} frames")
    return stamps


def open_video(path: Path) -> Any:
    """The container of a video file, to be used in a `with` block; raises DatasetError where PyAV is missing."""
    return import_av(path).open(str(path))


def import_av(path: Path) -> Any:
    """The module `av`; raises DatasetError, which names the file that needs it, where it is not installed."""
    try:
        import av
    except ImportError:
        raise DatasetError(f"{path}: videos need PyAV: pip install 'spslam[video]'") from None
    # What FFmpeg has to say about damaged files comes as errors. With a level, PyAV's callback takes Python's lock,
    # which the thread that closes a file holds while it waits for decoding threads: these wait in vain to complain.
    av.logging.set_level(None)
    return av


@contextlib.contextmanager
def explained(path: Path) -> Iterator[None]:
    """Turns whatever PyAV raises on a damaged file into one line."""
    try:
        yield
    except (DatasetError, GeneratorExit):
        raise
    except Exception as error:
        raise DatasetError(f"{path}: can't be read as a video: {brief(str(error) or type(error).__name__)}") from error
