"""A checkpoint that was changed from outside is one clear line, whatever was changed."""

import json

import pytest
import safetensors.torch
import torch

from spslam.datasets.generated import GeneratedDataset
from spslam.errors import OutputError
from spslam.slam.checkpoint import load_checkpoint, take_snapshot, write_snapshot
from spslam.slam.state import SlamState
from spslam.slam.system import SlamSystem
from tests.system.sequences import settings

CONFIG = settings(
    "mapping.first_iterations=2",
    "mapping.iterations=1",
    "mapping.every=1",
    "mapping.reset_moments=false",
    "mapping.optimize_poses=true",
    "mapping.decoder_rate=0.001",
    "pixels.per_frame=256",
    "prior.points_per_frame=256",
    "tracking.iterations=2",
)
SOURCE = {"data": {"frames": 5}, "next": 2, "clock": {"frames": 2, "wall_s": 0.5, "decode_s": 0.1}}


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """A checkpoint after two frames, as (tensors, header)."""
    dataset = GeneratedDataset(2, 64, 48)
    system = SlamSystem(CONFIG, dataset.camera)
    for frame in dataset:
        system.process(frame)
    path = tmp_path_factory.mktemp("checkpoint") / "checkpoint.safetensors"
    write_snapshot(path, take_snapshot(system.state, CONFIG, SOURCE, copy=False))
    with safetensors.safe_open(path, framework="pt") as file:
        header = json.loads(file.metadata()["spslam"])
        tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118 - not a dict
    return tensors, header


@pytest.fixture
def load(checkpoint, tmp_path):
    """Loads the checkpoint after a change of its tensors and its header, both copies."""

    def load(change):
        tensors = {name: tensor.clone() for name, tensor in checkpoint[0].items()}
        header = json.loads(json.dumps(checkpoint[1]))
        change(tensors, header)
        path = tmp_path / "checkpoint.safetensors"
        safetensors.torch.save_file(tensors, path, metadata={"spslam": json.dumps(header)})
        state = SlamState.start(
            CONFIG, GeneratedDataset(1, 64, 48).camera, torch.eye(4).numpy(), None, torch.device("cpu")
        )
        return load_checkpoint(path, state, CONFIG), state

    return load


def refused(load, change, message):
    with pytest.raises(OutputError, match=f"checkpoint.safetensors: a damaged checkpoint .*{message}") as error:
        load(change)
    assert "\n" not in str(error.value)


def test_a_solution_that_was_begun_from_no_poses_is_refused(load):
    def change(tensors, header):
        tensors["graph.numbers"][1] = 1
        tensors["graph.start"] = tensors["graph.start"][:0].clone()

    refused(load, change, "graph.start must have poses")


def test_an_unchanged_checkpoint_is_read(load, checkpoint):
    source, state = load(lambda tensors, header: None)
    assert source == SOURCE
    assert torch.equal(state.frames.poses, checkpoint[0]["frames.poses"])
    assert state.moments.keys() == {"embeddings", "texels", "geometry_decoder", "color_decoder", "poses"}


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        ("frames.poses", (2, 6), r"tensor frames.poses must be float32 \[2, 7\], got float32 \[2, 6\]"),
        ("frames.poses", (3, 7), r"tensor frames.timestamps must be float64 \[3\], got float64 \[2\]"),
        ("frames.depth_thumbnails", (2, 3, 3), r"must be float16 \[2, 3, 4\], got float16 \[2, 3, 3\]"),
        ("frames.lost", (), r"tensor frames.lost must be bool \[2\], got bool \[\]"),
        ("pixels.records", (2, 256, 2), r"must be int32 \[2, 256, 3\], got int32 \[2, 256, 2\]"),
        ("pixels.records", (1, 256, 3), r"must be int32 \[2, 256, 3\], got int32 \[1, 256, 3\]"),
        ("pixels.has_pixels", (5,), r"must be bool \[2\], got bool \[5\]"),
        ("depth_keyframes.images", (6, 48, 63), r"must be uint16 \[6, 48, 64\], got uint16 \[6, 48, 63\]"),
        ("depth_keyframes.intensities", (6, 48, 63), r"must be uint8 \[6, 48, 64\], got uint8 \[6, 48, 63\]"),
        ("noise.counts", (2, 32, 127), r"must be int32 \[2, 32, 128\], got int32 \[2, 32, 127\]"),
        ("depth_keyframes.frames", (7,), r"must be int64 \[6\], got int64 \[7\]"),
        ("depth_history.cells", (10, 48, 63), r"must be uint16 \[10, 48, 64\], got uint16 \[10, 48, 63\]"),
        ("depth_history.frames", (9,), r"must be int64 \[10\], got int64 \[9\]"),
        ("moments.geometry_decoder.first", (7,), r"must be float32 \[1473\], got float32 \[7\]"),
        ("moments.embeddings.second", (9, 8), r"must be float32 \[\d+, 8\], got float32 \[9, 8\]"),
    ],
)
def test_a_tensor_of_another_shape_is_refused(load, name, shape, message):
    refused(load, lambda tensors, _: tensors.update({name: tensors[name].new_zeros(shape)}), message)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("frames.poses", float("nan"), "tensor frames.poses must be finite"),
        ("frames.poses", 0.0, "tensor frames.poses must begin with unit quaternions"),
        ("frames.timestamps", float("inf"), "tensor frames.timestamps must be finite"),
        ("frames.indices", -1, "tensor frames.indices must be at least 0, got -1"),
        ("frames.depth_thumbnails", float("nan"), "tensor frames.depth_thumbnails must be finite"),
        ("frames.consistent_frames", -7, "tensor frames.consistent_frames must be at least 0, got -7"),
        ("pixels.records", -1, "tensor pixels.records must lie in the image, got a pixel beyond its width"),
        ("pixels.records", 48 << 16, "tensor pixels.records must lie in the image, got a pixel beyond its height"),
        ("depth_keyframes.frames", 2, "tensor depth_keyframes.frames must be below 2, got 2"),
        ("depth_history.frames", 2, "tensors depth_history.frames, .moving and .looked must be below 2"),
        ("depth_history.looked", 2, "tensors depth_history.frames, .moving and .looked must be below 2"),
        ("depth_history.found", -1, "tensor depth_history.found must be at least 0, got -1"),
        ("scene.planes.layout", 2**62, "layout of plane 0 must "),
        ("moments.poses.second", -1.0, "tensor moments.poses.second must be at least 0, got -1"),
    ],
)
def test_a_number_out_of_range_is_refused(load, name, value, message):
    refused(load, lambda tensors, _: tensors[name].fill_(value), message)


