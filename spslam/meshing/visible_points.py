"""What frames see of a surface's points."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import torch

from spslam import ops
from spslam.datasets.base import RgbdFrame
from spslam.meshing.frame_fusion import PosedFrames, frame_intrinsics, on_device, poses7_on


@dataclass(frozen=True)
class KeptFrames(PosedFrames):
    """Frames of which those that are read first are kept, also by what is made of these by `dataclasses.replace`.

    Attributes:
        most: how many, but for as many more as threads read at once.
        kept: those, by their indices in the dataset.
    """

    most: int = 0
    kept: dict[int, RgbdFrame] = field(default_factory=dict)

    def __getitem__(self, position: int) -> RgbdFrame:
        index = int(self.indices[position])
        frame = self.kept.get(index)
        if frame is None:
            frame = super().__getitem__(position)
            if len(self.kept) < self.most:
                self.kept[index] = frame
        return frame


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
        for position, frame in part.read():
            images = on_device(frame.depth, device), on_device(frame.color, device)
            yield ops.see_points(surface, *images, poses[position], intrinsics, part.noise or noise)
