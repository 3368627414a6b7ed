"""What the tests of the fused step give it: rays of a few frames, and buffers for a scene's gradients."""

import numpy as np
import torch

from spslam import ops
from spslam.geometry import matrix_to_pose7
from tests.ops.scenes import INTRINSICS, POSES, corner_pixels


def noisy_rays(generator, counts=(90, 60, 57), device="cpu"):
    """Rays of a few frames, with noise on the depth, some without depth, and with all kinds of foreshortening."""
    pixels = torch.cat([corner_pixels(POSES[f], generator, n) for f, n in enumerate(counts)])
    depth = pixels[:, 1].contiguous().view(torch.float32)
    depth = depth + 0.02 * torch.randn(len(depth), generator=generator)
    depth[::19] = 0.0
    pixels[:, 1] = depth.view(torch.int32)
    foreshortening = torch.randint(0, 160, (len(pixels),), generator=generator)
    foreshortening[::3] = 0
    pixels[:, 2] |= (foreshortening << 24).to(torch.int64).to(torch.int32)
    frames = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts)).int()
    poses = torch.from_numpy(np.stack([matrix_to_pose7(p) for p in POSES[: len(counts)]])).float()
    return ops.RayBatch(pixels.to(device), frames.to(device), poses.to(device), INTRINSICS)


def gradient_buffers(scene, stamp=4, spare_rows=0):
    """Zero buffers for a scene's gradients."""
    new = scene.embeddings.new_zeros
    rows, texels = len(scene.embeddings) + spare_rows, len(scene.texels) + spare_rows
    return ops.SceneGradients(
        new(rows, 8), new(rows, dtype=torch.int32), new(texels, 32), new(texels, dtype=torch.int32), stamp
    )
