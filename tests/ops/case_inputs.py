"""What the arguments of `cases` are made of: random tensors on a device, and numbers that the ops share."""

import torch

from spslam import ops

VOXEL = 0.04
LAYOUT = [0, -3, 2, 7, 5, 35, -3, -1, 7, 4, 63, 2, -1, 5, 4]
KEY = dict(seed=7, stream=ops.RandomStream.MAPPING_RAYS, frame=3, iteration=1)
CAMERA = dict(fx=60.0, fy=60.0, cx=31.5, cy=23.5)
SAMPLES = 21


def random_coords(generator, n, span=4):
    return torch.randint(-span, span, (n, 3), generator=generator, dtype=torch.int32)


def normal(generator, *shape):
    return torch.randn(*shape, generator=generator)


def uniform(generator, *shape):
    return torch.rand(*shape, generator=generator)


def on_device(device, values):
    return {name: value.to(device) if isinstance(value, torch.Tensor) else value for name, value in values.items()}
