"""The system as a program uses it, frame by frame: poses, mesh, reset, saving, deferred mapping, short reprs."""

import subprocess
import sys

import numpy as np
import pytest
import torch

import spslam
from spslam.datasets.base import RgbdFrame
from spslam.errors import DatasetError, OutputError
from spslam.slam.checkpoint import load_checkpoint
from spslam.slam.pixels import sample_frame
from spslam.slam.prepared_frame import PreparedFrame
from spslam.slam.system import SlamSystem
from tests.cli.command import ROOT
from tests.system.sequences import Recorded, settings


@pytest.fixture(scope="module")
def dataset():
    return Recorded(12)


def new_system(dataset, *overrides, **arguments):
    return SlamSystem(settings(*overrides, **arguments), dataset.camera, dataset.poses()[0])


def prepared(dataset, index, config):
    frame = dataset[index]
    return PreparedFrame(index, frame.timestamp, sample_frame(frame, dataset.camera, config))


def bytes_of(system):
    """Trajectory and map as bytes."""
    tensors = system.state.scene.tensors()
    return [system.state.frames.poses.numpy().tobytes(), *(tensors[name].numpy().tobytes() for name in sorted(tensors))]


def test_importing_the_package_loads_nothing_and_names_what_it_has():
    code = "import sys, spslam; assert 'SlamSystem' in dir(spslam); print({'torch', 'numpy'} & set(sys.modules))"
    code += "; print(spslam.SlamSystem, spslam.RgbdFrame, spslam.load_config)"
    ended = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert ended.stdout.startswith("set()\n<class 'spslam.slam.system.SlamSystem'>"), ended.stderr
    assert all(getattr(spslam, name) is not None for name in spslam.__all__)
    with pytest.raises(AttributeError, match="module 'spslam' has no attribute 'Slam'"):
        spslam.Slam  # noqa: B018


def test_a_report_has_the_pose_that_the_trajectory_has(dataset, device):
    system = SlamSystem(settings(), dataset.camera, dataset.poses()[0], device)
    told = []
    reports = [system.process(dataset[i], told.append) for i in range(7)]
    for report, pose, row in zip(reports, told, system.trajectory().poses, strict=True):
        assert report.pose.dtype == np.float64
        np.testing.assert_array_equal(report.pose, row)
        np.testing.assert_array_equal(report.pose, pose)
    assert np.linalg.norm(reports[6].pose[:3, 3] - dataset.poses()[6][:3, 3]) < 0.01


def test_a_lost_frame_has_no_pose(dataset):
    system, told = new_system(dataset), []
    system.process(dataset[0])
    frame = dataset[1]
    frame.depth[:] = 0
    report = system.process(frame, told.append)
    assert report.lost
    assert report.pose is None
    assert told == [None]
    assert "pose" not in report.log_row()


def test_the_pose_is_known_before_the_map_is_optimized(dataset, monkeypatch):
    system, order = new_system(dataset), []
    optimize = system.mapper.optimize
    monkeypatch.setattr(system.mapper, "optimize", lambda *args: order.append("map") or optimize(*args))
    for index in range(6):
        system.process(dataset[index], lambda pose: order.append("pose"))
    assert order == ["pose", "map", "pose", "pose", "pose", "pose", "pose", "map"]


def test_the_pose_is_told_before_the_frame_is_stored_so_a_callback_that_fails_changes_nothing(dataset):
    system, fresh, lengths = new_system(dataset), new_system(dataset), []
    for index in range(6):
        if index > 0:
            with pytest.raises(ZeroDivisionError):
                system.process(dataset[index], lambda pose: lengths.append(len(system.trajectory())) or 1 / 0)
        system.process(dataset[index])
        fresh.process(dataset[index])
    assert lengths == [1, 2, 3, 4, 5]
    assert bytes_of(system) == bytes_of(fresh)


@pytest.mark.parametrize("preset", ["balanced", "paper"])
def test_mapping_in_parts_gives_the_same_bytes(dataset, preset):
    whole, parts = new_system(dataset, preset=preset), new_system(dataset, preset=preset)
    for index in range(6):
        whole.process(dataset[index])
        report = parts.submit(prepared(dataset, index, parts.config), defer_mapping=True).result()
        assert report.mapping_iterations == 0
        while parts.optimize_map(3):
            pass
    assert bytes_of(whole) == bytes_of(parts)


def test_what_is_left_of_mapping_is_carried_over_up_to_a_limit(dataset):
    system = new_system(dataset, "mapping.iterations=12")
    left = []
    for index in range(12):
        system.submit(prepared(dataset, index, system.config), defer_mapping=True)
        left.append(system.mapping_left)
    assert left == [30] * 12  # as many as the first frame has
    assert system.optimize_map(10) == 10
    system.finish()
    assert system.mapping_left == system.optimize_map() == 0


