"""What watches a run while it goes on, such as the viewer. Results are the same with an observer and without."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from spslam.camera import Camera
from spslam.config import Config
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.run.request import RunRequest
from spslam.slam.frame_report import FrameReport
from spslam.slam.state import SlamState


@dataclass(frozen=True)
class ObservedRun:
    """What is known of a run before its first frame.

    Attributes:
        name: of the sequence.
        config: all options.
        camera: intrinsics of the frames.
        total: number of frames; None where it is not known, as with a live camera.
        data_dir: folder of the dataset; None for generated data.
        frames: which frames of the dataset; None for all.
        can_read: whether `config.dataset`, `data_dir` and `frames` lead to the frames, so that an observer can read
            them again; where not, `RunObserver.observe` is given them.
        can_pause: whether the run asks `RunObserver.is_paused`; a live one does not, as its camera goes on.
        ground_truth: float64 [N, 4, 4] T_world_camera by the frames' `index`, NaN where unknown; None if there is none.
        log: of the frames that an interrupted run had processed before.
    """

    name: str
    config: Config
    camera: Camera
    total: int | None = None
    data_dir: Path | None = None
    frames: slice | None = None
    can_read: bool = False
    can_pause: bool = True
    ground_truth: np.ndarray | None = None
    log: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def of(cls, request: RunRequest, dataset: RgbdDataset, log: list[dict[str, Any]]) -> ObservedRun:
        """The run that a request asks for."""
        return cls(
            dataset.name,
            request.config,
            dataset.camera,
            len(dataset),
            request.data_dir,
            request.frames,
            can_read=True,
            ground_truth=dataset.poses(),
            log=log,
        )


class RunObserver:
    """Does nothing; derive from it. The methods are called on the thread of the frame loop, which waits for them.

    A method must neither change the state nor raise.
    """

    def begin(self, run: ObservedRun, state: SlamState) -> None:
        """Before the first frame.

        Args:
            run: what is known of it.
            state: of the system; later calls read its present content.
        """

    def observe(self, report: FrameReport, frame: RgbdFrame | None = None) -> None:
        """After each processed frame, in order.

        Args:
            report: of the frame.
            frame: its images, where the observer can't read them again by itself; it must not keep them.
        """

    def is_paused(self) -> bool:
        """Whether the run should wait before the next frame."""
        return False

    def wait(self, is_interrupted: Callable[[], bool]) -> float:
        """Waits while the run is paused, until the next step is wanted or `is_interrupted()`.

        Returns:
            Seconds waited, to be left out of the run's time.
        """
        return 0.0

    def finish(self) -> None:
        """After the last frame and the last optimization."""
