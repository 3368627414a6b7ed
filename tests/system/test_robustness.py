"""Difficult sequences and systems: missing depth, black frames, limits, full disks."""

import resource

import numpy as np
import pytest

from spslam.camera import Camera
from spslam.datasets import registry
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.errors import DatasetError, OutputError, SpslamError
from spslam.run.sequence import RunRequest, run_sequence
from spslam.slam.system import SlamSystem
from spslam.trajectory import Trajectory
from tests.system.sequences import Recorded, run_on, settings, without_depth


def unreadable(*indices):
    def change(frame):
        if frame.index in indices:
            raise DatasetError(f"frame-{frame.index:06d}.color.png: can't be read")

    return change


def path_error_m(output, dataset, rows):
    """Largest distance from the true path at some rows of the trajectory, which starts at the true first pose."""
    found = Trajectory.load_tum(output / "trajectory.txt").poses
    ground_truth = dataset.poses()[-len(found) :] if len(found) < len(dataset) else dataset.poses()
    return np.linalg.norm(found[rows, :3, 3] - ground_truth[rows, :3, 3], axis=1).max()


def test_unreadable_frame_is_skipped_and_counted(monkeypatch, tmp_path):
    dataset = Recorded(8, unreadable(3))
    metrics = run_on(monkeypatch, dataset, tmp_path / "out")
    assert (metrics["frames"], metrics["skipped_frames"], metrics["lost_frames"]) == (7, 1, 0)
    times = Trajectory.load_tum(tmp_path / "out" / "trajectory.txt").timestamps
    np.testing.assert_allclose(times, np.delete(dataset.timestamps(), 3), atol=1e-6)
    assert metrics["ate_max_cm"] < 1.5


def frozen_depth(*indices):
    """The frames get the depth of frame `indices[0] - 1`, as from a stream that has frozen."""

    def change(frame):
        if frame.index in indices:
            frame.depth[:] = Recorded(indices[0])[indices[0] - 1].depth

    return change


def test_frames_with_frozen_depth_are_skipped_and_named(monkeypatch, tmp_path):
    dataset = Recorded(12, frozen_depth(5, 6, 7))
    metrics = run_on(monkeypatch, dataset, tmp_path / "out")
    assert (metrics["frames"], metrics["skipped_frames"], metrics["lost_frames"]) == (9, 3, 0)
    assert metrics["ate_max_cm"] < 1.5
    (first, *_) = (tmp_path / "out" / "skipped.jsonl").read_text().splitlines()
    assert "frame 5: the depth image is the same as in the frame before" in first


def test_no_readable_frame_is_one_line(monkeypatch, tmp_path):
    with pytest.raises(DatasetError, match="no frame can be read; the first: frame-000000.color.png: can't be read"):
        run_on(monkeypatch, Recorded(3, unreadable(0, 1, 2)), tmp_path / "out")


def test_frames_without_depth_are_lost_and_tracking_recovers(monkeypatch, tmp_path):
    dataset = Recorded(12, without_depth(5, 6))
    metrics = run_on(monkeypatch, dataset, tmp_path / "out")
    assert (metrics["frames"], metrics["lost_frames"]) == (12, 2)
    assert Trajectory.load_tum(tmp_path / "out" / "trajectory.txt").lost.nonzero()[0].tolist() == [5, 6]
    assert path_error_m(tmp_path / "out", dataset, [0, 4, 7, 8, 11]) < 0.03


@pytest.mark.parametrize("change", [without_depth(0, 1), unreadable(0, 1)])
def test_map_starts_with_the_first_frame_that_has_depth(monkeypatch, tmp_path, change):
    metrics = run_on(monkeypatch, Recorded(8, change), tmp_path / "out", "mapping.optimize_poses=true")
    assert metrics["lost_frames"] + metrics["skipped_frames"] == 2
    assert metrics["voxels"] > 1000
    poses = Trajectory.load_tum(tmp_path / "out" / "trajectory.txt").poses
    # The first mapped frame, the third, keeps its pose.
    first_mapped = poses[-6]
    np.testing.assert_allclose(first_mapped, Recorded(8).poses()[2], atol=1e-6)


def test_sequence_without_any_depth_is_one_line(monkeypatch, tmp_path):
    with pytest.raises(DatasetError, match="recorded: all frames are lost: none shows a surface between"):
        run_on(monkeypatch, Recorded(3, without_depth(0, 1, 2)), tmp_path / "out", mesh=True)
    assert not (tmp_path / "out" / "mesh.ply").exists()


def test_black_frames_are_tracked_by_their_depth(monkeypatch, tmp_path):
    def change(frame):
        if frame.index in (3, 4):
            frame.color[:] = 0

    metrics = run_on(monkeypatch, Recorded(8, change), tmp_path / "out")
    assert metrics["lost_frames"] == 0
    assert metrics["ate_max_cm"] < 1


def test_nonfinite_depth_is_ignored(monkeypatch, tmp_path):
    def change(frame):
        if frame.index in (0, 4):
            frame.depth[20:60, 20:90] = np.nan
            frame.depth[0, :] = np.inf
            frame.depth[1, :] = -np.inf

    metrics = run_on(monkeypatch, Recorded(8, change), tmp_path / "out", "run.previews=2", mesh=True)
    assert metrics["lost_frames"] == 0
    assert metrics["ate_max_cm"] < 1


def test_depth_beyond_the_limit_is_invalid(monkeypatch, tmp_path):
    def change(frame):
        if frame.index == 3:
            frame.depth *= 1e6

    assert run_on(monkeypatch, Recorded(5, change), tmp_path / "out")["lost_frames"] == 1


