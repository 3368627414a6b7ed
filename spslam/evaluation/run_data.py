"""The data of a finished run when it is read again: whether it still is what the run saw, and what can't be read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import RgbdDataset, RgbdFrame, Subset
from spslam.errors import DatasetError, OutputError
from spslam.evaluation.run_output import RunOutput, match_times

# Intrinsics of one calibration agree to this, px.
_SAME_PX = 0.01


class RunData(Subset):
    """All frames of a dataset, which remembers those that can't be read.

    Attributes:
        unreadable: numbers of the frames that could not be read so far.
    """

    def __init__(self, dataset: RgbdDataset) -> None:
        super().__init__(dataset)
        self.unreadable: set[int] = set()

    def __reduce__(self) -> tuple[type[Subset], tuple[RgbdDataset]]:
        """Pickled it is all frames without a memory: what another process can't read, it leaves to this one."""
        return Subset, (self._dataset,)

    def __getitem__(self, index: int) -> RgbdFrame:
        with self._remembered(index):
            return super().__getitem__(index)

    def depth(self, index: int) -> np.ndarray:
        """As `RgbdDataset.depth`."""
        with self._remembered(index):
            return super().depth(index)

    def unreadable_in_words(self) -> list[str]:
        """One line on the frames that could not be read so far; none where there is none."""
        if not self.unreadable:
            return []
        first = self.describe(min(self.unreadable))
        left = f"can't be read and {'is' if len(self.unreadable) == 1 else 'are'} left out"
        return [f"{_frames(len(self.unreadable))} of the run {left}, the first: {first}"]

    @contextmanager
    def _remembered(self, index: int) -> Iterator[None]:
        try:
            yield
        except DatasetError:
            self.unreadable.add(index)
            raise


def data_of_run(run: RunOutput, dataset: RgbdDataset) -> tuple[RunData, list[str]]:
    """The dataset of a run, checked against what the run saved. A changed depth scale can't be seen by that.

    Args:
        run: the run.
        dataset: what its configuration reads now.

    Returns:
        The dataset, and in words how many of the frames that the run has a pose for are no longer in it.

    Raises:
        OutputError: the camera is not the run's.
    """
    if run.camera is not None and not is_same_camera(run.camera, dataset.camera):
        raise OutputError(
            f"{run.folder.path}: the data has changed since the run, whose camera was {_in_words(run.camera)}; that of "
            f"{dataset.name} is {_in_words(dataset.camera)}: restore the data, or run it again"
        )
    known = run.trajectory.timestamps[~run.trajectory.lost]
    missing = int((match_times(dataset.timestamps(), known) < 0).sum())
    if not missing:
        return RunData(dataset), []
    lost = f"{'is' if missing == 1 else 'are'} not in {dataset.name} any more"
    return RunData(dataset), [f"{missing} of {_frames(len(known))} of the run {lost}"]


def is_same_camera(one: Camera, other: Camera) -> bool:
    """Whether two cameras are one, up to what rounding of a file or of another machine changes."""
    numbers = [np.array([camera.fx, camera.fy, camera.cx, camera.cy]) for camera in (one, other)]
    sizes = [(camera.width, camera.height) for camera in (one, other)]
    return sizes[0] == sizes[1] and bool(np.abs(numbers[0] - numbers[1]).max() <= _SAME_PX)


def _in_words(camera: Camera) -> str:
    numbers = ", ".join(f"{name} {getattr(camera, name):.6g}" for name in ("fx", "fy", "cx", "cy"))
    return f"{camera.width}x{camera.height} px with {numbers}"


def _frames(count: int) -> str:
    return f"{count} frame" + ("s" if count != 1 else "")
