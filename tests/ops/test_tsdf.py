"""The signed distance blocks against plain NumPy, and against surfaces that are known exactly."""

import math

import numpy as np
import pytest
import torch

from spslam import ops
from spslam.geometry import pose7_to_matrix
from tests.ops.threads import assert_same_for_any_threads
from tests.reference import tsdf as reference

CAMERA = ops.Intrinsics(30.0, 31.0, 15.5, 11.5)
SIZE = (24, 32)
IDENTITY = torch.tensor([1.0, 0, 0, 0, 0, 0, 0])
NOISE = (4e-6, 1e-6)
VOXEL = 0.04
# float32 against float64: sums of 25 numbers, and normal equations of inverse depths that differ by a hundredth.
PLANE_TOLERANCE = 2e-3
# The weak prior on slopes turns the normal of a slanted plane by a tenth of a degree.
PRIOR_TOLERANCE = 4e-3


def rays(camera=CAMERA, size=SIZE):
    v, u = np.mgrid[: size[0], : size[1]]
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(size)], -1)


def wall(normal, distance, camera=CAMERA, size=SIZE):
    """Depth of the plane normal . x = distance."""
    return (distance / (rays(camera, size) @ np.asarray(normal))).astype(np.float32)


def ball(radius, z, behind=np.inf):
    """Depth of a ball before a wall."""
    r = rays()
    a, b, c = (r * r).sum(-1), r[..., 2] * z, z * z - radius**2
    root = np.sqrt(np.maximum(b * b - a * c, 0))
    hit = b * b > a * c
    return np.where(hit, (b - root) / a, behind).astype(np.float32)


def scene_depth(seed=0):
    """A slanted wall with a box before it, noise, and a hole."""
    generator = np.random.default_rng(seed)
    depth = wall((0.3, -0.2, 0.93), 1.9)
    depth[6:16, 8:20] = 1.2
    depth *= 1 + 1e-3 * generator.standard_normal(SIZE).astype(np.float32)
    depth[2:5, 20:25] = 0
    depth[20, 3] = np.nan
    return depth


def planes_of(depth, device="cpu", noise=NOISE, camera=CAMERA, shared_noise=False):
    return ops.measure_planes(torch.from_numpy(depth).to(device), camera, noise, shared_noise)


def fused(depths, device="cpu", poses=None, voxel=VOXEL, colors=None, **options):
    volume = ops.TsdfVolume(voxel, device=device, **options)
    for i, depth in enumerate(depths):
        pose = IDENTITY if poses is None else poses[i]
        color = None if colors is None else torch.from_numpy(colors[i]).to(device)
        volume.integrate(torch.from_numpy(depth).to(device), pose.to(device), CAMERA, color, NOISE)
    return volume


@pytest.mark.parametrize("shared", [False, True])
def test_planes_are_those_of_numpy(device, shared):
    depth = scene_depth()
    got = planes_of(depth, device, shared_noise=shared).cpu().double().numpy()
    want = reference.planes(np.nan_to_num(depth).astype(np.float64), CAMERA, NOISE, shared)
    assert (want[..., 4] > 0).mean() > 0.7
    assert ((got[..., 4] > 0) != (want[..., 4] > 0)).mean() < 0.01  # where a share is a hair's breadth from a limit
    both = (got[..., 4] > 0) & (want[..., 4] > 0)
    assert np.abs(got - want)[both].max() < PLANE_TOLERANCE


def test_planes_of_an_exact_wall_are_exact(device):
    normal = np.array([0.48, -0.36, 0.8])
    got = planes_of(wall(normal, 1.5), device).cpu().numpy()
    assert np.abs(got[2:-2, 2:-2, :3] - normal).max() < PRIOR_TOLERANCE
    assert np.abs(got[2:-2, 2:-2, 3] - 1.5).max() < PRIOR_TOLERANCE


def test_planes_lower_the_noise_of_a_flat_surface_and_keep_edges():
    generator = np.random.default_rng(0)
    depth = wall((0, 0, 1), 2.0)
    depth[:, 16:] = 1.7
    noisy = (depth + 0.004 * generator.standard_normal(SIZE)).astype(np.float32)
    got = planes_of(noisy, noise=(16e-6, 0.0)).numpy()
    z = got[..., 3] / (got[..., :3] * rays()).sum(-1)
    known = got[..., 4] > 0
    assert known.mean() > 0.95
    error = np.abs(z - depth)[known]
    assert np.sqrt((error**2).mean()) < 0.5 * 0.004
    assert error.max() < 0.02  # none lies between the two surfaces


