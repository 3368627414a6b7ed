"""Jumps of the camera: which frames share surface with another one."""

import argparse

import numpy as np

from experiments.basin import COVISIBLE, jumped, seen_share
from experiments.fault_injection import apart
from spslam.geometry import inverse
from tests.system.sequences import Recorded


def test_jumps_are_as_far_as_wanted_and_share_surface():
    dataset = Recorded(30)
    poses, args = dataset.poses(), argparse.Namespace(least=8, most=30, trials=3)
    found = jumped(dataset, poses, 2, args, np.random.default_rng(0))
    assert 0 < len(found) <= 3
    for index in found:
        cm, deg = apart(poses[index], poses[2])
        assert 8 < cm < 30
        assert 8 < deg < 30
        relative = inverse(poses[2]) @ poses[index]
        assert seen_share(dataset[index].depth, dataset[2].depth, relative, dataset.camera) >= COVISIBLE


def test_a_frame_sees_all_of_itself_and_nothing_of_what_is_behind_it():
    frame, camera = Recorded(1)[0], Recorded(1).camera
    assert seen_share(frame.depth, frame.depth, np.eye(4), camera) == 1
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    assert seen_share(frame.depth, frame.depth, behind, camera) == 0
    assert seen_share(0 * frame.depth, frame.depth, np.eye(4), camera) == 0