def test_a_reset_system_is_as_new(dataset):
    system, fresh = new_system(dataset), new_system(dataset)
    for index in range(6):
        system.process(dataset[index])
    system.reset()
    assert len(system.trajectory()) == 0
    assert len(system.mesh().faces) == 0
    for index in range(6):
        system.process(dataset[index])
        fresh.process(dataset[index])
    assert bytes_of(system) == bytes_of(fresh)
    with pytest.raises(DatasetError, match="the first pose must lie within 10 km"):
        system.reset(np.diag([1.0, 1, 1, 1]) + 1e9)
    assert len(system.trajectory()) == 6


def test_a_saved_system_goes_on_as_it_would_have(dataset, tmp_path):
    path, system = tmp_path / "room.safetensors", new_system(dataset)
    for index in range(6):
        system.process(dataset[index])
    system.save(path)
    loaded = SlamSystem.load(path)
    assert loaded.config == system.config
    assert loaded.camera == system.camera
    for index in range(6, 11):
        np.testing.assert_array_equal(loaded.process(dataset[index]).pose, system.process(dataset[index]).pose)
    assert bytes_of(loaded) == bytes_of(system)
    assert len(loaded.mesh(0.05).faces) > 1000
    loaded.reset()
    np.testing.assert_allclose(loaded.process(dataset[0]).pose, dataset.poses()[0], atol=1e-6)


def test_files_that_hold_no_system_are_refused(dataset, tmp_path):
    with pytest.raises(OutputError, match=r"absent: no such checkpoint file"):
        SlamSystem.load(tmp_path / "absent")
    (tmp_path / "text").write_text("hello")
    with pytest.raises(OutputError, match=r"text: not a readable checkpoint"):
        SlamSystem.load(tmp_path / "text")
    system = new_system(dataset)
    system.process(dataset[0])
    system.state.scene.save(tmp_path / "map.safetensors")
    with pytest.raises(OutputError, match=r"map.safetensors: not a checkpoint of format"):
        SlamSystem.load(tmp_path / "map.safetensors")
    with pytest.raises(OutputError, match="can't be written"):
        system.save(tmp_path / "no folder" / "x")
    system.save(tmp_path / "whole")
    (tmp_path / "cut").write_bytes((tmp_path / "whole").read_bytes()[:-1000])
    with pytest.raises(OutputError, match="cut: not a readable checkpoint"):
        SlamSystem.load(tmp_path / "cut")
    load_checkpoint(tmp_path / "whole", new_system(dataset).state, system.config)  # it is a checkpoint, too


def test_systems_do_not_share_anything(dataset):
    alone, first, second = new_system(dataset), new_system(dataset), new_system(dataset)
    for index in range(6):
        alone.process(dataset[index])
    for index in range(6):
        first.process(dataset[index])
        second.process(dataset[11 - index])
    assert bytes_of(first) == bytes_of(alone)


def test_frames_without_a_number_are_numbered(dataset):
    system = new_system(dataset)
    for index in range(3):
        frame = dataset[index]
        report = system.process(RgbdFrame.from_arrays(frame.color, frame.depth, frame.timestamp))
        assert report.index == report.frame == index
        assert frame.index == index


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda f: (f.color, f.depth[::2]), ValueError, r"depth must have the camera's shape \(120, 160\)"),
        (lambda f: (f.color[..., :1], f.depth), ValueError, r"color must have the camera's shape \(120, 160, 3\)"),
        (lambda f: (f.color / 255, f.depth), TypeError, "color must be an array of uint8, got float64; RgbdFrame.from"),
        (lambda f: (f.color, (1000 * f.depth).astype("u2")), TypeError, "floating-point meters, got uint16"),
        (lambda f: (f.color, torch.from_numpy(f.depth)), TypeError, "floating-point meters, got Tensor"),
    ],
)
def test_wrong_images_are_refused_before_anything_is_done(dataset, change, error, message):
    system, frame = new_system(dataset), dataset[0]
    color, depth = change(frame)
    with pytest.raises(error, match=message):
        system.process(RgbdFrame(0, 0.0, color, depth))
    assert len(system.trajectory()) == 0


def test_a_time_that_is_no_finite_number_is_refused_before_anything_is_done(dataset):
    system = new_system(dataset)
    with pytest.raises(ValueError, match=r"SlamSystem\.process: timestamp must be a finite number of seconds, got nan"):
        system.process(RgbdFrame(0, float("nan"), dataset[0].color, dataset[0].depth))
    with pytest.raises(TypeError, match=r"SlamSystem\.process: timestamp must be a number of seconds, got str"):
        system.process(RgbdFrame(0, "0.0", dataset[0].color, dataset[0].depth))
    assert len(system.trajectory()) == 0


def test_reprs_are_one_short_line(dataset):
    system = new_system(dataset)
    report = system.process(dataset[0])
    shown = [repr(value) for value in (system, report, dataset[0], system.mesh(), system.trajectory())]
    assert shown[0].startswith("SlamSystem(160x120, cpu, 1 frames (0 lost), ")
    assert shown[1].startswith("FrameReport(frame 0, tracked, at (")
    assert shown[2].startswith("RgbdFrame(0, 160x120, t=0.000 s, depth in 100 % of the pixels, median ")
    assert shown[4] == "Trajectory(1 poses, 0 lost, 0.0 s)"
    assert all(len(text) < 120 and "\n" not in text for text in shown)
