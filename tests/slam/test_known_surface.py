"""Counting surface that other frames have seen, point by point in NumPy and by the op; what the op refuses."""

import numpy as np
import pytest
import torch

from spslam.geometry import inverse, pose7_to_matrix, transform_points
from spslam.slam.pixels import THUMBNAIL_STEP_PX, sample_frame
from spslam.slam.poses import pose_tensor
from spslam.slam.recovery.free_space import (
    BEST_FRAMES,
    CLEAR_TOLERANCES,
    TOLERANCE_M,
    TOLERANCE_SHARE,
    surface_counts,
)
from spslam.slam.recovery.icp_alignment import surface_maps
from tests.ops.arguments import opcheck
from tests.slam.compared_frames import moved, poses_of, sampled
from tests.system.sequences import Recorded, settings

FRAMES = 12
MIN_DEPTH_M = 0.05
# Points at the border of a cell, as quaternions of float32 are no unit ones to the last bit.
ROUNDED = 1
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def recorded():
    return Recorded(FRAMES)


@pytest.fixture(scope="module")
def pixels(recorded):
    return sampled(recorded)


def known(recorded, pixels, device):
    """Poses and depth thumbnails of all frames."""
    return poses_of(recorded, device), torch.stack([each.depth_thumbnail for each in pixels]).to(device)