def test_truth_values_other_than_0_and_1_are_refused(load):
    def change(tensors, header):
        tensors["frames.lost"].view(torch.uint8).fill_(2)

    refused(load, change, "tensor frames.lost must be 0 or 1, got 2")


@pytest.mark.parametrize(
    "name", ["frames.poses", "scene.origin", "pixels.records", "depth_keyframes.images", "depth_history.cells"]
)
def test_a_missing_tensor_is_named(load, name):
    refused(load, lambda tensors, _: tensors.pop(name), f"tensors? {name} ")


def test_a_moment_without_the_other_is_refused(load):
    refused(load, lambda tensors, _: tensors.pop("moments.texels.second"), "moments.texels.second must both be there")


def test_fewer_moments_than_texels_are_refused(load):
    def change(tensors, header):
        for moment in ("first", "second"):
            tensors[f"moments.texels.{moment}"] = tensors[f"moments.texels.{moment}"][:5].clone()

    refused(load, change, r"tensor moments.texels.first must have at least \d+ rows, got 5")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda header: header.pop("source"), "source must contain data, next and clock"),
        (lambda header: header["source"].pop("data"), "source must contain data, next and clock"),
        (lambda header: header["source"].update(clock=[]), "source must contain data, next and clock"),
        (lambda header: header["source"].update(next=1), "next must be a whole number from 2 to"),
        (lambda header: header["source"].update(next="2"), "next must be a whole number from 2 to .*, got '2'"),
        (lambda header: header["source"].update(next=6), "frames must be a whole number from 6 to .*, got 5"),
        (lambda header: header["source"]["clock"].update(wall_s=float("nan")), "wall_s must be a finite number"),
        (lambda header: header["source"]["clock"].update(start_s="1"), "start_s must be a finite number"),
        (lambda header: header["source"]["clock"].update(other=1), "clock must contain frames, wall_s, decode_s and"),
        (lambda header: header.update(steps=-1), "steps must be a whole number from 0 to 536870912, got -1"),
        (lambda header: header.update(stamp=2**31), "stamp must be a whole number from 0 to 536870912"),
        (lambda header: header.update(unmapped=1), "unmapped must be true or false, got 1"),
        (lambda header: header.pop("unmapped"), "unmapped must be true or false, got None"),
    ],
)
def test_a_header_out_of_range_is_refused(load, change, message):
    refused(load, lambda _, header: change(header), message)


@pytest.mark.parametrize(
    ("tensors", "segment", "message"),
    [
        ({"unjoined.counts": [3]}, None, "unjoined.counts must add up"),
        (
            {"unjoined.counts": [1], "unjoined.rows": [2], "unjoined.poses": [[1.0, 0, 0, 0, 0, 0, 0]]},
            None,
            "frames of",
        ),
        ({}, "x", "segment must be an object, got"),
        ({}, {"first": 1}, "tensor scene.origin is missing"),
    ],
)
def test_segments_that_can_not_be_are_refused(load, tensors, segment, message):
    def change(known, header):
        known.update({name: torch.tensor(value) for name, value in tensors.items()})
        if segment is not None:
            header["segment"] = segment

    refused(load, change, message)
