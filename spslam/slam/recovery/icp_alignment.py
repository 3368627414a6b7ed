"""Further initial poses for tracking, from projective ICP against earlier frames; needs no map."""

from functools import cached_property

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.geometry import compose, inverse
from spslam.slam.cell_grid import CellGrid
from spslam.slam.frame_history import EarlierFrame
from spslam.slam.pixels import FramePixels, unpack_points
from spslam.slam.poses import pose_matrix, pose_tensor

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

    def pose(self, earlier: EarlierFrame, start: torch.Tensor) -> torch.Tensor:
        """Pose float32 [7] of the frame, found from `start` float32 [7]; `start` itself where nothing overlaps."""
        earlier_to_world = pose_matrix(earlier.pose)
        earlier_to_frame = pose_tensor(compose(inverse(pose_matrix(start)), earlier_to_world), start.device)
        points = unpack_points(earlier.records[:POINTS], self._camera)
        vertices, normals, intrinsics = self.maps
        earlier_to_frame, _, _ = ops.projective_icp(
            points, vertices, normals, earlier_to_frame, intrinsics, iterations=ITERATIONS
        )
        return pose_tensor(compose(earlier_to_world, inverse(pose_matrix(earlier_to_frame))), start.device)


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
