"""Which frames see what the current one sees, and which frames a mapping call optimises (section III.D)."""

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.slam.pixels import LATTICE_STEP_PX

POINTS = 256
AGREEMENT_M = 0.1
MIN_DEPTH_M = 0.05


def overlap(
    points: torch.Tensor, rotations: torch.Tensor, centers: torch.Tensor, lattices: torch.Tensor, camera: Camera
):
    """Share of world points that fall in each frame's view and agree with its depth.

    Args:
        points: float32 [N, 3], m.
        rotations: float32 [F, 3, 3] camera to world.
        centers: float32 [F, 3] camera centres, m.
        lattices: float16 [F, h, w] depth (m) at every `LATTICE_STEP_PX`-th pixel.
        camera: intrinsics of the full image.

    Returns:
        float32 [F] in [0, 1].
    """
    local = torch.einsum("fji,fnj->fni", rotations, points[None] - centers[:, None])
    z = local[..., 2]
    safe = z.clamp_min(MIN_DEPTH_M)
    height, width = lattices.shape[1:]
    column = ((local[..., 0] / safe * camera.fx + camera.cx) / LATTICE_STEP_PX).floor().long()
    row = ((local[..., 1] / safe * camera.fy + camera.cy) / LATTICE_STEP_PX).floor().long()
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (z > MIN_DEPTH_M)
    cell = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    seen = lattices.flatten(1).float().gather(1, cell)
    return (inside & (seen > 0) & ((seen - z).abs() < AGREEMENT_M)).float().mean(1)


def select_frames(
    points: torch.Tensor,
    rotations: torch.Tensor,
    centers: torch.Tensor,
    lattices: torch.Tensor,
    usable: torch.Tensor,
    camera: Camera,
    config: Config,
) -> torch.Tensor:
    """Frames of a mapping call: the most recent, some of the co-visible, and some of all others.

    Args:
        points: float32 [N, 3] surface points of the newest frame, world, m.
        rotations, centers, lattices: of all F frames, as in `overlap`.
        usable: bool [F] frames that have pixels and a pose.
        camera: intrinsics.
        config: `mapping.frames`, `recent`, `covisible`, `covisibility_threshold`.

    Returns:
        int64 [n] ascending frame indices, n at most `mapping.frames`, the newest always in. Drawn by Philox, keyed by
        the newest frame's index.
    """
    usable_ids = usable.nonzero()[:, 0]
    mapping, newest = config.mapping, len(rotations) - 1
    if len(usable_ids) <= mapping.frames:
        return usable_ids
    recent, older = usable_ids[-mapping.recent :], usable_ids[: -mapping.recent]
    order = ops.philox_uniform(config.seed, ops.Stream.FRAME_SELECTION, newest, 0, newest + 1)
    shuffled = older[order[older].argsort(stable=True)]
    share = overlap(points, rotations[shuffled], centers[shuffled], lattices[shuffled], camera).cpu()
    is_covisible = share > mapping.covisibility_threshold
    covisible = shuffled[is_covisible][: mapping.covisible]
    rest = shuffled[~torch.isin(shuffled, covisible)]
    others = rest[: mapping.frames - len(recent) - len(covisible)]
    return torch.cat([recent, covisible, others]).sort().values
