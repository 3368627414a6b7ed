"""Signed distance blocks of images wider than a batch of pixels and a tile, against plain NumPy; what takes a color."""

import numpy as np
import pytest
import torch

from spslam import ops
from spslam.ops.tsdf import missing_blocks
from tests.ops.test_tsdf import IDENTITY, NOISE, VOXEL, planes_of, rays, wall
from tests.ops.threads import assert_same_for_any_threads
from tests.reference import tsdf as reference

CAMERA = ops.Intrinsics(90.0, 92.0, 74.5, 19.5)
SIZE = (41, 150)  # not a multiple of 16, of 64 or of 3
POSE = torch.tensor([1.0, 0, 0, 0, 0.31, -0.17, 0.05])
TRUNCATION = 3 * VOXEL
# As of the kernels: samples along a ray, and the least cosine at which it is followed.
SAMPLES, TOUCH_COSINE = 6, 0.3


def two_walls():
    depth = wall((0.3, -0.2, 0.93), 1.9, CAMERA, SIZE)
    depth[8:30, 40:101] = 1.2
    depth[2:5, 120:140] = 0
    return depth


def wide_planes(device="cpu"):
    return planes_of(two_walls(), device, camera=CAMERA)


def touched_by_numpy(planes, step):
    """The blocks of all samples of every step-th pixel, as a set."""
    ray = rays(CAMERA, SIZE)[::step, ::step]
    plane = planes.double().numpy()[::step, ::step]
    ray, plane = ray[plane[..., 4] > 0], plane[plane[..., 4] > 0]
    along = (plane[:, :3] * ray).sum(-1)
    reach = TRUNCATION / np.maximum(along, TOUCH_COSINE * np.linalg.norm(ray, axis=-1))
    depth = plane[:, 3] / along + np.linspace(-1, 1, SAMPLES)[:, None] * reach
    points = depth[..., None] * ray + POSE[4:].double().numpy()
    return {tuple(row) for row in np.floor(points / (8 * VOXEL)).astype(int).reshape(-1, 3)}


@pytest.mark.parametrize("step", [1, 3, 1000])
def test_touched_blocks_are_those_of_numpy(step, device):
    planes = wide_planes(device)
    call = dict(voxel_size=VOXEL, truncation=TRUNCATION, step=step)
    blocks = ops.tsdf_touched_blocks(planes, POSE.to(device), CAMERA, **call)
    got, want = {tuple(row) for row in blocks.tolist()}, touched_by_numpy(planes.cpu(), step)
    assert len(got ^ want) <= 0.01 * len(want)  # a sample may lie a rounding from a border
    assert len(want) > (100 if step < 1000 else 0)


def test_touched_blocks_have_few_repetitions():
    """So few that what follows is done in one thread."""
    planes = wide_planes()
    blocks = ops.tsdf_touched_blocks(planes, POSE, CAMERA, voxel_size=VOXEL, truncation=TRUNCATION)
    assert len(blocks) < 5 * len(blocks.unique(dim=0))


