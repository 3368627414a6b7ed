"""The images that tracking keeps: which, for how long, what of a lost frame; and what they are good for."""

import numpy as np
import pytest
import torch

from spslam.camera import Camera
from spslam.evaluation.trajectory_metrics import ate
from spslam.slam.depth_keyframes import DepthKeyframeStore, depth_image_step
from spslam.slam.pixels import sample_frame
from spslam.slam.system import SlamSystem
from tests.system.sequences import Recorded, settings

CAMERA = Camera(8, 6, 10.0, 10.0, 4.0, 3.0)


def image(frame):
    return torch.full((6, 8), frame + 1, dtype=torch.int32).to(torch.uint16)


def filled(frames, skipped=()):
    store = DepthKeyframeStore(CAMERA, max_depth_m=6.5535, kernel_m=0.01)
    for frame in range(frames):
        if frame not in skipped:
            store.add(frame, image(frame), image(frame).to(torch.uint8))
    return store


def used(store, frame, lost=()):
    """Numbers of the frames whose images are used for a frame, by what the images hold."""
    is_lost = np.zeros(frame, bool)
    is_lost[list(lost)] = True
    views = store.select(frame, lambda row: bool(is_lost[row]), torch.zeros(frame, 7))
    if views is None:
        return []
    assert all(int(views.images[row][0, 0]) == of + 1 for row, of in views.rows)
    return [of for _, of in views.rows]


@pytest.mark.parametrize(
    ("frame", "want"),
    [
        (0, []),
        (1, [0]),
        (10, [9, 0]),
        (19, [18, 0]),
        (20, [19, 10]),
        (40, [39, 30, 0]),
        (57, [56, 40, 10]),
        (123, [122, 110, 80]),
    ],
)
def test_the_last_frame_and_two_older_ones_are_used(frame, want):
    assert used(filled(frame), frame) == want


def test_lost_frames_and_frames_without_an_image_are_left_out():
    assert used(filled(57, skipped=(40,)), 57) == [56, 10]
    assert used(filled(57), 57, lost=(56, 10)) == [40]
    assert used(filled(57, skipped=(56,)), 57) == [40, 10]
    assert used(filled(57, skipped=range(10, 57)), 57) == []


def test_a_view_has_the_units_and_the_camera_of_its_pixels():
    store = filled(1)
    views = store.select(1, lambda _: False, torch.zeros(1, 7))
    assert views.unit == pytest.approx(1e-4)
    assert views.kernel_end == 0.01
    assert views.intrinsics == (10.0, 10.0, 4.0, 3.0)
    wide = Camera(1281, 721, 1000.0, 1000.0, 640.0, 360.0)
    assert depth_image_step(wide) == 3
    assert DepthKeyframeStore(wide, 10.0, 0.01).images.shape == (6, 241, 427)


def test_what_a_checkpoint_holds_brings_everything_back():
    store, other = filled(57), filled(0)
    other.load_state_dict({name: tensor.clone() for name, tensor in store.tensors().items()})
    assert used(other, 57) == used(store, 57) == [56, 40, 10]


@pytest.mark.parametrize("depth_keyframes", ["true", "false"])
def test_a_frames_image_is_its_depth(depth_keyframes):
    """Also without depth keyframes, because verification compares brightness where it sees known surface."""
    dataset, config = Recorded(1), settings(f"tracking.depth_keyframes={depth_keyframes}")
    view = sample_frame(dataset[0], dataset.camera, config).depth_image
    unit = config.dataset.max_depth_m / 65535
    np.testing.assert_allclose(view.numpy() * unit, dataset[0].depth, atol=0.51 * unit)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_they_make_the_path_exact_where_depth_is(seed):
    """Half the error at least over a second of exact depth, and below a millimeter in every seed."""
    dataset, errors = Recorded(25), {}
    for on in ("true", "false"):
        config = settings(f"tracking.depth_keyframes={on}", f"seed={seed}")
        system = SlamSystem(config, dataset.camera, dataset.poses()[0])
        for frame in dataset:
            system.process(frame)
        system.finish()
        errors[on] = ate(system.trajectory().poses, dataset.poses())["ate_rmse_cm"]
    assert errors["true"] < min(0.1, 0.5 * errors["false"]), errors
