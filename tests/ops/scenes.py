"""A small scene that the tests of the fused ops share: a room's corner with random features and decoders."""

from typing import NamedTuple

import numpy as np
import pytest
import torch

from spslam import ops
from spslam.scene.sparse_volume import SparseVolume

VOXEL = 0.04
TRUNCATION = 0.08
INTRINSICS = ops.Intrinsics(60.0, 60.0, 31.5, 23.5)
WIDTH, HEIGHT = 64, 48
# The paper's samples and weights.
OPTIONS = ops.RenderOptions(
    num_uniform=32,
    num_surface=11,
    near=0.2,
    far=1.02,
    truncation=TRUNCATION,
    cosine_targets=True,
    weight_rgb=10.0,
    weight_depth=0.1,
    weight_free_space=20.0,
    weight_sdf=1000.0,
    seed=2**33 + 5,
    stream=ops.RandomStream.MAPPING_RAYS,
    frame=3,
    iteration=7,
)


class Backend(NamedTuple):
    """Where a fused op runs, and how its decoders multiply there."""

    device: torch.device
    precision: str


BACKENDS = [
    pytest.param(Backend(torch.device("cpu"), "fp32"), id="cpu"),
    pytest.param(Backend(torch.device("cuda"), "fp32"), id="cuda-fp32", marks=pytest.mark.cuda),
    pytest.param(Backend(torch.device("cuda"), "tf32"), id="cuda-tf32", marks=pytest.mark.cuda),
]


def look_at(center, target):
    """float64 [4, 4] pose of a camera at `center` that looks at `target`, tilted a little."""
    forward = np.subtract(target, center)
    forward /= np.linalg.norm(forward)
    right = np.cross([0.2, 1.0, -0.1], forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = center
    return pose


POSES = [
    look_at([0.02, -0.1, 0.05], [0.9, 0.5, 1.1]),
    look_at([0.1, 0.0, 0.2], [0.9, 0.4, 0.8]),
    look_at([-0.2, -0.15, 0.1], [0.8, 0.5, 1.1]),
]


def corner_sdf(points: torch.Tensor) -> torch.Tensor:
    """Signed distance (m) to the corner where the planes x = 0.9, y = 0.5 and z = 1.1 meet, free space below them."""
    return (torch.tensor([0.9, 0.5, 1.1], dtype=points.dtype, device=points.device) - points).min(-1).values


def linear_geometry_params() -> torch.Tensor:
    """Decoder whose output is tanh(feature 0 / 2), exactly: each hidden pair carries x and -x through the ReLUs."""
    w1, b1 = torch.zeros(32, 11), torch.zeros(32)
    w1[0, 3], w1[1, 3] = 1.0, -1.0
    w2, b2 = torch.eye(32), torch.zeros(32)
    w3, b3 = torch.zeros(1, 32), torch.zeros(1)
    w3[0, 0], w3[0, 1] = 0.5, -0.5
    return torch.cat([t.flatten() for t in (w1, b1, w2, b2, w3, b3)])


def make_scene(generator: torch.Generator, random_decoder: bool, device: torch.device | str = "cpu") -> ops.SceneView:
    """The corner as a scene; with `random_decoder`, features and networks are random and mean nothing."""
    grid = torch.stack(torch.meshgrid(*[torch.arange(-20, 32)] * 3, indexing="ij"), -1).reshape(-1, 3)
    sdf = corner_sdf(grid * VOXEL)
    coords = grid[sdf.abs() < 3 * VOXEL].to(torch.int32)
    volume = SparseVolume(VOXEL)
    volume.insert(coords)
    near = corner_sdf(volume.voxel_coords * VOXEL)
    volume.embeddings.copy_(0.3 * torch.randn(len(near), 8, generator=generator))
    params = 0.3 * torch.randn(1473, generator=generator)
    if not random_decoder:
        # atanh, so that the decoded value is the normalized distance itself.
        volume.embeddings[:, 0] = 2 * torch.atanh((near / (4 * VOXEL)).clamp(-0.99, 0.99)) * 2
        params = linear_geometry_params()
    sizes = [(60, 60)] * 3
    layout, offset = [], 0
    for size_u, size_v in sizes:
        layout += [offset, -25, -25, size_u, size_v]
        offset += size_u * size_v
    return ops.SceneView(
        hash_keys=volume.hash_keys.to(device),
        hash_values=volume.hash_values.to(device),
        corner_ids=volume.corner_ids.clone().to(device),
        embeddings=volume.embeddings.clone().to(device),
        geometry_params=params.to(device),
        texels=(0.3 * torch.randn(offset, 32, generator=generator)).to(device),
        color_params=(0.3 * torch.randn(2211, generator=generator)).to(device),
        voxel_size=VOXEL,
        origin=(0.1, -0.05, 0.02),
        position_scale=0.25,
        plane_cell_size=0.04,
        plane_layout=layout,
    )


def corner_pixels(pose: np.ndarray, generator: torch.Generator, count: int = 2000) -> torch.Tensor:
    """Packed records int32 [count, 3] of a camera at `pose` (float64 [4, 4]) that sees the corner exactly."""
    u = torch.randint(0, WIDTH, (count,), generator=generator)
    v = torch.randint(0, HEIGHT, (count,), generator=generator)
    rays = torch.stack([(u - INTRINSICS.cx) / INTRINSICS.fx, (v - INTRINSICS.cy) / INTRINSICS.fy, torch.ones(count)], 1)
    directions = rays.double() @ torch.from_numpy(pose[:3, :3]).T
    walls = torch.tensor([0.9, 0.5, 1.1], dtype=torch.float64) - torch.from_numpy(pose[:3, 3])
    depth = torch.where(directions > 1e-6, walls / directions, torch.inf).min(1).values.float()
    rgb = torch.randint(0, 256, (count, 3), generator=generator)
    word2 = rgb[:, 0] | rgb[:, 1] << 8 | rgb[:, 2] << 16
    return torch.stack([(u | v << 16).int(), depth.view(torch.int32), word2.int()], 1)