def test_noise_does_not_start_the_map():
    dataset = Recorded(3)
    system = SlamSystem(settings(), dataset.camera)
    frame = dataset[0]
    frame.depth[:] = np.random.default_rng(0).uniform(0.5, 5, frame.depth.shape)
    assert system.process(frame).lost
    assert not system.process(dataset[1]).lost
    np.testing.assert_allclose(system.trajectory().poses[1], np.eye(4), atol=1e-6)


@pytest.mark.parametrize("count", [1, 2])
def test_shortest_sequences(monkeypatch, tmp_path, count):
    metrics = run_on(monkeypatch, Recorded(count), tmp_path / "out", "run.previews=3", mesh=True)
    assert metrics["frames"] == count
    assert metrics["ate_max_cm"] < 1
    assert all(np.isfinite(value) for value in metrics.values() if isinstance(value, float))
    assert (tmp_path / "out" / "report.html").stat().st_size > 1000


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("scene.max_voxels=18000", "voxels must stay within scene.max_voxels = 18000"),
        ("scene.max_texels=1000", "texels must stay within scene.max_texels = 1000"),
        ("pixels.budget_mb=0.001", "pixels.budget_mb must hold at least one frame"),
    ],
)
def test_exceeded_limit_is_one_line(monkeypatch, tmp_path, override, message):
    with pytest.raises(SpslamError, match=message) as error:
        run_on(monkeypatch, Recorded(12), tmp_path / "out", override, "run.checkpoint_every=2")
    assert "\n" not in str(error.value)


def test_run_resumes_with_a_higher_voxel_limit(monkeypatch, tmp_path):
    run_on(monkeypatch, Recorded(12), tmp_path / "whole")
    with pytest.raises(SpslamError, match="max_voxels"):
        run_on(monkeypatch, Recorded(12), tmp_path / "out", "scene.max_voxels=18000", "run.checkpoint_every=2")
    run_on(monkeypatch, Recorded(12), tmp_path / "out", resume=True)
    whole, resumed = ((tmp_path / name / "trajectory.txt").read_bytes() for name in ("whole", "out"))
    assert whole == resumed


def test_first_pose_too_far_away_is_one_line():
    pose = np.eye(4)
    pose[0, 3] = 500_000
    with pytest.raises(DatasetError, match="the first pose must lie within 10 km .* got 500 km; scene.first_pose=iden"):
        SlamSystem(settings(), Recorded(1).camera, pose)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (np.eye(3), r"must have shape \(4, 4\), got \(3, 3\)"),
        (np.array([1.0, 0, 0, 0, 0, 0, 0]), r"must have shape \(4, 4\), got \(7,\)"),
        (np.diag([2.0, 2, 2, 1]), "must be a rotation and a translation"),
        (np.diag([1.0, 1, -1, 1]), "must be a rotation and a translation"),
        (
            np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1]]),
            r"must be .* above the row \(0, 0, 0, 1\), got",
        ),
    ],
    ids=["rotation", "row", "scaled", "mirrored", "transposed"],
)
def test_first_poses_that_are_none_are_refused(pose, message):
    with pytest.raises(ValueError, match=f"SlamSystem: first_pose {message}"):
        SlamSystem(settings(), Recorded(1).camera, pose)


@pytest.fixture
def tiny_disk():
    """Limits the size of files, as on a full disk; Python turns the signal into an OSError."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_full_disk_leaves_nothing_half_written(monkeypatch, tmp_path, tiny_disk):
    output = tmp_path / "out"
    tiny_disk(200_000)
    with pytest.raises(OutputError, match=r"map.safetensors: can't be written") as error:
        run_on(monkeypatch, Recorded(3), output)
    assert "\n" not in str(error.value)
    assert sorted(path.name for path in output.iterdir()) == ["config.yaml", "log.jsonl", "trajectory.txt"]


def test_full_disk_keeps_the_checkpoint_before(monkeypatch, tmp_path, tiny_disk):
    output = tmp_path / "out"

    def progress(done, total, report):
        if done == 3:
            tiny_disk((output / "checkpoint.safetensors").stat().st_size)

    with pytest.raises(OutputError, match=r"checkpoint.safetensors: can't be written"):
        run_on(monkeypatch, Recorded(8), output, "run.checkpoint_every=2", progress=progress)
    tiny_disk(resource.RLIM_INFINITY)
    assert not list(output.glob(".*"))
    assert run_on(monkeypatch, Recorded(8), output, resume=True)["frames"] == 8


class Tiny(RgbdDataset):
    """Frames so small that their co-visibility thumbnail has a single cell."""

    name, camera = "tiny", Camera(16, 16, 14, 14, 7.5, 7.5)

    def __len__(self):
        return 4

    def timestamps(self):
        return np.arange(4.0)

    def poses(self):
        return None

    def read(self, index):
        depth = np.full((16, 16), 1.0, np.float32)
        return RgbdFrame(index, float(index), np.zeros((16, 16, 3), np.uint8), depth)


def test_tiny_images_work(monkeypatch, tmp_path):
    overrides = ("mapping.frames=2", "mapping.recent=1", "mapping.covisible=1", "mapping.every=1")
    assert run_on(monkeypatch, Tiny(), tmp_path / "out", *overrides)["frames"] == 4


def test_every_nth_frame(monkeypatch, tmp_path):
    monkeypatch.setattr(registry, "open_dataset", lambda *_: Recorded(9))
    metrics = run_sequence(RunRequest(settings(), None, tmp_path / "out", slice(1, None, 3), mesh=False))
    found = Trajectory.load_tum(tmp_path / "out" / "trajectory.txt")
    assert metrics["frames"] == 3
    np.testing.assert_allclose(found.timestamps, Recorded(9).timestamps()[1::3], atol=1e-6)
    np.testing.assert_allclose(found.poses[0], Recorded(9).poses()[1], atol=1e-6)
