"""What depth images of a fusion say of faces, and what goes from a mesh that they contradict."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from spslam import ops
from spslam.camera import Camera
from spslam.geometry import pose_from
from spslam.meshing import depth_views
from spslam.meshing.depth_views import APART_M, DepthViews
from spslam.meshing.frame_fusion import FusionOptions, PosedFrames, fuse_frames
from spslam.meshing.fused_mesh import extract_fused_mesh
from spslam.pose_graph import rotation_matrices
from tests.meshing.test_extract_mesh import CAMERA, _looking, _scene, _slab
from tests.meshing.test_frame_fusion import _all_blocks, _floor_and_fringe, _Views

EXACT = (0.0, 0.0)
BACK = np.array([0.0, 0.0, -1.0])  # to a camera at the origin that looks along z


def frames_at(poses, camera=CAMERA):
    return PosedFrames(SimpleNamespace(camera=camera), np.arange(len(poses)), np.asarray(poses))


def shown(depth, pose=None, noise=EXACT, device="cpu"):
    """Views of one frame."""
    views = DepthViews([frames_at([np.eye(4) if pose is None else pose])], [noise])
    views.show(0, 0, torch.from_numpy(depth.astype(np.float32)).to(device))
    return views


def looks_at(views, points, normals, device="cpu"):
    """What views saw of each point, as the first letters of agreed, near, through and unknown."""
    points, normals = (torch.tensor(np.array(each), dtype=torch.float32, device=device) for each in (points, normals))
    looks = views.look_at(points, normals)
    return ["".join(name[0] for name in looks._fields if getattr(looks, name)[i]) for i in range(len(points))]


def wall(z=2.0, left_unknown=False):
    depth = np.full((CAMERA.height, CAMERA.width), z)
    if left_unknown:
        depth[:, : CAMERA.width // 2] = 0
    return depth


def test_what_a_view_says_of_points_before_on_and_behind_a_wall(device):
    views = shown(wall(left_unknown=True), device=device)
    points = [[0.3, 0, 2.0], [0.3, 0, 2.0], [0.3, 0, 2.015], [0.3, 0, 1.5], [0.3, 0, 2.5], [-0.3, 0, 2.0], [9, 0, 2.0]]
    normals = [BACK, -BACK, BACK, BACK, BACK, BACK, BACK]
    # On it; from behind; 15 mm behind; before; hidden; where there is no depth; beside the image.
    assert looks_at(views, points, normals, device) == ["an", "n", "n", "t", "", "u", ""]
    assert looks_at(views, [[0.3, 0, -2.0]], [BACK], device) == [""]


def test_noise_and_the_size_of_a_pixel_on_a_slanted_face_agree_with_more():
    off, slanted = [[0.3, 0, 2.015]], [0.998, 0, -0.06]
    assert looks_at(shown(wall()), off, [BACK]) == ["n"]
    assert looks_at(shown(wall(), noise=(0.006**2, 0.0)), off, [BACK]) == ["an"]
    assert looks_at(shown(wall(), noise=(0.0, 0.0015**2)), off, [BACK]) == ["an"]
    # Seen at 0.2 rad from its plane a pixel is 7 cm long: a face that ends at the wall.
    assert looks_at(shown(wall()), off, [slanted / np.linalg.norm(slanted) * [-1, 1, 1]]) == ["an"]


def test_views_are_where_their_cameras_are():
    pose = pose_from(rotation_matrices(np.array([0.3, -0.8, 0.2])), np.array([1.0, -2.0, 0.5]))
    points = np.array([[0.3, 0.2, 2.0], [0.3, 0.2, 1.5]]) @ pose[:3, :3].T + pose[:3, 3]
    assert looks_at(shown(wall(), pose), points, [pose[:3, :3] @ BACK] * 2) == ["an", "t"]


def test_large_images_are_kept_by_every_other_pixel():
    camera = Camera(1280, 720, 700.0, 700.0, 639.5, 359.5)
    views = DepthViews([frames_at([np.eye(4)], camera)], [EXACT])
    depth = torch.full((720, 1280), 2.0)
    depth[:, 640:] = 3.0
    views.show(0, 0, depth)
    assert looks_at(views, [[-0.05, 0, 2.0], [0.05, 0, 2.0]], [BACK] * 2) == ["an", "t"]


def test_views_are_apart_and_within_their_memory(monkeypatch):
    still, turned = np.eye(4), pose_from(rotation_matrices(np.array([0.0, 0.1, 0.0])), np.zeros(3))
    there = [*range(21), *range(20, -1, -1)]  # and back
    moved = [pose_from(np.eye(3), np.array([0.61 * APART_M * i, 0, 0])) for i in there]
    parts = [frames_at([still, still, turned, turned]), frames_at(moved)]

    def kept():
        views = DepthViews(parts, [EXACT, EXACT])
        for number, part in enumerate(parts):
            for position in range(len(part)):
                views.show(number, position, torch.ones(CAMERA.height, CAMERA.width))
        return len(views)

    assert kept() == 2 + 11  # every other of those that move
    monkeypatch.setattr(depth_views, "KEPT_BYTES", 5 * 2 * CAMERA.height * CAMERA.width)
    assert kept() == 5
    monkeypatch.setattr(depth_views, "KEPT_BYTES", 0)
    assert kept() == 1


def test_a_face_that_no_view_confirms_goes_where_one_sees_past_it():
    """What seems a wall above a floor, between voxels before and behind nothing: see `_floor_and_fringe`."""
    volume = _floor_and_fringe(1.5, 1.5, 2.0)
    above = _looking((0.08, 0.08, 1.0), (0.08, 0.0801, 0.0))
    looking_down = CAMERA.ray_directions() @ above[:3, :3].T
    down = shown(-above[2, 3] / looking_down[..., 2] * 0.985, above)
    beside = _looking((1.0, 0.08, 0.11), (0.075, 0.08, 0.1101))
    rays = CAMERA.ray_directions() @ beside[:3, :3].T
    front = shown((0.075 - beside[0, 3]) / rays[..., 0], beside)

    def wall_of(views):
        return int((extract_fused_mesh(volume, min_part_m2=0, views=views).vertices[:, 2] > 0.03).sum())

    assert wall_of(None) == wall_of(front) == 9 * 16
    assert wall_of(down) == 0
    # One that saw it from its front outweighs what others see past it.
    both = DepthViews([frames_at([above, beside])], [EXACT])
    for position, views in enumerate((down, front)):
        both.show(0, position, next(iter(views._views.values())).depth.float())
    assert wall_of(both) == 9 * 16


def _plate(weight, device):
    """What is known around 3 x 3 cm of a floor at z = 1.5 cm, of voxels of 1 cm."""
    volume = ops.TsdfVolume(0.01, device=device)
    volume.add_blocks(torch.cartesian_prod(*[torch.arange(2, dtype=torch.int32, device=device)] * 3))
    local = torch.cartesian_prod(*[torch.arange(8, device=device)] * 3)
    x, y, z = (volume.block_coords[:, None] * 8 + local[None]).unbind(-1)
    volume.sdf.copy_(0.01 * (z - 1.5).clamp(-2, 2))
    volume.weights.copy_(weight * (((x - 7.5).abs() < 2) & ((y - 7.5).abs() < 2)))
    return volume


@pytest.mark.parametrize(
    ("weight", "sees", "stays"), [(1.0, 0.015, True), (1.0, -0.2, False), (0.05, 0.015, False), (1.0, None, False)]
)
def test_a_small_part_stays_where_it_is_known_well_and_a_view_confirms_it(device, weight, sees, stays):
    above = _looking((0.075, 0.075, 0.6), (0.075, 0.0751, 0.0))
    views = None
    if sees is not None:
        depth = (sees - above[2, 3]) / (CAMERA.ray_directions() @ above[:3, :3].T)[..., 2]
        views = shown(depth, above, device=device)
    assert (len(extract_fused_mesh(_plate(weight, device), views=views).faces) > 0) == stays
    assert len(extract_fused_mesh(_plate(weight, device), min_part_m2=0).faces) == 18


@pytest.mark.parametrize(("sees", "stays"), [("nothing", True), ("it", True), ("through", False)])
def test_what_the_map_fills_in_goes_where_views_look_through_it(device, sees, stays):
    scene = _scene(_slab, (0.5, 0.5, 0.03), device)
    volume = ops.TsdfVolume(0.01, device=device)
    volume.add_blocks(_all_blocks(device))
    pose = _looking((0.0, 0.05, 1.2), (0, 0, 0))
    height = {"it": 0.03, "through": -0.5, "nothing": np.inf}[sees]
    depth = (height - pose[2, 3]) / (CAMERA.ray_directions() @ pose[:3, :3].T)[..., 2]
    views = shown(np.where(np.isfinite(depth), depth, 0), pose, device=device)
    mesh = extract_fused_mesh(volume, scene, CAMERA, pose[None], min_part_m2=0, views=views)
    upper = (mesh.vertices[:, 2] > 0) & (np.abs(mesh.vertices[:, :2]).max(1) < 0.3)
    assert (upper.sum() > 1000) == stays


def test_a_fusion_shows_its_frames_to_views():
    steps = np.tile(np.where(np.arange(128) // 24 % 2, np.float32(1.0), np.float32(1.6)), (96, 1))
    frames = _Views(steps, steps)
    views = DepthViews([frames], [EXACT])
    fuse_frames(frames, FusionOptions(0.02, 500, (1e-8, 0.0)), views=views)
    assert len(views) == 1  # of two from one place
    camera = frames.dataset.camera
    x = (60 - camera.cx) / camera.fx
    assert looks_at(views, [[x * steps[0, 60], 0, steps[0, 60]]], [BACK]) == ["an"]
