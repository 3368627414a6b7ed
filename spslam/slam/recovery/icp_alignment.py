"""Further initial poses for tracking, from projective ICP against earlier frames; needs no map."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import torch

from spslam import ops
from spslam.camera import Camera
from spslam.geometry import compose, inverse, matrix_to_pose7, pose7_to_matrix
from spslam.slam.cell_grid import CellGrid
from spslam.slam.frame_history import EarlierFrame
from spslam.slam.pixels import FramePixels, unpack_points

POINTS = 4096  # pixels of the earlier frame that are aligned
ITERATIONS = 20  # converge from 10 cm and 10 degrees; 15 do not always


class IcpAlignment:
    """Poses of one frame by ICP against earlier ones, from any initial pose."""

    def __init__(self, pixels: FramePixels, camera: Camera):
        self._pixels, self._camera = pixels, camera

    @cached_property
    def maps(self) -> tuple[torch.Tensor, torch.Tensor, ops.Intrinsics]:
        """The frame's `surface_maps`, made where they are first asked for: few doubtful frames need them."""
        return surface_maps(self._pixels, self._camera)

    def poses(self, starts: Sequence[tuple[EarlierFrame, torch.Tensor]]) -> list[torch.Tensor]:
        """Poses of the frame, each against an earlier frame: together, as a device is waited for twice.

        Args:
            starts: earlier frames, and the poses float32 [7] to begin at.

        Returns:
            float32 [7] each; that to begin at where nothing overlaps.
        """
        if not starts:
            return []
        earlier, begin = zip(*starts, strict=True)
        numbers = torch.stack([*(frame.pose for frame in earlier), *begin])
        to_world, from_frame = np.split(pose7_to_matrix(_on_host(numbers)), 2)
        to_frame = torch.from_numpy(matrix_to_pose7(compose(inverse(from_frame), to_world))).to(numbers)
        records = torch.cat([frame.records[:POINTS] for frame in earlier])
        points = unpack_points(records, self._camera).unflatten(0, (len(starts), -1))
        vertices, normals, intrinsics = self.maps
        to_frame, _, _ = ops.projective_icp(points, vertices, normals, to_frame, intrinsics, iterations=ITERATIONS)
        found = compose(to_world, inverse(pose7_to_matrix(_on_host(to_frame))))
        return list(torch.from_numpy(matrix_to_pose7(found)).to(numbers))


def _on_host(poses: torch.Tensor) -> np.ndarray:
    return poses.cpu().double().numpy()


def surface_maps(pixels: FramePixels, camera: Camera) -> tuple[torch.Tensor, torch.Tensor, ops.Intrinsics]:
    """Vertex and normal map of a frame's pixel records, with the cells of a `CellGrid`.

    A cell holds the first record in it that has a normal, so that CPU and CUDA choose the same.

    Returns:
        vertices float32 [h, w, 3] (m, camera axes; 0 where there is none), normals float32 [h, w, 3], and the
        intrinsics of the maps.
    """
    grid, records, normals = CellGrid.of(camera), pixels.records, pixels.normals
    shape, count = (grid.rows, grid.columns, 3), len(records)
    order = torch.where(normals.any(1), torch.arange(count, device=records.device), count)
    first = torch.full((grid.rows * grid.columns,), count, device=records.device)
    first.scatter_reduce_(0, grid.cells(records), order, "amin")
    points = torch.cat([unpack_points(records, camera), normals.new_zeros(1, 3)])
    normals = torch.cat([normals, normals.new_zeros(1, 3)])
    return points[first].view(shape), normals[first].view(shape), grid.intrinsics
