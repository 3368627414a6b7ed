"""What a live camera is: a pinhole camera and an iterator over its frames."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import RgbdFrame
from spslam.errors import DatasetError


@dataclass(frozen=True)
class LiveFrame:
    """A frame and when its images were complete, from where its latency counts.

    Attributes:
        frame: color, depth, timestamp.
        complete_s: `time.monotonic()` of that moment.
    """

    frame: RgbdFrame
    complete_s: float


class LiveSource(ABC):
    """A camera whose frames come by themselves. Two attributes and one method make one.

    Attributes:
        name: what messages and reports call it.
        camera: pinhole intrinsics of all frames.
        depth_scale: units per meter in which `--record` stores depth.
        dropped: frames that the source itself had to leave out; it counts them.
        ground_truth: float64 [N, 4, 4] T_world_camera of all frames that will come, in order, where they are known
            beforehand; a viewer shows them. Metrics take `RgbdFrame.pose`.

    Example:
        >>> class MyCamera(LiveSource):
        ...     name, camera = "my camera", Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
        ...     def frames(self):
        ...         while True:
        ...             color, depth = grab()       # blocks until the next images are there
        ...             yield RgbdFrame.from_arrays(color, depth, time.time(), depth_scale=1000)
    """

    name: str
    camera: Camera
    depth_scale: float = 1000.0
    dropped: int = 0
    ground_truth: np.ndarray | None = None

    @abstractmethod
    def frames(self) -> Iterator[RgbdFrame | LiveFrame | DatasetError | None]:
        """Yields each frame as soon as it is there, and ends when no more will come.

        It is called once, and iterated on a thread of its own. What it yields:

        - `RgbdFrame`: complete at this moment;
        - `LiveFrame`: complete at an earlier moment, if work was done since, such as decoding or registration;
        - `DatasetError`: a frame that can't be used; it is noted and left out;
        - None: nothing came for a while. A source that waits for its camera does so about once per second, so that
          Ctrl-C can end it.

        A frame's arrays are copied before the next frame is asked for, so they may be written again then.

        An exception that it raises ends the run, after the results of the frames before are written.
        """

    def close(self) -> None:  # noqa: B027 (most sources have nothing to release)
        """Releases the camera; called once, when `frames` is no longer iterated."""