def test_a_wide_image_is_integrated_as_by_numpy(device):
    planes = wide_planes()
    blocks = ops.TsdfVolume(VOXEL, device=device)
    blocks.integrate(torch.from_numpy(two_walls()).to(device), POSE.to(device), CAMERA, noise=NOISE)
    pose = np.eye(4)
    pose[:3, 3] = POSE[4:].numpy()
    generator = np.random.default_rng(0)
    coords, image, seen, unlike = blocks.block_coords.cpu().numpy(), planes.double().numpy(), 0, 0
    sdf, weights = blocks.sdf.cpu().numpy(), blocks.weights.cpu().numpy()
    for _ in range(2000):
        block, voxel = generator.integers(len(coords)), generator.integers(512)
        point = (coords[block] * 8 + np.array([voxel // 64, voxel // 8 % 8, voxel % 8])) * VOXEL
        distance, weight, _ = reference.observe(point, image, CAMERA, pose, (TRUNCATION, 2 * VOXEL), NOISE, VOXEL)
        seen += weight > 0
        same = abs(weights[block, voxel] - weight) < 1e-3 * weight + 1e-5
        unlike += not (same and abs(sdf[block, voxel] - distance) < 2e-4)
    assert seen > 500
    assert unlike < 0.02 * 2000  # those at the border between two pixels


def test_wide_images_do_not_depend_on_the_number_of_threads():
    color = torch.randint(0, 256, (*SIZE, 3), generator=torch.Generator().manual_seed(0)).to(torch.uint8)

    def compute():
        volume = ops.TsdfVolume(VOXEL)
        for _ in range(2):
            volume.integrate(torch.from_numpy(two_walls()), POSE, CAMERA, color, NOISE)
        touched = ops.tsdf_touched_blocks(wide_planes(), POSE, CAMERA, voxel_size=VOXEL, truncation=TRUNCATION)
        return touched, volume.block_coords, volume.sdf, volume.weights, volume.colors.to(torch.int32)

    assert_same_for_any_threads(compute, (1, 2, 3))


@pytest.mark.parametrize("near_voxels", [0.5, 1.0, 2.0])
def test_colors_reach_one_and_a_half_voxels_at_any_truncation(near_voxels, device):
    """Distances are cut to the truncation, which may be shorter than that."""
    volume = ops.TsdfVolume(VOXEL, device=device, truncation=2 * VOXEL, near_truncation=near_voxels * VOXEL)
    depth, color = wall((0, 0, 1), 1.49, CAMERA, SIZE), torch.full((*SIZE, 3), 100, dtype=torch.uint8)
    volume.integrate(torch.from_numpy(depth).to(device), IDENTITY.to(device), CAMERA, color.to(device), (0.0, 0.0))
    z = (volume.block_coords[:, 2:] * 8 + torch.arange(512, device=device) % 8) * VOXEL
    in_front = ((1.49 - z) / VOXEL)[(volume.weights > 0) & (volume.colors[..., 3].to(torch.int32) > 0)]
    assert 1 < in_front.max() < 1.5
    assert in_front.min() > -min(near_voxels, 1.5)


@pytest.mark.parametrize(
    "color, error, message",
    [
        (
            torch.zeros(41, 149, 3, dtype=torch.uint8),
            ValueError,
            r"color must have shape \[41, 150, 3\], got \[41, 149",
        ),
        (torch.zeros(41, 150, 3), TypeError, "color must be uint8, got float32"),
    ],
)
def test_a_wrong_color_changes_nothing(color, error, message):
    volume = ops.TsdfVolume(VOXEL)
    with pytest.raises(error, match=f"TsdfVolume.integrate: {message}"):
        volume.integrate(torch.from_numpy(two_walls()), POSE, CAMERA, color)
    assert len(volume) == 0 and volume.nbytes == ops.TsdfVolume(VOXEL).nbytes


def test_planes_are_integrated_with_the_weights_they_are_given(device):
    depth, pose = torch.from_numpy(two_walls()).to(device), POSE.to(device)
    whole, half, room = (ops.TsdfVolume(VOXEL, device=device) for _ in range(3))
    whole.integrate(depth, pose, CAMERA, noise=NOISE)
    planes = ops.measure_planes(depth, CAMERA, NOISE)
    room.make_room(planes, pose, CAMERA, NOISE)
    planes[..., 4] *= 0.5
    half.integrate_planes(planes, pose, CAMERA, noise=NOISE)
    assert torch.equal(room.block_coords, whole.block_coords) and not room.weights.any()
    assert torch.equal(half.block_coords, whole.block_coords) and torch.equal(half.weights, 0.5 * whole.weights)
    assert torch.allclose(half.sdf, whole.sdf)


@pytest.mark.parametrize("known", [0, 7, 1000])
def test_missing_blocks_are_those_touched_that_a_table_lacks(device, known):
    planes, pose = ops.measure_planes(torch.from_numpy(two_walls()).to(device), CAMERA, NOISE), POSE.to(device)
    sizes = dict(voxel_size=VOXEL, truncation=0.1, noise=NOISE, step=1)
    touched = ops.tsdf_touched_blocks(planes, pose, CAMERA, **sizes).unique(dim=0)
    blocks = ops.VoxelHash(device=device)
    blocks.add(touched[:known])
    missing = missing_blocks("test", (blocks.hash_keys, blocks.hash_values), planes, pose, CAMERA, *sizes.values())
    assert len(touched) > 7 and torch.equal(missing.unique(dim=0), touched[known:])


def test_a_frame_of_another_device_is_named():
    volume, planes = ops.TsdfVolume(VOXEL), torch.zeros(4, 5, 5, device="meta")
    with pytest.raises(ValueError, match=r"TsdfVolume.make_room: planes must be on cpu"):
        volume.make_room(planes, POSE.to("meta"), CAMERA)
    assert len(volume) == 0
