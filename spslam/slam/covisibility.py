"""Which frames a mapping call optimizes (section III.D)."""

import numpy as np
import torch

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.slam.pixels import THUMBNAIL_STEP_PX

POINTS = 256


def select_frames(
    records: torch.Tensor,
    poses: torch.Tensor,
    depth_thumbnails: torch.Tensor,
    usable: torch.Tensor,
    camera: Camera,
    config: Config,
) -> torch.Tensor:
    """Frames of a mapping call: the most recent, some of the co-visible, and some of all others.

    Waits for nothing on the device: how many there will be follows from `usable`.

    Args:
        records: int32 [F, P, 3] packed pixels of all frames.
        poses: float32 [F, 7].
        depth_thumbnails: float16 [F, h, w] depth (m) at every `THUMBNAIL_STEP_PX`-th pixel.
        usable: bool [F] on the CPU, frames that have pixels and a pose.
        camera: intrinsics.
        config: `mapping.frames`, `recent`, `covisible`, `covisibility_threshold`.

    Returns:
        int64 [n] ascending frame indices on the device of `poses`, n at most `mapping.frames`, the newest usable one
        always in. Drawn by Philox, keyed by the newest frame's number; the same on every device.
    """
    usable_ids = np.flatnonzero(usable.numpy())
    mapping, newest, device = config.mapping, len(poses) - 1, poses.device
    if len(usable_ids) <= mapping.frames:
        return torch.from_numpy(usable_ids).to(device, non_blocking=True)
    recent, older = usable_ids[-mapping.recent :], usable_ids[: -mapping.recent]
    order = ops.philox_uniform(config.seed, ops.RandomStream.FRAME_SELECTION, newest, 0, newest + 1).numpy()
    shuffled = older[order[older].argsort(kind="stable")]
    current = int(usable_ids[-1])
    chosen = ops.select_covisible_frames(
        records[current],
        current,
        poses,
        depth_thumbnails,
        torch.from_numpy(shuffled).to(device, non_blocking=True),
        ops.Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy),
        thumbnail_step=THUMBNAIL_STEP_PX,
        num_points=POINTS,
        num_covisible=mapping.covisible,
        count=mapping.frames - len(recent),
        threshold=mapping.covisibility_threshold,
        seed=config.seed,
        frame=newest,
    )
    # Every recent frame comes after every older one.
    return torch.cat([chosen, torch.from_numpy(recent).to(device, non_blocking=True)])
