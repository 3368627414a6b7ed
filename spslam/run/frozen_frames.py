"""Frames whose depth is frozen, told apart from the others as they come."""

from __future__ import annotations

from spslam.datasets.base import RgbdDataset
from spslam.datasets.frozen_depth import FROZEN, FrozenDepth, frozen_depth_before
from spslam.errors import DatasetError
from spslam.slam.prepared_frame import PreparedFrame


class FrozenFrames:
    """Looks at the frames of a dataset in their order.

    Args:
        dataset: the frames.
        start: position of the first one that comes.
    """

    def __init__(self, dataset: RgbdDataset, start: int) -> None:
        self._dataset, self._start = dataset, start
        self._depth: FrozenDepth | None = None

    def checked(self, item: PreparedFrame | DatasetError) -> PreparedFrame | DatasetError:
        """The next frame, or the error that its depth is frozen; one without a signature was looked at already."""
        if isinstance(item, DatasetError) or item.signature is None:
            return item
        if self._depth is None:
            self._depth = frozen_depth_before(self._dataset, self._start)
        is_frozen = self._depth.check(item.signature)
        return DatasetError(f"{self._dataset.describe(item.index)}: {FROZEN}") if is_frozen else item
