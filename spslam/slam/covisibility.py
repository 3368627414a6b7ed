"""Which frames see what the current one sees, and which frames a mapping call optimises (section III.D)."""

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.slam.pixels import LATTICE_STEP_PX

POINTS = 256
AGREEMENT_M = 0.1
MIN_DEPTH_M = 0.05
FRAMES_AT_ONCE = 128


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
    local = rotations.transpose(1, 2) @ (points.T - centers[:, :, None])  # [F, 3, N], so that x, y and z are contiguous
    x, y, z = local.unbind(1)
    safe = z.clamp_min(MIN_DEPTH_M)
    height, width = lattices.shape[1:]
    column = ((x / safe * camera.fx + camera.cx) / LATTICE_STEP_PX).floor()
    row = ((y / safe * camera.fy + camera.cy) / LATTICE_STEP_PX).floor()
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (z > MIN_DEPTH_M)
    cell = (row.clamp(0, height - 1) * width + column.clamp(0, width - 1)).long()
    seen = lattices.flatten(1).gather(1, cell).float()
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
        points: float32 [N, 3] surface points of the newest usable frame, world, m.
        rotations, centers, lattices: of all F frames, as in `overlap`.
        usable: bool [F] on the CPU, frames that have pixels and a pose.
        camera: intrinsics.
        config: `mapping.frames`, `recent`, `covisible`, `covisibility_threshold`.

    Returns:
        int64 [n] ascending frame indices, n at most `mapping.frames`, the newest usable one always in. Drawn by
        Philox, keyed by the newest frame's number.
    """
    usable_ids = usable.nonzero()[:, 0]
    mapping, newest = config.mapping, len(rotations) - 1
    if len(usable_ids) <= mapping.frames:
        return usable_ids
    recent, older = usable_ids[-mapping.recent :], usable_ids[: -mapping.recent]
    order = ops.philox_uniform(config.seed, ops.Stream.FRAME_SELECTION, newest, 0, newest + 1)
    shuffled = older[order[older].argsort(stable=True)]
    covisible = _first_covisible(shuffled, points, rotations, centers, lattices, camera, config)
    rest = shuffled[~torch.isin(shuffled, covisible)]
    others = rest[: mapping.frames - len(recent) - len(covisible)]
    return torch.cat([recent, covisible, others]).sort().values


def _first_covisible(
    shuffled: torch.Tensor,
    points: torch.Tensor,
    rotations: torch.Tensor,
    centers: torch.Tensor,
    lattices: torch.Tensor,
    camera: Camera,
    config: Config,
) -> torch.Tensor:
    """The first `mapping.covisible` of the shuffled frames that are; looks no further, as all would take long."""
    wanted, found = config.mapping.covisible, [shuffled[:0]]
    for some in shuffled.split(FRAMES_AT_ONCE):
        if sum(map(len, found)) >= wanted:
            break
        at = some.to(rotations.device)
        share = overlap(points, rotations[at], centers[at], lattices[at], camera).cpu()
        found.append(some[share > config.mapping.covisibility_threshold])
    return torch.cat(found)[:wanted]
