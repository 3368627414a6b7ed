"""Frames of the generated room, and poses near theirs, for the tests of ops that compare frames."""

import numpy as np
import torch

from spslam.slam.pixels import sample_frame
from spslam.slam.poses import pose_tensor
from tests.system.sequences import settings


def sampled(recorded):
    """The pixels of all frames, on the CPU."""
    return [sample_frame(frame, recorded.camera, settings()) for frame in recorded]


def poses_of(recorded, device):
    """float32 [F, 7] of all frames."""
    return torch.stack([pose_tensor(pose, torch.device("cpu")) for pose in recorded.poses()]).to(device)


def moved(pose, seed):
    """A pose up to half a meter and 20 degrees off."""
    random = np.random.default_rng(seed)
    turn = random.normal(0, 0.15, 3)
    angle = np.linalg.norm(turn)
    x, y, z = turn / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    change = np.eye(4)
    change[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    change[:3, 3] = random.normal(0, 0.2, 3)
    return pose @ change
