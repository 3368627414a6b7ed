"""Meshes fused from frames: against a place that is known exactly, within a budget, and with a map filling in."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from spslam import ops
from spslam.datasets.base import RgbdFrame
from spslam.datasets.generated import GeneratedDataset
from spslam.errors import DatasetError, SpslamError
from spslam.geometry import matrix_to_pose7
from spslam.meshing.frame_fusion import FusionOptions, PosedFrames, fuse_frames
from spslam.meshing.fused_mesh import extract_fused_mesh
from spslam.ops.tsdf_volume import march_blocks
from tests.meshing.test_extract_mesh import CAMERA, _looking, _scene, _slab

EXACT = (1e-8, 0.0)
VOXEL_M = 0.02


@pytest.fixture(scope="module")
def room():
    dataset = GeneratedDataset(frames=6, width=160, height=120)
    return PosedFrames(dataset, np.arange(6), dataset.poses())


def fused(frames, voxel_size_m=VOXEL_M, memory_mb=500, **more):
    return fuse_frames(frames, FusionOptions(voxel_size_m, memory_mb, EXACT), **more)


def test_the_mesh_lies_on_the_surface(room):
    mesh = extract_fused_mesh(fused(room))
    assert len(mesh.faces) > 20_000
    distance = room.dataset.surface.distance(mesh.vertices.astype(np.float64))
    assert np.mean(distance) < 0.004 and np.mean(distance < 0.01) > 0.95
    assert (mesh.colors.std(0) > 5).all()


def test_the_same_frames_give_the_same_mesh(room):
    one, two = (extract_fused_mesh(fused(room)) for _ in range(2))
    assert all(np.array_equal(getattr(one, name), getattr(two, name)) for name in vars(one))


def test_larger_voxels_where_memory_is_short(room):
    wanted = fused(room)
    needed_mb = len(wanted) * (512 * 16 + 100) / 2**20
    volume = fused(room, memory_mb=max(int(0.7 * needed_mb), 1))
    assert volume.voxel_size == pytest.approx(VOXEL_M * 1.5)
    assert len(volume) <= 0.7 * len(wanted)
    with pytest.raises(SpslamError, match="mesh.max_memory_mb allows more"):
        fuse_frames(_Far(), FusionOptions(0.01, 1, EXACT))


class _Far(PosedFrames):
    """Surface too large for one megabyte of voxels of any size that is tried."""

    def __init__(self):
        dataset = GeneratedDataset(frames=1, width=160, height=120)
        super().__init__(dataset, np.arange(1), np.eye(4)[None])

    def __getitem__(self, position):
        frame = self.dataset[position]
        # Of 9 m and of 9 km at once.
        depth = np.where(np.indices(frame.depth.shape).sum(0) // 8 % 2, 9e3, 5e3).astype(np.float32)
        return RgbdFrame(0, 0.0, frame.color, depth)


def test_frames_that_cannot_be_read_are_left_out(room):
    class Broken(GeneratedDataset):
        def read(self, index):
            if index == 2:
                raise DatasetError("frame 2 is broken")
            return super().read(index)

    broken = PosedFrames(Broken(frames=6, width=160, height=120), room.indices, room.poses)
    kept = np.array([0, 1, 3, 4, 5])
    without = PosedFrames(room.dataset, kept, room.poses[kept])
    volumes = fused(broken), fused(without)
    assert torch.equal(*(volume.sdf for volume in volumes)) and [volume.integrated for volume in volumes] == [5, 5]


def test_colors_of_every_third_frame(room):
    """Counted through two parts; depth counts as ever, and no color of the other frames is read."""

    class Counted(GeneratedDataset):
        def __getitem__(self, index):
            whole.append(index)
            return super().__getitem__(index)

    whole = []
    dataset = Counted(frames=6, width=160, height=120)
    parts = [PosedFrames(dataset, room.indices[rows], room.poses[rows]) for rows in (slice(4), slice(4, None))]
    thinned = fuse_frames(parts, FusionOptions(VOXEL_M, 500, EXACT, color_every=3))
    assert sorted(whole) == [0, 3]
    every, those = fused(room), fused(PosedFrames(dataset, room.indices[[0, 3]], room.poses[[0, 3]]))
    assert torch.equal(thinned.sdf, every.sdf)
    rows = thinned.blocks.find(those.block_coords).long()
    assert torch.equal(thinned.colors[rows], those.colors)
    assert (thinned.colors.sum() > 0) and (thinned.colors != every.colors).any()


def test_little_of_ramps_between_surfaces_stays(room):
    class Smoothed(GeneratedDataset):
        def read(self, index):
            frame = super().read(index)
            return replace(frame, depth=cv2.GaussianBlur(frame.depth, (0, 0), 1.2))

    smoothed = PosedFrames(Smoothed(frames=6, width=160, height=120), room.indices, room.poses)
    far = []
    for noise in ((1e-8, 0.0), (4e-6, 1e-6)):
        mesh = extract_fused_mesh(fuse_frames(smoothed, FusionOptions(VOXEL_M, 500, noise)))
        distance = room.dataset.surface.distance(mesh.vertices.astype(np.float64))
        far.append(np.mean(distance > 0.05))
    assert max(far) < 0.06  # with them 0.18 and 0.20


def test_little_of_flying_pixels_stays():
    """A box before a wall, with pixels at its edges that lie between the two; one frame sees past it."""
    wall = np.full((96, 128), np.float32(2.0))
    box = wall.copy()
    box[30:70, 20:100] = 1.0
    views = _Views(*[cv2.GaussianBlur(box, (3, 3), 0.6)] * 10, wall)
    depth = extract_fused_mesh(fuse_frames(views, FusionOptions(0.01, 500, (4e-6, 1e-6))), min_part_m2=0).vertices[:, 2]
    assert (np.abs(depth - 1) < 0.02).sum() > 1000
    assert not ((depth > 1.1) & (depth < 1.9)).any()  # 2 % of them where these pixels count as others


class _Views(PosedFrames):
    """Depth images from one place."""

    def __init__(self, *depths):
        dataset = GeneratedDataset(frames=1, width=128, height=96)
        super().__init__(dataset, np.arange(len(depths)), np.tile(np.eye(4), (len(depths), 1, 1)))
        object.__setattr__(self, "depths", depths)

    def depth(self, position):
        return self.depths[position]

    def __getitem__(self, position):
        depth = self.depth(position)
        return RgbdFrame(position, float(position), np.zeros((*depth.shape, 3), np.uint8), depth)


@pytest.mark.parametrize(
    ("before", "behind", "weight", "stays"),
    [
        (1.5, 1.5, 1.0, False),
        (1.5, 0.9, 1.0, True),  # not deep
        (0.4, 1.5, 1.0, True),  # no larger change than the truncation
        (1.5, 1.5, 2.0, True),  # many views agree
        (1.5, 1.5, 0.05, True),  # within the noise of a mean
        (1.5, 1.9, 0.05, False),
    ],
)
def test_no_fringe_goes_on_between_voxels_that_measured_different_surfaces(before, behind, weight, stays):
    """A floor that was seen often; in the air above it, voxels before and behind nothing, in voxels from it."""
    mesh = extract_fused_mesh(_floor_and_fringe(before, behind, weight), min_part_m2=0)
    above = mesh.vertices[:, 2] > 0.03
    assert (~above).sum() == 16 * 16
    assert above.sum() == (9 * 16 if stays else 0)


def _floor_and_fringe(before, behind, weight, weight_at_ends=None):
    """16 x 16 x 16 voxels of 1 cm: a floor at z = 1.5, and from z = 7 on what is before x = 7.5 is behind a surface."""
    volume = ops.TsdfVolume(0.01)
    volume.add_blocks(torch.cartesian_prod(*[torch.arange(2, dtype=torch.int32)] * 3))
    local = torch.cartesian_prod(*[torch.arange(8)] * 3)
    x, y, z = (volume.block_coords[:, None] * 8 + local[None]).unbind(-1)
    upper = torch.where(x < 8, -behind, before)
    volume.sdf.copy_(0.01 * torch.where(z > 6, upper, (z - 1.5).clamp(max=2)))
    weights = torch.where((y - 7.5).abs() < 4, weight, weight if weight_at_ends is None else weight_at_ends)
    volume.weights.copy_(torch.where(z > 6, weights, 4.0) * ((z - 5).abs() > 1))
    return volume


def test_what_only_the_removal_of_a_fringe_cuts_off_stays():
    """Of 8 x 15 cm above the floor the ends, 8 x 4 cm each, were seen by many; parts below 100 cm2 go."""
    upper = []
    for weight in (1.0, 2.0):
        mesh = extract_fused_mesh(_floor_and_fringe(1.5, 1.5, weight, 2.0), min_part_m2=0.01)
        upper.append(len(np.unique(mesh.vertices[mesh.vertices[:, 2] > 0.03, 1])))
    assert upper == [10, 16]


def test_a_ramp_stays_where_nothing_else_was_seen():
    """Steps of 0.6 m, smoothed; a frame that came before them has seen through the ramps, or none has."""
    steps = np.tile(np.where(np.arange(128) // 24 % 2, np.float32(1.0), np.float32(1.6)), (96, 1))
    ramps = [cv2.GaussianBlur(steps, (0, 0), 1.2)] * 20
    options = FusionOptions(0.01, 500, (4e-6, 1e-6))
    between = []
    for frames in (_Views(*ramps), _Views(np.full_like(steps, 1.6), *ramps)):
        depth = extract_fused_mesh(fuse_frames(frames, options), min_part_m2=0).vertices[:, 2]
        between.append(int(((depth > 1.2) & (depth < 1.4)).sum()))
    assert between[0] > 100 and between[1] == 0


def test_smoothed_depth_is_not_smoothed_once_more():
    """A wave that smoothing leaves; as its curvature is within the noise, a mean over a window would lower it."""
    steps = np.where(np.arange(128) // 24 % 2, np.float32(1.0), np.float32(1.6))
    wave = np.float32(0.006) * np.sin(np.arange(96, dtype=np.float32) * np.float32(2 * np.pi / 8))[:, None]
    depth = cv2.GaussianBlur(np.tile(steps, (96, 1)), (0, 0), 1.2) + wave
    volume = fuse_frames(_Views(*[depth] * 3), FusionOptions(0.01, 500, (4e-5, 0.0)))
    z = extract_fused_mesh(volume, min_part_m2=0).vertices[:, 2]
    near = np.abs(z[np.abs(z - 1) < 0.02] - 1)
    assert np.sqrt(2 * np.mean(near**2)) > 0.8 * 0.006


def test_the_map_fills_what_no_frame_measured(device):
    """A slab's map of 1 x 1 m; a frame has measured the left half of its upper side, 4 mm above the map's."""
    scene = _scene(_slab, (0.5, 0.5, 0.03), device)
    pose = _looking((0.0, 0.05, 1.2), (0, 0, 0))
    volume = ops.TsdfVolume(0.01, device=device)
    rays = CAMERA.ray_directions() @ pose[:3, :3].T
    depth = ((0.034 - pose[2, 3]) / rays[..., 2]).astype(np.float32)
    points = pose[:3, 3] + rays * depth[..., None]
    depth[(points[..., 0] > 0) | (np.abs(points[..., :2]).max(-1) > 0.45)] = 0
    pose7 = torch.from_numpy(matrix_to_pose7(pose)).float().to(device)
    intrinsics = ops.Intrinsics(CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
    volume.add_blocks(_all_blocks(device))
    volume.integrate(torch.from_numpy(depth).to(device), pose7, intrinsics, noise=EXACT)
    mesh = extract_fused_mesh(volume, scene, CAMERA, pose[None], min_part_m2=0)
    x, y, z = mesh.vertices.T
    upper = (z > 0) & (np.abs(y) < 0.3)
    left, right = z[upper & (x > -0.3) & (x < -0.05)], z[upper & (x > 0.1) & (x < 0.3)]
    assert np.abs(np.median(left) - 0.034) < 1e-3 and np.abs(np.median(right) - 0.03) < 2e-3
    seam = upper & (np.abs(x) < 0.05)
    assert seam.sum() > 100 and (z[seam] > 0.028).all() and (z[seam] < 0.036).all()
    # One surface: every edge near the seam has two faces.
    faces = mesh.faces[seam[mesh.faces].all(1)]
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    inner = (np.abs(mesh.vertices[edges][:, :, 0]) < 0.03).all(1) & (np.abs(mesh.vertices[edges][:, :, 1]) < 0.2).all(1)
    _, counts = np.unique(edges[inner], axis=0, return_counts=True)
    assert (counts == 2).all()


def _all_blocks(device):
    axis = torch.arange(-7, 7, dtype=torch.int32, device=device)
    low = torch.arange(-2, 2, dtype=torch.int32, device=device)
    return torch.cartesian_prod(axis, axis, low)


def test_an_empty_volume_gives_an_empty_mesh():
    mesh = extract_fused_mesh(ops.TsdfVolume(0.02))
    assert mesh.vertices.shape == (0, 3) and mesh.faces.shape == (0, 3)
    vertices, faces = march_blocks(torch.zeros(0, 3, dtype=torch.int32), torch.zeros(0, 512), 0.02)
    assert len(vertices) == len(faces) == 0
    with pytest.raises(ValueError, match="camera and poses must be given together"):
        extract_fused_mesh(ops.TsdfVolume(0.02), camera=CAMERA)
