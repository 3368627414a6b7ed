"""Which frames see what another one sees. Not differentiable.

A frame sees a world point if the point projects into a cell of its depth thumbnail and lies within 0.1 m of the depth
there. Computed in float64, so that CPU and CUDA agree.
"""

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._checks import check, check_count, check_key, check_tensor
from spslam.ops._public import public_op
from spslam.ops.ray_sampling import RandomStream
from spslam.ops.scene_view import Intrinsics, check_intrinsics


@public_op(as_given=("depth_thumbnails",))
def frame_overlap(
    points: torch.Tensor,
    poses: torch.Tensor,
    depth_thumbnails: torch.Tensor,
    intrinsics: Intrinsics,
    thumbnail_step: int,
) -> torch.Tensor:
    """Share of world points that each frame sees.

    Args:
        points: float32 [N, 3], m.
        poses: float32 [F, 7] T_world_camera, quaternion (w, x, y, z) and translation (m).
        depth_thumbnails: float16 [F, h, w] depth (m) of the frames at every `thumbnail_step`-th pixel, the first in the
            middle of the first cell; 0 where unknown.
        intrinsics: of the whole image.
        thumbnail_step: side of a depth thumbnail's cell, px.

    Returns:
        float32 [F] in [0, 1]; 0 where N = 0 and for a pose that is not finite. Points and depths that are not are not
        seen. The same on every device.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or a step below 1.

    Example:
        >>> poses = torch.tensor([[1.0, 0, 0, 0, 0, 0, 0], [0.0, 0, 1, 0, 0, 0, 0]])  # forward, and turned back
        >>> depth, camera = torch.full((2, 6, 8), 2.0, dtype=torch.float16), Intrinsics(100, 100, 63.5, 47.5)
        >>> frame_overlap(torch.tensor([[0.1, 0.2, 2.0]]), poses, depth, camera, 16)
        tensor([1., 0.])
    """
    name = "frame_overlap"
    check_tensor(name, "points", points, ("N", 3), torch.float32)
    _check_frames(name, poses, depth_thumbnails, intrinsics, thumbnail_step, like=points)
    return torch.ops.spslam.frame_overlap(points, poses, depth_thumbnails, list(intrinsics), thumbnail_step)


@public_op(as_given=("depth_thumbnails",))
def select_covisible_frames(
    records: torch.Tensor,
    current: int,
    poses: torch.Tensor,
    depth_thumbnails: torch.Tensor,
    candidates: torch.Tensor,
    intrinsics: Intrinsics,
    *,
    thumbnail_step: int,
    num_points: int,
    num_covisible: int,
    count: int,
    threshold: float,
    seed: int,
    frame: int,
) -> torch.Tensor:
    """Chooses frames: first of the candidates that are co-visible with the current one, then of all others.

    `num_points` pixels of the current frame are drawn by Philox; a candidate that sees more than the share `threshold`
    of them is co-visible. The first `num_covisible` co-visible candidates are taken, and then the first of the rest
    until there are `count`. Nothing is read back to the host.

    Args:
        records: int32 [P, 3] packed pixels of the current frame, P >= 1.
        current: its row.
        poses, depth_thumbnails, intrinsics, thumbnail_step: of all F frames, as in `frame_overlap`.
        candidates: int64 [M] different rows in [0, F), in order of preference, M at most F.
        num_points: how many are drawn, with replacement.
        num_covisible: most frames taken for being co-visible.
        count: how many frames to take; all candidates where there are fewer.
        threshold: share of the points.
        seed, frame: keys of the draw, with `RandomStream.COVISIBILITY`.

    Returns:
        int64 [min(count, M)] rows in ascending order; the same on every device. Candidates that are no rows, or come
        twice, leave -1 at the end.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or a number out of range.

    Example:
        >>> poses = torch.tensor([[1.0, 0, 0, 0, 0, 0, 0], [0.0, 0, 1, 0, 0, 0, 0]]).repeat(3, 1)  # every other one
        >>> thumbnails = torch.full((6, 6, 8), 2.0, dtype=torch.float16)  # looks back
        >>> depth = torch.full((1,), 2.0).view(torch.int32)
        >>> record = torch.stack([torch.tensor([60 | 40 << 16], dtype=torch.int32), depth, 0 * depth], 1)
        >>> select_covisible_frames(
        ...     record, 0, poses, thumbnails, torch.arange(1, 6), Intrinsics(100, 100, 63.5, 47.5), thumbnail_step=16,
        ...     num_points=10, num_covisible=2, count=3, threshold=0.1, seed=0, frame=0)
        tensor([1, 2, 4])
    """
    name = "select_covisible_frames"
    check_tensor(name, "records", records, ("P", 3), torch.int32)
    check(len(records) > 0, name, "records", "have at least one row", 0)
    _check_frames(name, poses, depth_thumbnails, intrinsics, thumbnail_step, like=records)
    check(0 <= current < len(poses), name, "current", f"be a row of the {len(poses)} poses", current)
    check_tensor(name, "candidates", candidates, ("M",), torch.int64, like=records)
    check(len(candidates) <= len(poses), name, "candidates", f"be at most {len(poses)} rows", len(candidates))
    check_count(name, "num_points", num_points, least=0)
    for argument, number in (("num_covisible", num_covisible), ("count", count)):
        check(number >= 0, name, argument, "be at least 0", number)
    check(0 <= threshold <= 1, name, "threshold", "be in [0, 1]", threshold)
    check_key(name, frame)
    # The enum Integer in csrc/bindings/covisibility.cpp.
    counts = [num_points, num_covisible, count]
    integers = [current, thumbnail_step, *counts, seed, int(RandomStream.COVISIBILITY), frame]
    return torch.ops.spslam.select_covisible_frames(
        records, poses, depth_thumbnails, candidates, list(intrinsics), threshold, integers
    )


_COUNT = 4  # among the integers


def _check_frames(
    name: str,
    poses: torch.Tensor,
    depth_thumbnails: torch.Tensor,
    intrinsics: Intrinsics,
    step: int,
    like: torch.Tensor,
) -> None:
    check_tensor(name, "poses", poses, ("F", 7), torch.float32, like=like)
    check_tensor(name, "depth_thumbnails", depth_thumbnails, (len(poses), "h", "w"), torch.float16, like=like)
    check_intrinsics(name, intrinsics)
    check(step >= 1, name, "thumbnail_step", "be at least 1", step)


@torch.library.register_fake("spslam::frame_overlap")
def _(points, poses, depth_thumbnails, intrinsics, thumbnail_step):
    return points.new_empty(poses.shape[0])


@torch.library.register_fake("spslam::select_covisible_frames")
def _(records, poses, depth_thumbnails, candidates, intrinsics, threshold, integers):
    return candidates.new_empty(min(integers[_COUNT], candidates.shape[0]))