def expected(frame, pose, poses, thumbnails, rows, camera):
    """Counts [3] and the places of the rows counted, in their order."""
    vertices, _, k = (each if i == 2 else each.cpu().numpy() for i, each in enumerate(surface_maps(frame, camera)))
    into = inverse(pose7_to_matrix(pose.cpu().double().numpy()))
    poses, thumbnails = poses.cpu().double().numpy(), thumbnails.cpu().double().numpy()
    counts, hidden, known = np.zeros((len(rows), 3), int), [], np.zeros(vertices.shape[:2], bool)
    for place, row in enumerate(rows.tolist()):
        for line, column in np.argwhere(thumbnails[row] > 0):
            u, v = (THUMBNAIL_STEP_PX * cell + THUMBNAIL_STEP_PX // 2 for cell in (column, line))
            point = thumbnails[row][line, column] * np.array(
                [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1]
            )
            x, y, z = transform_points(into @ pose7_to_matrix(poses[row]), point[None])[0]
            i, j = int(np.floor(y / z * k.fy + k.cy + 0.5)), int(np.floor(x / z * k.fx + k.cx + 0.5))
            if z <= MIN_DEPTH_M or not (0 <= i < known.shape[0] and 0 <= j < known.shape[1]) or vertices[i, j, 2] == 0:
                continue
            behind = (float(vertices[i, j, 2]) - z) / (TOLERANCE_M + TOLERANCE_SHARE * z)
            counts[place] += abs(behind) < 1, behind > CLEAR_TOLERANCES, 0
            known[i, j] |= abs(behind) < 1
            if behind < -CLEAR_TOLERANCES:
                hidden.append((place, i, j))
    # What is nearer hides only where it is not known itself.
    for place, i, j in hidden:
        counts[place, 2] += not known[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2].any()
    best = np.argsort(-counts[:, :2].sum(1), kind="stable")[:BEST_FRAMES]
    return counts[best].sum(0), best.tolist()


@pytest.mark.parametrize("seed", range(6))
def test_counts_by_the_formula(recorded, pixels, device, seed):
    poses, thumbnails = known(recorded, pixels, device)
    frame = pixels[seed + 3].to(device)
    pose = pose_tensor(moved(recorded.poses()[seed + 3], seed) if seed else recorded.poses()[3], device)
    for rows in (torch.arange(FRAMES), torch.tensor([7, 2, 4]), torch.zeros(0, dtype=torch.long)):
        rows = rows.to(device)
        counts, best = surface_counts(frame, pose, poses, thumbnails, rows, recorded.camera)
        like, like_best = expected(frame, pose, poses, thumbnails, rows, recorded.camera)
        assert counts.shape == (3,) and best.shape == (min(len(rows), BEST_FRAMES),)
        np.testing.assert_allclose(counts.tolist(), like, atol=ROUNDED)
        assert best.tolist() == like_best


def test_what_is_nearer_and_unknown_hides(recorded, pixels, device):
    """A plate before the camera hides points; where other frames have seen the plate too, it does not."""
    poses, thumbnails = known(recorded, pixels, device)
    frame = recorded[4]
    frame.depth[20:70, 20:90] = 0.4
    covered = sample_frame(frame, recorded.camera, settings()).to(device)
    pose, rows = poses[4], torch.arange(FRAMES, device=device)
    hidden = surface_counts(covered, pose, poses, thumbnails, rows, recorded.camera)[0][2]
    like = expected(covered, pose, poses, thumbnails, rows, recorded.camera)[0][2]
    assert hidden > 50
    assert abs(hidden - like) <= ROUNDED
    thumbnails = thumbnails.clone()
    thumbnails[4] = covered.depth_thumbnail
    fewer = surface_counts(covered, pose, poses, thumbnails, rows, recorded.camera)[0][2]
    assert fewer < 0.8 * hidden  # thumbnails have a point in every 16 pixels only
    assert abs(fewer - expected(covered, pose, poses, thumbnails, rows, recorded.camera)[0][2]) <= ROUNDED


def test_frames_that_share_most_come_first(recorded, pixels, device):
    poses, thumbnails = known(recorded, pixels, device)
    thumbnails = thumbnails.clone()
    thumbnails[3] = 0
    thumbnails[6] = thumbnails[2]  # and their poses, so both share as much
    poses = poses.clone()
    poses[6] = poses[2]
    rows = torch.tensor([3, 6, 2, -1, FRAMES], device=device)  # of which the last are no frames
    counts, best = surface_counts(pixels[2].to(device), poses[2], poses, thumbnails, rows, recorded.camera)
    assert best.tolist() == [1, 2, 0, 3, 4]
    alone, _ = surface_counts(pixels[2].to(device), poses[2], poses, thumbnails, rows[2:3], recorded.camera)
    assert counts[:2].tolist() == (2 * alone[:2]).tolist()


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_poses_and_depths_that_are_not_finite_count_nothing(recorded, pixels, device, bad):
    poses, thumbnails = known(recorded, pixels, device)
    rows = torch.arange(FRAMES, device=device)
    for call in (
        (torch.full_like(poses[2], bad), poses, thumbnails),
        (poses[2], torch.full_like(poses, bad), thumbnails),
        (poses[2], poses, torch.full_like(thumbnails, float("nan"))),
    ):
        assert surface_counts(pixels[2].to(device), *call, rows, recorded.camera)[0].tolist() == [0, 0, 0]


def test_nothing_known_counts_nothing(recorded, pixels, device):
    poses, thumbnails = known(recorded, pixels, device)
    rows, frame = torch.arange(FRAMES, device=device), pixels[2].to(device)
    assert not surface_counts(frame, poses[2], poses, 0 * thumbnails, rows, recorded.camera)[0].any()
    assert not surface_counts(frame, poses[2], poses[:0], thumbnails[:0], rows[:0], recorded.camera)[0].any()
    without = frame.having(records=frame.records[:0], normals=frame.normals[:0])
    assert not surface_counts(without, poses[2], poses, thumbnails, rows, recorded.camera)[0].any()


@pytest.mark.cuda
def test_cuda_counts_the_same(recorded, pixels):
    for seed in range(8):
        found = []
        for device in (CPU, torch.device("cuda")):
            poses, thumbnails = known(recorded, pixels, device)
            pose = pose_tensor(moved(recorded.poses()[seed], seed), device)
            rows = torch.arange(FRAMES, device=device)
            counted = surface_counts(pixels[seed].to(device), pose, poses, thumbnails, rows, recorded.camera)
            found.append([each.tolist() for each in counted])
        assert found[0] == found[1]


def raw_call(recorded, pixels, device):
    camera, frame = recorded.camera, pixels[2].to(device)
    poses, thumbnails = known(recorded, pixels, device)
    intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy]
    rows = torch.arange(FRAMES, device=device)
    integers = [THUMBNAIL_STEP_PX, 2, 60, 80, BEST_FRAMES]
    tensors = [frame.records, frame.normals, poses[2], poses, thumbnails, rows]
    return [*tensors, intrinsics, [0.05, 0.02, 1.5], integers]


def test_opcheck(recorded, pixels, device):
    opcheck(torch.ops.spslam.count_known_surface.default, raw_call(recorded, pixels, device), device)


@pytest.mark.parametrize(
    ("argument", "bad"),
    [
        (0, lambda records: records[:, :2]),
        (1, lambda normals: normals[1:]),
        (2, lambda pose: pose[:6]),
        (3, lambda poses: poses[1:]),
        (4, lambda thumbnails: thumbnails.float()),
        (5, lambda rows: rows[None]),
        (6, lambda intrinsics: intrinsics[1:]),
        (7, lambda scalars: scalars[1:]),
        (8, lambda integers: [*integers[:1], 0, *integers[2:]]),
        (8, lambda integers: [0, *integers[1:]]),
        (8, lambda integers: [*integers[:2], 2**20, 2**20, integers[4]]),
        (8, lambda integers: [*integers[:4], -1]),
    ],
)
def test_bad_arguments_are_refused(recorded, pixels, device, argument, bad):
    call = raw_call(recorded, pixels, device)
    call[argument] = bad(call[argument])
    with pytest.raises(RuntimeError, match="count_known_surface: "):
        torch.ops.spslam.count_known_surface(*call)
