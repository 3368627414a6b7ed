"""A room of 7 x 3.5 x 2.6 m as a scene with about 300,000 voxel vertices, and rays of cameras inside it."""

import math

import torch

from spslam import ops
from spslam.scene.sparse_volume import SparseVolume

LOW, HIGH = (0.5, 0.25, 0.2), (7.5, 3.75, 2.8)  # m, the walls
SHELL_M = 0.1  # vertices are allocated this far from a wall
VOXEL_M = PLANE_CELL_M = 0.04
TRUNCATION_M = 0.08
INTRINSICS = ops.Intrinsics(525.0, 525.0, 319.5, 239.5)
WIDTH, HEIGHT = 640, 480
FRAMES = 200


def wall_distance(points: torch.Tensor) -> torch.Tensor:
    """Signed distance (m) of points near the walls, positive inside the room."""
    low, high = points.new_tensor(LOW), points.new_tensor(HIGH)
    return torch.minimum(points - low, high - points).amin(-1)


def make_scene(generator: torch.Generator, device: torch.device) -> ops.SceneView:
    """The room, with its signed distance in the first embedding channel and random color."""
    counts = [int(high / VOXEL_M) + 6 for high in HIGH]
    grid = torch.stack(torch.meshgrid(*[torch.arange(n) for n in counts], indexing="ij"), -1).view(-1, 3)
    volume = SparseVolume(VOXEL_M, capacity=1 << 19)
    volume.insert(grid[wall_distance(grid * VOXEL_M).abs() < SHELL_M].int())
    volume.embeddings.copy_(0.1 * torch.randn(volume.embeddings.shape, generator=generator))
    volume.embeddings[:, 0] = wall_distance(volume.voxel_coords * VOXEL_M) / TRUNCATION_M
    layout, rows = _plane_layout(counts)
    return ops.SceneView(
        hash_keys=volume.hash_keys.to(device),
        hash_values=volume.hash_values.to(device),
        corner_ids=volume.corner_ids.to(device),
        embeddings=volume.embeddings.to(device),
        geometry_params=_distance_decoder(generator).to(device),
        texels=(0.1 * torch.randn(rows, 32, generator=generator)).to(device),
        color_params=(0.2 * torch.randn(2211, generator=generator)).to(device),
        voxel_size=VOXEL_M,
        origin=(4.0, 2.0, 1.5),
        position_scale=0.25,
        plane_cell_size=PLANE_CELL_M,
        plane_layout=layout,
    )


def _plane_layout(counts: list[int]) -> tuple[list[int], int]:
    layout, rows = [], 0
    for a, b in ((0, 1), (0, 2), (1, 2)):
        layout += [rows, 0, 0, counts[a], counts[b]]
        rows += counts[a] * counts[b]
    return layout, rows


def _distance_decoder(generator: torch.Generator) -> torch.Tensor:
    """A decoder that returns tanh of the first channel, by two hidden units; the other units are unused."""
    w1, w2, w3 = (0.1 * torch.randn(shape, generator=generator) for shape in ((32, 11), (32, 32), (1, 32)))
    w1[:2] = w2[:2] = 0.0
    w1[0, 3], w1[1, 3] = 1.0, -1.0
    w2[0, 0] = w2[1, 1] = 1.0
    w3[0] = 0.0
    w3[0, :2] = torch.tensor([1.0, -1.0])
    return torch.cat([w1.flatten(), torch.zeros(32), w2.flatten(), torch.zeros(32), w3.flatten(), torch.zeros(1)])


def make_rays(generator: torch.Generator, count: int, frames: int, device: torch.device) -> ops.RayBatch:
    """`count` rays, divided evenly among cameras on an ellipse in the middle of the room that look outward."""
    poses = _poses(FRAMES)[torch.linspace(0, FRAMES - 1, frames).long()]
    ray_frames = torch.arange(count) * frames // count
    u = torch.randint(0, WIDTH, (count,), generator=generator)
    v = torch.randint(0, HEIGHT, (count,), generator=generator)
    k = INTRINSICS
    directions = torch.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, torch.ones(count)], 1)
    directions = torch.einsum("rij,rj->ri", _rotations(poses)[ray_frames], directions)
    centers = poses[ray_frames, 4:]
    walls = torch.where(directions > 0, torch.tensor(HIGH), torch.tensor(LOW))
    depth, axis = ((walls - centers) / directions).min(1)
    depth = depth + 0.005 * torch.randn(count, generator=generator)
    foreshortening = directions.gather(1, axis[:, None])[:, 0].abs() * 128
    rgb = torch.randint(0, 256, (count, 3), generator=generator)
    word2 = rgb[:, 0] | rgb[:, 1] << 8 | rgb[:, 2] << 16 | foreshortening.clamp(1, 255).long() << 24
    pixels = torch.stack([(u | v << 16).int(), depth.view(torch.int32), word2.to(torch.int32)], 1)
    return ops.RayBatch(pixels.to(device), ray_frames.int().to(device), poses.to(device), INTRINSICS)


def _poses(count: int) -> torch.Tensor:
    """[F, 7] quaternion and translation: upright cameras (y down is the room's -z) on an ellipse."""
    angle = torch.arange(count) * (2 * math.pi / count)
    # Camera z to the room's x, then a rotation about the room's z: (w, x, y, z) of the product.
    upright = torch.tensor([0.5, -0.5, 0.5, -0.5])
    w, z = torch.cos(angle / 2), torch.sin(angle / 2)
    a, b, c, d = upright
    quaternion = torch.stack([w * a - z * d, w * b - z * c, w * c + z * b, w * d + z * a], 1)
    center = torch.stack([4 + 1.5 * torch.cos(angle), 2 + 0.6 * torch.sin(angle), torch.full_like(angle, 1.5)], 1)
    return torch.cat([quaternion, center], 1)


def _rotations(poses: torch.Tensor) -> torch.Tensor:
    from experiments.compose import rotation_matrices

    return rotation_matrices(poses[:, :4])