def test_noise_that_neighbors_share_counts_in_the_weight_alone(device):
    depth = scene_depth()
    got, without = planes_of(depth, device, shared_noise=True), planes_of(depth, device, noise=(0.0, 0.0))
    known = without[..., 4] > 0
    assert known.float().mean() > 0.7 and torch.equal(got[..., 4] > 0, known)
    torch.testing.assert_close(got[..., :4], without[..., :4])
    z = torch.from_numpy(depth).to(device)
    surface = 0.003**2
    weights = without[..., 4] * surface / (surface + NOISE[0] + NOISE[1] * z**4)
    torch.testing.assert_close(got[..., 4][known], weights[known], rtol=1e-4, atol=0)
    # The pixel's own depth is kept, where a fit that counts the noise takes the mean.
    own = (z * got[..., 3] / without[..., 3])[known]
    torch.testing.assert_close(own, z[known], rtol=1e-6, atol=0)
    assert (planes_of(depth, device)[..., 3][known] - got[..., 3][known]).abs().max() > 1e-3


def test_planes_are_unknown_without_depth(device):
    depth = wall((0, 0, 1), 2.0)
    for value in (0.0, -1.0, np.nan, np.inf, -np.inf):
        depth[10, 12] = value
        planes = planes_of(depth, device)
        assert (planes[10, 12] == 0).all() and (planes[10, 13, 4] > 0) and planes.isfinite().all()
    assert planes_of(np.zeros((0, 7), np.float32), device).shape == (0, 7, 5)


def test_touched_blocks_hold_the_truncation_of_every_pixel(device):
    depth = np.nan_to_num(scene_depth())
    planes = planes_of(depth, device)
    blocks = ops.tsdf_touched_blocks(planes, IDENTITY.to(device), CAMERA, voxel_size=VOXEL, truncation=3 * VOXEL)
    found = {tuple(row) for row in blocks.tolist()}
    measured = planes.cpu().numpy()
    z = measured[..., 3] / np.maximum((measured[..., :3] * rays()).sum(-1), 1e-9)
    for v, u in zip(*np.nonzero(measured[..., 4]), strict=True):
        point = rays()[v, u] * z[v, u]
        assert tuple(np.floor(point / (8 * VOXEL)).astype(int)) in found
    none = ops.tsdf_touched_blocks(planes * 0, IDENTITY.to(device), CAMERA, voxel_size=VOXEL, truncation=0.1)
    assert none.shape == (0, 3)


