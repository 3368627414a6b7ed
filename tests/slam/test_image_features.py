"""Image features: where they are, what they match, which pose they give, and how they are kept."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from spslam.camera import Camera
from spslam.geometry import inverse, rotation_angle
from spslam.pose_graph import rotation_matrices
from spslam.slam import feature_store
from spslam.slam.constraints import Constraints
from spslam.slam.depth_keyframes import depth_image_intrinsics
from spslam.slam.feature_keeper import EXPECTED_FRAMES, FeatureKeeper
from spslam.slam.feature_store import FeatureStore
from spslam.slam.fit import Fit
from spslam.slam.frame_history import FrameHistory
from spslam.slam.image_features import COUNT, ImageFeatures, extract_features, features_of_images
from spslam.slam.pixels import sample_frame
from spslam.slam.poses import pose_matrix, pose_tensor
from spslam.slam.recovery import place_recognition
from spslam.slam.recovery.doubtful_frame import DoubtfulFrame
from spslam.slam.recovery.feature_alignment import (
    MIN_INLIERS,
    FeatureAlignment,
    FeatureMatches,
    joined_too,
    ratio_matches,
)
from spslam.slam.recovery.feature_equations import SeenRays
from spslam.slam.recovery.place_recognition import retrieve_by_features
from spslam.slam.recovery.tracked_frame import TrackedFrame
from spslam.slam.rolling_shutter import ShutterRectifier
from spslam.slam.state import SlamState
from spslam.slam.system import SlamSystem
from tests.system.sequences import Recorded, settings

MAX_DEPTH_M = settings().dataset.max_depth_m
CPU = torch.device("cpu")
BASIN_M, BASIN_DEG = 0.05, 2.0  # from there tracking and ICP converge; a pixel of these small images is 0.4 degrees


@pytest.fixture(scope="module")
def dataset():
    return Recorded(25)


@pytest.fixture(scope="module")
def features(dataset):
    sampled = [sample_frame(dataset[i], dataset.camera, settings()) for i in range(25)]
    return [extract_features(pixels, dataset.camera, MAX_DEPTH_M) for pixels in sampled]


def pose_of(dataset, frame):
    return pose_tensor(dataset.poses()[frame], CPU)


def some_of(matches, rows):
    return FeatureMatches(matches.points[rows], matches.positions[rows], matches.deviations[rows], matches.rows[rows])


def exact(points, positions):
    """Matches of points whose depth has no noise."""
    return FeatureMatches(points, positions, np.zeros_like(points), np.arange(len(points)))


def random_features(count, seed):
    random = np.random.default_rng(seed)
    descriptors = random.integers(0, 256, (count, 32), dtype=np.uint8)
    points = random.normal(size=(count, 3)).astype(np.float32) + (0, 0, 5)
    return ImageFeatures(descriptors, np.zeros((count, 2), np.float32), points.astype(np.float32))


def test_features_lie_on_the_surface_that_the_frame_sees(dataset, features):
    one, k, depth = features[0], depth_image_intrinsics(dataset.camera), dataset[0].depth
    assert 50 < len(one) <= COUNT
    assert one.descriptors.shape == (len(one), 32)
    column, row = np.round(one.positions).astype(int).T
    near = [depth[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2] for r, c in zip(row, column, strict=True)]
    z = one.points[:, 2]
    assert all(box.min() - 1e-3 <= value <= box.max() + 1e-3 or value == 0 for box, value in zip(near, z, strict=True))
    known = z > 0
    projected = one.points[known] @ np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]], np.float32).T
    np.testing.assert_allclose(projected[:, :2] / projected[:, 2:], one.positions[known], atol=1e-3)


def test_the_strongest_features_cover_the_image(features):
    """The first quarter has one in most of those cells of a coarse grid that have any."""
    cells = [set(map(tuple, (part // 32).astype(int))) for part in (features[0].positions, features[0].positions[:150])]
    assert len(cells[1]) >= 0.8 * len(cells[0])


def test_extraction_repeats_and_a_plain_image_has_none(dataset, features):
    again = extract_features(sample_frame(dataset[0], dataset.camera, settings()), dataset.camera, MAX_DEPTH_M)
    for name in ("descriptors", "positions", "points"):
        np.testing.assert_array_equal(getattr(again, name), getattr(features[0], name))
    plain = np.full((120, 160), 90, np.uint8)
    none = features_of_images(plain, plain.astype(np.uint16), dataset.camera, MAX_DEPTH_M)
    assert len(none) == 0
    assert none.with_depth().points.shape == (0, 3)


def test_matches_are_those_of_a_plain_search():
    earlier = random_features(60, 0).descriptors
    descriptors = earlier[10:40].copy()
    descriptors[:, :2] ^= 0b1010  # at most 4 of 256 bits
    descriptors[5] = np.random.default_rng(1).integers(0, 256, 32, dtype=np.uint8)  # like no other
    distances = np.unpackbits(descriptors[:, None] ^ earlier[None], axis=2).sum(2)
    two = np.sort(distances, 1)[:, :2]
    expected = [(i, distances[i].argmin()) for i in range(30) if two[i, 0] < 0.8 * two[i, 1]]
    tensor = torch.from_numpy(descriptors)
    np.testing.assert_array_equal(ratio_matches(tensor, [earlier])[0], expected)
    assert all(
        len(found[0]) == 0 for found in (ratio_matches(tensor, [earlier[:1]]), ratio_matches(tensor[:0], [earlier]))
    )


@pytest.mark.parametrize("apart", [4, 12])  # 6 cm and 7 degrees, 19 cm and 22 degrees
def test_the_pose_needs_no_start(dataset, features, apart):
    alignment = FeatureAlignment(features[apart], dataset.camera)
    matches = alignment.matches(features[0].with_depth(), pose_of(dataset, 0))
    pose = alignment.pose(matches, CPU)
    error = inverse(dataset.poses()[apart]) @ pose_matrix(pose)
    assert np.linalg.norm(error[:3, 3]) < BASIN_M
    assert np.degrees(rotation_angle(error[:3, :3])) < BASIN_DEG
    # Inliers by an independent projection.
    k = depth_image_intrinsics(dataset.camera)
    points = (matches.points - pose_matrix(pose)[:3, 3]) @ pose_matrix(pose)[:3, :3]
    u, v = k.fx * points[:, 0] / points[:, 2] + k.cx, k.fy * points[:, 1] / points[:, 2] + k.cy
    near = np.hypot(u - matches.positions[:, 0], v - matches.positions[:, 1]) < alignment.max_error_px
    assert alignment.inliers(matches, pose_matrix(pose)) == near.sum() >= MIN_INLIERS
    turned_away = pose.clone()
    turned_away[:4] = torch.tensor([0.0, 0.0, 1.0, 0.0])
    assert alignment.inliers(matches, pose_matrix(turned_away)) == 0


def test_noise_of_depth_is_no_contradiction_along_epipolar_lines(dataset, features):
    """Points measured a third too far off agree with a pose 19 cm away where depth is that noisy, and with no other."""
    pose, seen = pose_of(dataset, 12), features[0].with_depth()
    off, z = replace(seen, points=1.33 * seen.points), float(np.median(seen.points[:, 2]))
    rolled = pose_matrix(pose)
    rolled[:3, :3] = rolled[:3, :3] @ rotation_matrices(np.array([0.0, 0.0, 0.2]))

    def agreeing(noise, earlier, at=pose):
        alignment = FeatureAlignment(features[12], dataset.camera, depth_noise=noise)
        return alignment.inliers(alignment.matches(earlier, pose_of(dataset, 0)), pose_matrix(at))

    count, sure = agreeing((0.0, 0.0), seen), agreeing((0.0, 0.0), off)
    assert sure < 0.5 * count
    for noise in (((0.2 * z) ** 2, 0.0), (0.0, (0.2 / z) ** 2)):
        assert agreeing(noise, off) > 0.9 * count
        assert agreeing(noise, off, pose_tensor(rolled, CPU)) < 0.3 * count


def test_few_or_contradictory_matches_give_no_pose(dataset, features):
    alignment = FeatureAlignment(features[0], dataset.camera)
    matches = alignment.matches(features[3].with_depth(), pose_of(dataset, 3))
    assert alignment.pose(some_of(matches, np.arange(MIN_INLIERS - 1)), CPU) is None
    random = np.random.default_rng(0)
    nonsense = exact(random.uniform(-1, 1, (60, 3)) + (0, 0, 3), random.uniform(0, 120, (60, 2)))
    assert alignment.pose(nonsense, CPU) is None


def test_matches_with_several_frames_give_a_pose_together(dataset, features):
    """Each has too few; the same features matched twice are no more than they are once."""
    alignment = FeatureAlignment(features[4], dataset.camera)
    found = [alignment.matches(features[i].with_depth(), pose_of(dataset, i)) for i in (0, 2)]
    positions = alignment.features.positions.astype(np.float64)
    first = {tuple(position) for position in positions[: len(positions) // 2]}
    halves = []
    for matches, wanted in zip(found, (True, False), strict=True):
        good = np.array([(tuple(at) in first) == wanted for at in matches.positions])
        near = np.flatnonzero(good)[:: good.sum() // MIN_INLIERS][: MIN_INLIERS - 1]  # all over the image
        halves.append(some_of(matches, near))
    assert [alignment.pose(matches, CPU) for matches in halves] == [None, None]
    *each, together = joined_too(halves)
    assert each == halves
    error = inverse(dataset.poses()[4]) @ pose_matrix(alignment.pose(together, CPU))
    assert np.linalg.norm(error[:3, 3]) < BASIN_M
    assert alignment.pose(joined_too([halves[0], halves[0]])[-1], CPU) is None
    color_pose = dataset.poses()[4]
    counts = [alignment.inliers(matches, color_pose) for matches in halves]
    assert alignment.inliers(together, color_pose) == sum(counts) > MIN_INLIERS
    assert alignment.inliers(joined_too([halves[0], halves[0]])[-1], color_pose) == counts[0]
    assert joined_too(halves[:1]) == halves[:1]
    assert joined_too([]) == []


def test_the_store_keeps_what_has_depth_and_comes_back_from_a_checkpoint():
    store = FeatureStore()
    for frame in (0, 10, 13):
        features = random_features(5 + frame, frame)
        features.points[1, 2] = 0
        store.add(frame, features)
    assert [len(store[i]) for i in range(3)] == [4, 14, 17]
    other = FeatureStore()
    other.load_state_dict(store.tensors())
    assert other.frames == [0, 10, 13]
    for i in range(3):
        np.testing.assert_array_equal(other[i].descriptors, store[i].descriptors)
        np.testing.assert_array_equal(other[i].points, store[i].points)
    empty = FeatureStore()
    empty.load_state_dict(FeatureStore().tensors())
    assert len(empty) == 0


def test_a_full_store_drops_every_second_frame_of_the_older_half(monkeypatch):
    monkeypatch.setattr(feature_store, "MAX_FRAMES", 8)
    store = FeatureStore()
    for frame in range(0, 90, 10):
        store.add(frame, random_features(frame // 10, frame))
    assert store.frames == [0, 20, 40, 50, 60, 70, 80]
    assert [len(store[i]) for i in range(7)] == [0, 2, 4, 5, 6, 7, 8]


def test_a_view_that_is_known_well_enough_is_not_stored_again():
    store, near, far = FeatureStore(), np.eye(4), np.eye(4)
    near[0, 3], far[0, 3] = 0.1, 0.5
    turned = np.eye(4)
    turned[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.3, 0.0]))[0]
    assert not store.has_enough(np.zeros((0, 4, 4)), near)
    assert not store.has_enough(np.stack([np.eye(4), near, far, turned]), near)
    assert store.has_enough(np.stack([np.eye(4), near, far, near]), near)


def test_the_stored_frames_most_alike_come_first_and_all_get_their_turn(dataset, features, monkeypatch):
    state = SlamState.start(settings(), dataset.camera, np.eye(4), None, CPU)
    for i in range(20):
        pixels = sample_frame(dataset[i], dataset.camera, settings())
        state.frames.append(pose_of(dataset, i), i / 30, i, i == 7, pixels.depth_thumbnail)
        state.pixels.add(pixels.records)
        if i % 2:
            state.features.add(i, features[i])
    history, image = FrameHistory(state), FeatureAlignment(features[8], dataset.camera)
    assert history.feature_rows() == [1, 3, 5, 9, 11, 13, 15, 17, 19]
    assert retrieve_by_features(history, image, 20)[0] == 9  # 7 is lost
    monkeypatch.setattr(place_recognition, "NEWEST_COMPARED", 1)
    monkeypatch.setattr(place_recognition, "OTHERS_COMPARED", 2)
    seen = {row for frame in range(4) for row in retrieve_by_features(history, image, frame)}
    assert seen >= {1, 3, 5, 9, 11, 13, 15, 17}
    plain = FeatureAlignment(random_features(100, 0), dataset.camera)
    assert retrieve_by_features(history, plain, 20) == []


@pytest.mark.parametrize("features_are_used", [True, False])
def test_they_carry_the_camera_over_a_jump(dataset, features_are_used):
    """From frame 2 to frame 12, 15 cm and 18 degrees: too far for tracking, and for ICP from the last pose."""
    config = settings(f"tracking.features={str(features_are_used).lower()}", "tracking.relocalization_candidates=0")
    system = SlamSystem(config, dataset.camera, dataset.poses()[0])
    reports = [system.process(dataset[i]) for i in (0, 1, 2, 12)]
    error = inverse(dataset.poses()[12]) @ pose_matrix(system.state.frames.poses[-1])
    assert (np.linalg.norm(error[:3, 3]) < 0.01 and not reports[-1].lost) == features_are_used
    assert (reports[-1].fit.feature_inliers >= MIN_INLIERS) == features_are_used


@pytest.mark.parametrize("colors_off_px, counts", [(0.3, True), (0.8, False)])
def test_they_contradict_a_pose_only_where_colors_are_where_depth_is(dataset, features, colors_off_px, counts):
    image = FeatureAlignment(features[4], dataset.camera)
    matches = image.matches(features[2], pose_of(dataset, 2))
    noise = torch.tensor([1e-6, 1e-6, 1e-4, colors_off_px**2])
    problem = SimpleNamespace(constraints=Constraints(noise=noise))
    frame = DoubtfulFrame(problem, None, None, None, image, (image.counted(matches, pose_matrix(pose_of(dataset, 4))),))
    fit = frame.with_features(Fit(), pose_matrix(pose_of(dataset, 12)))
    assert fit.feature_inliers < MIN_INLIERS
    assert fit.feature_share < 0.5 if counts else np.isnan(fit.feature_share)


@pytest.mark.parametrize(("seconds", "is_turn"), [(1 / 30, True), (1.0, True), (1 / 300, False), (np.inf, True)])
def test_colors_of_a_turning_camera_may_be_late(dataset, features, seconds, is_turn):
    """By 20 ms of what the image moves in; not those of a camera that has jumped."""
    image = FeatureAlignment(features[4], dataset.camera)
    found = image.matches(features[2].with_depth(), pose_of(dataset, 2))
    assert found.motion_px > 3
    noise = torch.tensor([1e-6, 1e-6, 1e-4, 0.01])
    history = SimpleNamespace(seconds_since=lambda row: seconds)
    problem = SimpleNamespace(constraints=Constraints(noise=noise))
    frame = DoubtfulFrame(
        problem, None, history, None, image, (image.counted(found, pose_matrix(pose_of(dataset, 4))),)
    )
    late = frame.with_speed(2, [found])
    assert late.late_px == pytest.approx(0.02 * found.motion_px / seconds if is_turn else 0.0)
    assert frame.with_speed(2, []).late_px == 0
    # One frame's motion off: more than 20 ms of 33.
    off = pose_matrix(pose_of(dataset, 3))
    assert late.with_features(Fit(), off).feature_share >= frame.with_features(Fit(), off).feature_share
    assert late.with_features(Fit(), pose_matrix(pose_of(dataset, 4))).feature_share <= 1


def test_features_that_may_be_late_hold_a_pose_less(dataset, features):
    image = FeatureAlignment(features[4], dataset.camera)
    matches = [image.matches(features[2].with_depth(), pose_of(dataset, 2))]
    off = pose_of(dataset, 4)
    off[4] += 0.02
    information = np.diag([1e5] * 6)

    def moved_m(late_px):
        return np.linalg.norm((image.held(off.tolist(), information, matches, late_px) - off.numpy())[4:])

    assert moved_m(0.0) == moved_m(0.5 * image.max_error_px)
    assert moved_m(10.0) < 0.5 * moved_m(0.0)


@pytest.mark.parametrize(("share", "contradicts"), [(0.5, True), (0.2, False), (0.02, False)])
def test_few_features_of_a_frame_that_is_hardly_seen_contradict_nothing(dataset, features, share, contradicts):
    """Matches with an earlier frame that agree on another pose, beside many that agree with the right one."""
    image, pose = FeatureAlignment(features[4], dataset.camera), pose_of(dataset, 4)
    many = image.counted(image.matches(features[2].with_depth(), pose_of(dataset, 2)), image.color_pose(pose))
    assert many.agreeing > 40
    count = int(share * many.agreeing)
    few = some_of(many, np.arange(count))
    other = replace(few, points=few.points + 1.0, agreeing=count)
    frame = DoubtfulFrame(SimpleNamespace(constraints=Constraints()), None, None, None, image, (many, other))
    fit = frame.with_features(Fit(), pose_matrix(pose))
    assert (fit.feature_share < 0.2) == contradicts
    assert fit.feature_inliers == many.agreeing


@pytest.mark.parametrize(("is_asked", "eigenvalue"), [(True, 0.05), (False, 0.012)])
def test_features_are_expected_for_a_while_after_some_were_asked_for(dataset, features, is_asked, eigenvalue):
    """Or nearly, where surface leaves a direction almost so free."""
    keeper = FeatureKeeper(settings(), dataset.camera, ShutterRectifier(dataset.camera, MAX_DEPTH_M))
    plain = replace(TrackedFrame.untracked(torch.zeros(7), lost=True), fit=Fit(min_eigenvalue=0.05), occluded=True)
    asked = replace(plain, features=features[0] if is_asked else None, fit=Fit(min_eigenvalue=eigenvalue))
    expected = []
    for tracked in (plain, asked, *[plain] * EXPECTED_FRAMES):
        keeper.keep(None, None, None, tracked, None)
        expected.append(keeper.are_expected)
    assert expected == [False, *[True] * EXPECTED_FRAMES, False]


def blocks(depth):
    """Features of random blocks before a depth image uint16 [120, 160], 10 m being 65535."""
    intensity = np.kron(np.random.default_rng(3).integers(0, 255, (15, 20), np.uint8), np.ones((8, 8), np.uint8))
    camera = Camera(fx=150.0, fy=150.0, cx=79.5, cy=59.5, width=160, height=120)
    return features_of_images(intensity, depth, camera, 10.0)


def test_what_has_no_depth_behind_what_is_farthest_is_beyond_the_range():
    """On a floor that ends at 4 m, or where nothing is known around."""
    depth = np.zeros((120, 160), np.uint16)
    depth[70:] = np.linspace(4.0, 1.0, 50)[:, None] / 10 * 65535
    found = blocks(depth)
    rows = found.positions[:, 1]
    assert (found.points[:, 2] > 0)[rows > 71].all()
    assert not found.beyond_m[rows > 64].any()  # next to it
    assert (np.abs(found.beyond_m[rows < 60] - 4.0) < 0.1).all() and (rows < 60).sum() > 20
    assert found.with_depth().beyond_m is None


@pytest.mark.parametrize("hole", [slice(40, 46), slice(20, 100)])
def test_holes_are_not_beyond_the_range(hole):
    """Small ones anywhere; large ones on what is near beside something far."""
    depth = np.full((120, 160), 0.1 * 65535, np.uint16)
    depth[:, 140:] = 0.5 * 65535
    depth[hole, 30:110] = 0
    found = blocks(depth)
    column, row = found.positions.T
    inside = (column > 31) & (column < 109) & (row > hole.start + 1) & (row < hole.stop - 2)
    assert inside.sum() > 2 and not found.points[inside, 2].any()
    assert not found.beyond_m.any()


def test_an_image_without_depth_has_no_range():
    assert not blocks(np.zeros((120, 160), np.uint16)).beyond_m.any()


def test_rays_agree_with_where_the_camera_looks_not_with_how_far_it_went(dataset, features):
    image, pose = FeatureAlignment(features[4], dataset.camera), pose_matrix(pose_of(dataset, 4))
    k = depth_image_intrinsics(dataset.camera)
    positions = features[4].positions.astype(np.float64)
    rays = np.stack([(positions[:, 0] - k.cx) / k.fx, (positions[:, 1] - k.cy) / k.fy, np.ones(len(positions))], 1)
    seen = SeenRays(pose[:3, 3], rays @ pose[:3, :3].T, positions, np.full(len(positions), MAX_DEPTH_M))
    matches = replace(exact(np.zeros((0, 3)), np.zeros((0, 2))), rays=seen)

    def agreeing(turn_deg=0.0, moved_m=0.0):
        other = pose.copy()
        other[:3, :3] = rotation_matrices(np.radians([0.0, turn_deg, 0.0])) @ pose[:3, :3]
        other[:3, 3] += moved_m * pose[:3, 2]
        return image.ray_inliers(matches, other)

    assert agreeing() == agreeing(moved_m=0.1) == len(positions) > MIN_INLIERS
    assert agreeing(turn_deg=3 * np.degrees(np.arctan(image.max_error_px / k.fx))) == 0
    assert image.ray_inliers(replace(matches, rays=None), pose) == 0
