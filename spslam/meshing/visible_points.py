"""What frames see of a surface's points."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from spslam import ops
from spslam.datasets.base import RgbdFrame
from spslam.datasets.prefetch import prefetch
from spslam.errors import DatasetError
from spslam.meshing.frame_fusion import PosedFrames, frame_intrinsics, poses7_on, to_be_uploaded
from spslam.meshing.reading import reading_threads


@dataclass(frozen=True)
class KeptFrames(PosedFrames):
    """Frames of which some are kept once they were read, also by what is made of these by `dataclasses.replace`.

    Attributes:
        wanted: which are to be kept, by their indices in the dataset.
        kept: those that were read.
    """

    wanted: frozenset[int] = frozenset()
    kept: dict[int, RgbdFrame] = field(default_factory=dict)

    def __getitem__(self, position: int) -> RgbdFrame:
        index = int(self.indices[position])
        frame = self.kept.get(index)
        if frame is None:
            frame = super().__getitem__(position)
            if index in self.wanted:
                self.kept[index] = frame
        return frame

    def depth(self, position: int) -> np.ndarray:
        """As of `PosedFrames`; of a frame that is kept, its own."""
        frame = self.kept.get(int(self.indices[position]))
        return super().depth(position) if frame is None else frame.depth


def read_seen(
    surface: ops.SurfacePoints, parts: Sequence[PosedFrames], noise: tuple[float, float]
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Colors and weights of all points in every frame of all parts, in order; see `ops.see_points`.

    Args:
        surface: N points; its device is where frames are looked at.
        parts: the frames; those that can't be read are left out.
        noise: of depth where a part has none of its own, floor (m^2) and growth (1/m^2) of the variance.

    Yields:
        uint8 [N, 3] and float32 [N].
    """
    device = surface.points.device
    for part in parts:
        intrinsics, poses = frame_intrinsics(part), poses7_on(part.poses, device)
        with prefetch(_ToBeUploaded(part, device), *reading_threads(part.dataset.readers)) as frames:
            for position, images in enumerate(frames):
                if not isinstance(images, DatasetError):
                    depth, color = (image.to(device, non_blocking=True) for image in images)
                    yield ops.see_points(surface, depth, color, poses[position], intrinsics, part.noise or noise)


@dataclass(frozen=True)
class _ToBeUploaded:
    """Depth and color of frames, as the threads that read leave them.

    Attributes:
        part: the frames.
        device: where they are to be uploaded to.
    """

    part: PosedFrames
    device: torch.device

    def __len__(self) -> int:
        return len(self.part)

    def __getitem__(self, position: int) -> tuple[torch.Tensor, torch.Tensor]:
        frame = self.part.covered(self.part[position])
        return to_be_uploaded(frame.depth, self.device), to_be_uploaded(frame.color, self.device)