def test_integration_is_that_of_numpy(device):
    depths = [scene_depth(0), scene_depth(1)]
    poses = [IDENTITY, torch.tensor([0.995, 0.02, -0.09, 0.01, 0.1, -0.05, 0.03])]
    poses[1][:4] /= poses[1][:4].norm()
    colors = [np.full((*SIZE, 3), 100 * i, np.uint8) for i in (1, 2)]
    volume = fused(depths, device, poses, colors=colors)
    planes = [planes_of(depth).double().numpy() for depth in depths]
    matrices = [pose7_to_matrix(pose.double().numpy()[None])[0] for pose in poses]
    generator = np.random.default_rng(0)
    coords, checked, skipped = volume.block_coords.cpu().numpy(), 0, 0
    for _ in range(3000):
        block, voxel = generator.integers(len(volume)), generator.integers(512)
        point = (coords[block] * 8 + np.array([voxel // 64, voxel // 8 % 8, voxel % 8])) * VOXEL
        mean = total = 0.0
        for i, (image, pose) in enumerate(zip(planes, matrices, strict=True)):
            if i == 0 and tuple(coords[block]) not in _first_blocks(depths[0]):
                continue
            sdf, weight, _ = reference.observe(point, image, CAMERA, pose, (3 * VOXEL, 2 * VOXEL), NOISE, VOXEL)
            total += weight
            mean += (sdf - mean) * weight / total if weight else 0.0
        got = volume.weights[block, voxel].item()
        if abs(got - total) > 1e-3 * total + 1e-5:
            skipped += 1  # a voxel at the border between two pixels
            continue
        checked += total > 0
        assert volume.sdf[block, voxel].item() == pytest.approx(mean, abs=2e-4)
    assert checked > 500
    assert skipped < 0.02 * 3000  # few fall on such a border


def _first_blocks(depth, cache={}):  # noqa: B006
    key = depth.tobytes()
    if key not in cache:
        planes = planes_of(depth)
        step = min(max(int(0.5 * 8 * VOXEL / 5 * CAMERA.fx), 1), 3)
        blocks = ops.tsdf_touched_blocks(planes, IDENTITY, CAMERA, voxel_size=VOXEL, truncation=3 * VOXEL, step=step)
        cache[key] = {tuple(row) for row in blocks.tolist()}
    return cache[key]


def test_colors_are_means_of_what_was_seen(device):
    depth = wall((0, 0, 1), 1.5)
    colors = [np.full((*SIZE, 3), (20, 120, 220), np.uint8), np.full((*SIZE, 3), (40, 120, 200), np.uint8)]
    volume = fused([depth, depth], device, colors=colors)
    _, rgb, known = volume.query(torch.tensor([[0.01, 0.02, 1.5]], device=device))
    assert known.all()
    assert (rgb[0].cpu() * 255 - torch.tensor([30.0, 120.0, 210.0])).abs().max() < 0.05


def test_a_ball_is_extracted_and_ray_cast_where_it_is(device):
    depth = ball(0.5, 1.5, behind=0)
    volume = fused([depth] * 3, device, voxel=0.02)
    vertices, faces = volume.extract()
    radius = (vertices.cpu() - torch.tensor([0, 0, 1.5])).norm(dim=1)
    assert len(faces) > 500 and (radius - 0.5).abs().median() < 0.002
    pose = IDENTITY.to(device)
    cast, normals, _ = ops.tsdf_ray_cast(
        *volume.field(), pose, CAMERA, size=SIZE[::-1], voxel_size=0.02, min_weight=1e-3
    )
    cast, middle = cast.cpu().numpy(), np.s_[8:16, 12:20]
    assert np.abs(cast - depth)[middle].max() < 0.004
    assert (normals[12, 16].cpu() - torch.tensor([0.0, 0, -1])).abs().max() < 0.1
    assert (cast[0] == 0).all()


def test_what_has_moved_away_is_carved():
    empty, hand = wall((0, 0, 1), 1.5), wall((0, 0, 1), 1.5)
    hand[8:16, 10:20] = 1.0
    volume = fused([hand] * 3 + [empty] * 9)
    vertices, _ = volume.extract()
    assert len(vertices) > 100  # the wall
    assert (vertices[:, 2] > 1.3).all()


def test_seeing_through_counts_however_far_what_is_seen_is(device):
    """A few frames have a box before a wall that is so far and noisy that its surface hardly counts."""
    noise, far = (1e-6, 1e-5), 6.0
    empty, box = wall((0, 0, 1), far), wall((0, 0, 1), far)
    box[8:16, 10:20] = 1.0
    volume = ops.TsdfVolume(VOXEL, device=device)
    for depth in (box, *[empty] * 20):
        volume.integrate(torch.from_numpy(depth).to(device), IDENTITY.to(device), CAMERA, noise=noise)
    vertices, _ = volume.extract()
    assert len(vertices) > 100 and (vertices[:, 2] > far - 1).all()
    middle = torch.tensor([[0.0, 0.0, z] for z in (0.9, 1.0, far)], device=device)
    near, on_box, on_wall = volume.query(middle)[0].tolist()
    assert near > 0.05 and on_box > 0.05 and abs(on_wall) < VOXEL


def test_a_wall_whose_noise_is_larger_than_voxels_is_one_surface(device):
    generator = np.random.default_rng(0)
    noise = 0.0, (0.05 / 16) ** 2  # 5 cm at 4 m
    volume = ops.TsdfVolume(0.01, device=device)
    for _ in range(40):
        depth = wall((0, 0, 1), 4.0) + 0.05 * generator.standard_normal(SIZE).astype(np.float32)
        volume.integrate(torch.from_numpy(depth).to(device), IDENTITY.to(device), CAMERA, noise=noise)
    vertices, faces = (tensor.cpu() for tensor in volume.extract())
    inside = (vertices[:, :2].abs() < 1).all(1)
    a, b, c = vertices[faces[inside[faces].all(1)]].unbind(1)
    area = (b - a).cross(c - a, dim=1).norm(dim=1).sum().item() / 2
    assert (vertices[inside, 2] - 4).abs().mean() < 0.012  # 8 mm is the mean of 40
    assert area < 2.5 * 2**2  # of 2 x 2 m; steps between pixels add to it


def test_a_plane_along_the_ray_says_nothing_of_what_is_far_behind(device):
    """As at the edge of a table, where depth is smooth: all that is hidden lies near the plane."""
    steep = np.array([0.98, 0.0, np.sqrt(1 - 0.98**2)])
    volume = ops.TsdfVolume(VOXEL, 8 * VOXEL, device=device)
    axes = [torch.arange(-1, 2), torch.arange(-1, 2), torch.arange(0, 20)]
    volume.add_blocks(torch.cartesian_prod(*axes).int().to(device))
    volume.integrate(torch.from_numpy(wall(steep, 0.3)).to(device), IDENTITY.to(device), CAMERA, noise=NOISE)
    ray = rays()[12, 15]
    depth = 0.3 / (ray @ steep)
    points = torch.from_numpy(np.outer((depth + 0.05, depth + 0.9), ray)).float().to(device)
    assert 0.9 * (ray @ steep) < 5 * VOXEL  # within the truncation, two thirds of 8, of the plane
    assert volume.query(points)[2].tolist() == [True, False]


def test_both_sides_of_a_thin_board_are_there():
    half_turn = torch.tensor([0.0, 0, 1, 0, 0, 0, 2.03])  # looks back from z = 2.03
    front, back = wall((0, 0, 1), 1.0), wall((0, 0, 1), 1.0)
    volume = fused([front, back] * 3, poses=[IDENTITY, half_turn] * 3, voxel=0.01)
    _, _, known = volume.query(torch.tensor([[0.0, 0, 1.0], [0.0, 0, 1.03]]))
    assert known.all()
    vertices, _ = volume.extract()
    middle = vertices[vertices[:, :2].abs().amax(1) < 0.1]
    sides = [((middle[:, 2] - z).abs() < 0.006).sum().item() for z in (1.0, 1.03)]
    assert min(sides) > 100 and sum(sides) == len(middle)


def test_query_interpolates_and_says_what_is_unknown(device):
    volume = fused([wall((0, 0, 1), 1.5)], device)
    points = torch.tensor([[0.013, -0.021, 1.47], [0.0, 0, 9.0], [float("nan"), 0, 1.5], [1e30, 0, 0]], device=device)
    sdf, rgb, known = volume.query(points)
    assert known.tolist() == [True, False, False, False]
    assert sdf[0].item() == pytest.approx(0.03, abs=1e-3)
    assert (sdf[1:] == 0).all() and (rgb == 0).all()


def test_blocks_without_rows_are_unknown(device):
    volume = fused([wall((0, 0, 1), 1.5)], device)
    keys, values, *rows = volume.field()
    points = torch.tensor([[0.013, -0.021, 1.47]], device=device)
    stale = keys, values, *(table[:0].clone() for table in rows)
    assert not ops.tsdf_query(*stale, points, voxel_size=VOXEL)[2].any()
    cast, _, _ = ops.tsdf_ray_cast(*stale, IDENTITY.to(device), CAMERA, size=(4, 3), voxel_size=VOXEL)
    assert not cast.any()


def test_voxels_in_which_nothing_was_measured_are_no_surface(device):
    """Of a wall whose right half was not measured, seen along it: free space ends there, and unknown space begins."""
    depth = wall((0, 0, 1), 1.5)
    depth[:, 18:] = 0
    volume = fused([depth], device)
    half = math.sqrt(0.5)
    along = torch.tensor([half, 0, half, 0, -1.0, 0, 1.5 - 1.5 * VOXEL], device=device)
    cast, _, _ = ops.tsdf_ray_cast(*volume.field(), along, CAMERA, size=SIZE[::-1], voxel_size=VOXEL)
    v, u = (cast > 0).nonzero().cpu().unbind(1)
    off = 1.5 * VOXEL + cast[v, u].cpu() * (u - CAMERA[2]) / CAMERA[0]  # of the wall: the view's x axis is -z
    assert len(off) > 50 and (off.abs() < 0.5 * VOXEL).all()
    unknown = volume.weights == 0
    assert unknown.any()
    row, place = unknown.nonzero()[0].tolist()
    voxel = 8 * volume.block_coords[row].cpu() + torch.tensor([place // 64, place // 8 % 8, place % 8])
    point = (VOXEL * voxel)[None].to(device)
    assert not ops.tsdf_query(*volume.field(), point, voxel_size=VOXEL)[2].any()


def test_voxels_that_a_frame_does_not_see_keep_their_weight(device):
    volume = fused([wall((0, 0, 1), 1.5)], device)
    volume.weights.fill_(50.0)
    before = volume.sdf.clone()
    planes = planes_of(wall((0, 0, 1), 1.5)).to(device)
    tables = volume.block_coords, volume.sdf, volume.weights, volume.colors
    sizes = dict(voxel_size=VOXEL, truncation=3 * VOXEL, max_weight=10.0)
    ops.tsdf_integrate_(*tables, planes, IDENTITY.to(device), CAMERA, **sizes)
    unseen = volume.weights == 50.0
    assert unseen.any() and (volume.weights[~unseen] == 10.0).all()
    assert torch.equal(volume.sdf[unseen], before[unseen])


def test_frames_that_are_not_finite_change_nothing(device):
    volume = fused([wall((0, 0, 1), 1.5)], device)
    before = [tensor.clone() for tensor in (volume.sdf, volume.weights)]
    pose = torch.tensor([1.0, 0, 0, 0, float("nan"), 0, 0], device=device)
    depth = torch.from_numpy(wall((0, 0, 1), 1.2)).to(device)
    volume.integrate(depth, pose, CAMERA)
    volume.integrate(depth * float("nan"), IDENTITY.to(device), CAMERA)
    assert all(torch.equal(a, b) for a, b in zip(before, (volume.sdf, volume.weights), strict=True))
    cast, _, _ = ops.tsdf_ray_cast(*volume.field(), pose, CAMERA, size=(4, 3), voxel_size=VOXEL)
    assert cast.shape == (3, 4) and (cast == 0).all()


def test_results_do_not_depend_on_the_number_of_threads():
    depths = [scene_depth(0), scene_depth(1)]
    color = np.random.default_rng(0).integers(0, 256, (*SIZE, 3)).astype(np.uint8)

    def compute():
        volume = fused(depths, colors=[color, color])
        image = ops.tsdf_ray_cast(*volume.field(), IDENTITY, CAMERA, size=SIZE[::-1], voxel_size=VOXEL)
        return volume.block_coords, volume.sdf, volume.weights, volume.colors.to(torch.int32), *image, *volume.extract()

    assert_same_for_any_threads(compute, (1, 2, 3))


def test_a_limit_of_blocks_is_kept():
    depth = torch.from_numpy(wall((0, 0, 1), 1.5))
    volume = ops.TsdfVolume(0.02, max_blocks=5)
    with pytest.raises(ops.VoxelLimitError):
        volume.integrate(depth, IDENTITY, CAMERA)
    assert len(volume) == 0


def test_empty_input(device):
    volume = ops.TsdfVolume(0.02, device=device)
    volume.integrate(torch.zeros(0, 5, device=device), IDENTITY.to(device), CAMERA)
    volume.integrate(torch.zeros(4, 5, device=device), IDENTITY.to(device), CAMERA)
    assert len(volume) == 0
    vertices, faces = volume.extract()
    assert vertices.shape == (0, 3) and faces.shape == (0, 3)
    assert volume.query(torch.zeros(0, 3, device=device))[0].shape == (0,)


@pytest.mark.parametrize("size", [(0, 0), (0, 32), (24, 0)])
def test_a_frame_without_pixels_changes_nothing(size, device):
    """Blocks at a corner of the view too, which the image's first tile belongs to."""
    volume = fused([wall((0, 0, 1), 1.5)], device)
    before = [tensor.clone() for tensor in (volume.sdf, volume.weights)]
    volume.integrate(torch.zeros(size, device=device), IDENTITY.to(device), CAMERA)
    assert all(torch.equal(a, b) for a, b in zip(before, (volume.sdf, volume.weights), strict=True))


def test_blocks_without_rows_are_refused():
    volume = fused([wall((0, 0, 1), 1.5)])
    rows = len(volume)
    volume.blocks.insert(torch.tensor([[99, 0, 0]], dtype=torch.int32))
    with pytest.raises(ValueError, match=f"TsdfVolume.field: blocks must be {rows} at most: use add_blocks, got"):
        volume.query(torch.zeros(1, 3))
    volume.add_blocks(torch.tensor([[99, 0, 0]], dtype=torch.int32))
    assert not volume.query(torch.zeros(1, 3))[2].any()


@pytest.mark.parametrize(
    "changes, error, message",
    [
        (dict(voxel_size=0.0), ValueError, "tsdf_integrate_: voxel_size must be positive, got 0.0"),
        (dict(truncation=0.01), ValueError, "tsdf_integrate_: truncation must be at least voxel_size, got 0.01"),
        (dict(near_truncation=0.07), ValueError, "tsdf_integrate_: near_truncation must be positive and at most trunc"),
        (dict(noise=(1e-6, -1.0)), ValueError, "tsdf_integrate_: noise must be two numbers of at least 0"),
        (dict(max_weight=0.0), ValueError, "tsdf_integrate_: max_weight must be positive, got 0.0"),
        (dict(sdf=torch.zeros(1, 8)), ValueError, r"tsdf_integrate_: sdf must have shape \[B, 512\], got \[1, 8\]"),
        (dict(planes=torch.zeros(4, 4)), ValueError, r"tsdf_integrate_: planes must have shape \[H, W, 5\]"),
        (dict(color=torch.zeros(4, 4, 3)), TypeError, "tsdf_integrate_: color must be uint8, got float32"),
    ],
)
def test_wrong_arguments_are_refused(changes, error, message):
    call = dict(
        block_coords=torch.zeros(1, 3, dtype=torch.int32),
        sdf=torch.zeros(1, 512),
        weights=torch.zeros(1, 512),
        colors=torch.zeros(1, 512, 4, dtype=torch.uint16),
        planes=torch.zeros(4, 4, 5),
        pose=IDENTITY,
        intrinsics=CAMERA,
        voxel_size=0.02,
        truncation=0.06,
    )
    with pytest.raises(error, match=message):
        ops.tsdf_integrate_(**(call | changes))


def test_noise_does_not_move_a_surface(device):
    deviation = 0.01
    quantiles = torch.distributions.Normal(0.0, deviation).icdf((torch.arange(41) + 0.5) / 41)
    volume = ops.TsdfVolume(0.01, device=device)
    for offset in quantiles.tolist():
        depth = torch.full(SIZE, 1.0 + offset, device=device)
        volume.integrate(depth, IDENTITY.to(device), CAMERA, noise=(deviation**2, 0.0))
    vertices, _ = volume.extract()
    # A weight that fell from the surface on would move it by 0.24 deviations.
    assert abs(vertices[:, 2].mean().item() - 1) < 0.1 * deviation


@pytest.mark.parametrize("focal", [0.0, -8.0, math.nan, math.inf])
def test_intrinsics_that_can_not_be_are_named(focal):
    volume, pose = ops.TsdfVolume(0.05), torch.tensor([1.0, 0, 0, 0, 0, 0, 0])
    planes = torch.zeros(8, 8, 5)
    for wrong in ((focal, 8.0, 3.5, 3.5), (8.0, focal, 3.5, 3.5)):
        with pytest.raises(ValueError, match=r"measure_planes: intrinsics must have positive finite focal lengths"):
            volume.integrate(torch.full((8, 8), 2.0), pose, wrong)
        with pytest.raises(ValueError, match=r"TsdfVolume.make_room: intrinsics must have positive finite focal"):
            volume.make_room(planes, pose, wrong)
    volume.integrate(torch.full((8, 8), 2.0), pose, (8.0, 8.0, 3.5, 3.5))
    assert len(volume)
