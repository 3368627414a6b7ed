import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spslam.errors import DatasetError
from spslam.geometry import pose_from
from spslam.trajectory import Trajectory


def make_trajectory(count: int) -> Trajectory:
    rotations = Rotation.random(max(count, 1), random_state=0).as_matrix()[:count]
    translations = np.random.default_rng(0).normal(size=(count, 3))
    return Trajectory(1305031229.5 + np.arange(count) / 30, pose_from(rotations, translations))


def test_round_trip(tmp_path):
    trajectory = make_trajectory(7)
    trajectory.save_tum(tmp_path / "trajectory.txt")
    loaded = Trajectory.load_tum(tmp_path / "trajectory.txt")
    np.testing.assert_allclose(loaded.timestamps, trajectory.timestamps, atol=5.1e-7)
    np.testing.assert_allclose(loaded.poses, trajectory.poses, atol=1e-8)
    np.testing.assert_array_equal(loaded.lost, trajectory.lost)


def test_ground_truth_is_masked_where_the_frame_is_lost():
    ground_truth, lost = make_trajectory(3).poses, [True, False, True]
    known = Trajectory(np.arange(3.0), ground_truth[::-1], lost).mask_lost(ground_truth)
    np.testing.assert_array_equal(np.isnan(known).all((1, 2)), lost)
    np.testing.assert_array_equal(known[1], ground_truth[1])


def test_lost_frames_have_no_pose_in_the_file(tmp_path):
    poses = make_trajectory(7).poses
    trajectory = Trajectory(np.arange(7) / 30, poses, [True, False, True, False, False, True, True])
    trajectory.save_tum(tmp_path / "trajectory.txt")
    lines = (tmp_path / "trajectory.txt").read_text().splitlines()[1:]
    assert [line for line in lines if line.startswith("#")] == [
        "# lost 0.000000", "# lost 0.066667", "# lost 0.166667", "# lost 0.200000",
    ]  # fmt: skip
    loaded = Trajectory.load_tum(tmp_path / "trajectory.txt")
    np.testing.assert_array_equal(loaded.lost, trajectory.lost)
    np.testing.assert_allclose(loaded.timestamps, trajectory.timestamps, atol=5.1e-7)
    # Lost frames hold the last known pose, so that all poses are finite.
    np.testing.assert_allclose(loaded.poses, poses[[1, 1, 1, 3, 4, 4, 4]], atol=1e-8)
    np.testing.assert_array_equal(loaded.poses.round(6), trajectory.poses.round(6))


def test_a_trajectory_without_any_known_pose(tmp_path):
    Trajectory([0.0, 1.0], make_trajectory(2).poses, [True, True]).save_tum(tmp_path / "t.txt")
    loaded = Trajectory.load_tum(tmp_path / "t.txt")
    assert loaded.lost.all()
    np.testing.assert_array_equal(loaded.poses, [np.eye(4)] * 2)


def test_the_same_trajectory_gives_the_same_bytes(tmp_path):
    for name in ("a.txt", "b.txt"):
        make_trajectory(4).save_tum(tmp_path / name)
    assert (tmp_path / "a.txt").read_bytes() == (tmp_path / "b.txt").read_bytes()
    assert (tmp_path / "a.txt").read_text().startswith("# timestamp tx ty tz qx qy qz qw\n1305031229.500000 ")


def test_a_line_has_the_translation_then_the_quaternion_with_w_last(tmp_path):
    quarter_turn = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    Trajectory([0.5], pose_from(quarter_turn, [1, 2, 3])[None]).save_tum(tmp_path / "t.txt")
    numbers = [float(word) for word in (tmp_path / "t.txt").read_text().splitlines()[1].split()]
    np.testing.assert_allclose(numbers, [0.5, 1, 2, 3, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-9)


def test_empty(tmp_path):
    Trajectory([], []).save_tum(tmp_path / "t.txt")
    assert len(Trajectory.load_tum(tmp_path / "t.txt")) == 0


def test_broken_files(tmp_path):
    path = tmp_path / "t.txt"
    with pytest.raises(DatasetError, match=r"t\.txt: no such file"):
        Trajectory.load_tum(path)
    for line in (
        "0 1 2 3 0 0 0",
        "0 1 2 3 0 0 0 0",
        "0 1 2 nan 0 0 0 1",
        "0 1 2 x 0 0 0 1",
        "0 1 2 3 0 0 0 1e-200",
        "0 1 2 3 1e300 0 0 1",
    ):
        path.write_text(f"# comment\n{line}\n")
        with pytest.raises(DatasetError, match=r"t\.txt, line 2: must be `timestamp tx"):
            Trajectory.load_tum(path)


def test_wrong_shapes():
    with pytest.raises(ValueError, match=r"poses must have shape \(2, 4, 4\), got \(3, 4, 4\)"):
        Trajectory(np.zeros(2), np.zeros((3, 4, 4)))
    with pytest.raises(ValueError, match=r"lost must have shape \(1,\), got \(2,\)"):
        Trajectory(np.zeros(1), np.zeros((1, 4, 4)), np.zeros(2, dtype=bool))
