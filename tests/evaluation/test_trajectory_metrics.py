import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PosePath3D
from evo.core.units import Unit
from scipy.spatial.transform import Rotation

from spslam.datasets.seven_scenes import open_seven_scenes
from spslam.datasets.tum import open_tum
from spslam.evaluation.trajectory_metrics import absolute_errors, align, ate, rpe
from spslam.geometry import pose_from
from tests.datasets.layouts import shared_data

# Both compute in double precision; centimeters of a trajectory of meters.
EVO_TOLERANCE = 1e-6


def random_walk(count: int, seed: int) -> np.ndarray:
    generator = np.random.default_rng(seed)
    rotations = [np.eye(3)]
    for step in generator.normal(scale=0.03, size=(count - 1, 3)):
        rotations.append(rotations[-1] @ Rotation.from_rotvec(step).as_matrix())
    return pose_from(np.array(rotations), np.cumsum(generator.normal(scale=0.02, size=(count, 3)), axis=0))


def disturbed(poses: np.ndarray, seed: int, scale: float = 1.0) -> np.ndarray:
    """Poses with noise, in another world frame."""
    generator = np.random.default_rng(seed)
    noise = pose_from(
        Rotation.from_rotvec(generator.normal(scale=0.01, size=(len(poses), 3))).as_matrix(),
        generator.normal(scale=0.02, size=(len(poses), 3)),
    )
    world = pose_from(Rotation.random(random_state=seed).as_matrix(), [1.0, -2.0, 0.5])
    moved = world @ poses @ noise
    moved[:, :3, 3] *= scale
    return moved


def evo_ate(estimated, reference, with_scale):
    trajectory, ground_truth = PosePath3D(poses_se3=list(estimated)), PosePath3D(poses_se3=list(reference))
    trajectory.align(ground_truth, correct_scale=with_scale)
    metric = metrics.APE(metrics.PoseRelation.translation_part)
    metric.process_data((ground_truth, trajectory))
    return {name: 100 * value for name, value in metric.get_all_statistics().items()}


def evo_rpe(estimated, reference, relation, delta=1):
    metric = metrics.RPE(relation, delta=delta, delta_unit=Unit.frames, all_pairs=True)
    metric.process_data((PosePath3D(poses_se3=list(reference)), PosePath3D(poses_se3=list(estimated))))
    return metric.get_all_statistics()["rmse"]


def check_against_evo(estimated, reference):
    ours, theirs = ate(estimated, reference), evo_ate(estimated, reference, with_scale=False)
    for name in ("rmse", "median", "max"):
        assert ours[f"ate_{name}_cm"] == pytest.approx(theirs[name], abs=EVO_TOLERANCE)
    ours, theirs = ate(estimated, reference, with_scale=True), evo_ate(estimated, reference, with_scale=True)
    for name in ("rmse", "median", "max"):
        assert ours[f"ate_scaled_{name}_cm"] == pytest.approx(theirs[name], abs=EVO_TOLERANCE)
    for delta in (1, 7):
        ours = rpe(estimated, reference, delta)
        translation = evo_rpe(estimated, reference, metrics.PoseRelation.translation_part, delta)
        rotation = evo_rpe(estimated, reference, metrics.PoseRelation.rotation_angle_deg, delta)
        assert ours["rpe_cm"] == pytest.approx(100 * translation, abs=EVO_TOLERANCE)
        assert ours["rpe_deg"] == pytest.approx(rotation, abs=EVO_TOLERANCE)


@pytest.mark.parametrize("seed", range(5))
def test_random_trajectories_agree_with_evo(seed):
    reference = random_walk(60 + 40 * seed, seed)
    check_against_evo(disturbed(reference, seed + 100, scale=1 + 0.1 * seed), reference)


def test_real_trajectories_agree_with_evo():
    for dataset in (
        open_seven_scenes(shared_data("7scenes-redkitchen")),
        open_tum(shared_data("tum-fr1-rpy-60")),
    ):
        check_against_evo(disturbed(dataset.poses(), seed=3), dataset.poses())


def test_alignment_removes_the_world_transform_and_the_scale():
    reference = random_walk(50, 1)
    world = pose_from(Rotation.random(random_state=2).as_matrix(), [3.0, 1.0, -1.0])
    estimated = world @ reference
    assert ate(estimated, reference)["ate_max_cm"] < 1e-10
    assert rpe(estimated, reference)["rpe_cm"] < 1e-10
    assert rpe(estimated, reference)["rpe_deg"] < 1e-10
    estimated[:, :3, 3] *= 2
    assert ate(estimated, reference)["ate_rmse_cm"] > 1
    assert ate(estimated, reference, with_scale=True)["ate_scaled_rmse_cm"] < 1e-10
    assert ate(estimated, reference, with_scale=True)["ate_scale"] == pytest.approx(0.5)
    alignment = align(estimated, reference, with_scale=True)
    np.testing.assert_allclose(alignment.apply(estimated[:, :3, 3]), reference[:, :3, 3], atol=1e-12)


def test_frames_without_ground_truth_are_ignored():
    reference = random_walk(40, 4)
    estimated = disturbed(reference, 5)
    gaps = reference.copy()
    gaps[[0, 10, 11, 39]] = np.nan
    kept = np.isfinite(gaps).all(axis=(1, 2))
    assert ate(estimated, gaps) == pytest.approx(ate(estimated[kept], reference[kept]))
    errors = absolute_errors(estimated, gaps, align(estimated, gaps))
    assert np.isnan(errors).tolist() == (~kept).tolist()
    # Frames 1-9 and 12-38 have ground truth; there are no pairs across the gap.
    parts = [rpe(estimated[part], reference[part])["rpe_cm"] for part in (slice(1, 10), slice(12, 39))]
    expected = np.sqrt((8 * parts[0] ** 2 + 26 * parts[1] ** 2) / 34)
    assert rpe(estimated, gaps)["rpe_cm"] == pytest.approx(expected)


def test_no_frames_give_no_metrics():
    poses = random_walk(3, 0)
    unknown = np.full((3, 4, 4), np.nan)
    assert ate(poses, unknown) == {}
    assert rpe(poses, unknown) == {}
    assert ate(np.zeros((0, 4, 4)), np.zeros((0, 4, 4))) == {}
    assert rpe(poses[:1], poses[:1]) == {}
    assert rpe(poses, poses, delta=5) == {}
    assert ate(poses[:1], poses[:1])["ate_rmse_cm"] == pytest.approx(0, abs=1e-9)


def test_errors():
    poses = random_walk(4, 0)
    with pytest.raises(ValueError, match=r"align: estimated and reference must both have shape \(F, 4, 4\), got"):
        ate(poses, poses[:3])
    broken = poses.copy()
    broken[2, 0, 3] = np.nan
    with pytest.raises(ValueError, match="rpe: estimated must be finite, got a non-finite pose at frame 2"):
        rpe(broken, poses)
    with pytest.raises(ValueError, match="rpe: delta must be at least 1, got 0"):
        rpe(poses, poses, delta=0)
