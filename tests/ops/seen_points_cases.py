"""Valid calls of the ops of what frames see of a surface; see `cases`."""

import torch

from spslam import ops
from tests.ops.case_inputs import on_device, uniform

CAMERA = ops.Intrinsics(20.0, 20.0, 11.5, 7.5)
POSE = torch.tensor([1.0, 0, 0, 0, 0.02, -0.1, 0.05])


def see(generator, device, n):
    """`n` points before a camera, most of them seen."""
    points = torch.cat((uniform(generator, n, 2) - 0.5, 1 + 0.01 * uniform(generator, n, 1)), 1)
    normals = torch.tensor([0.0, 0.0, -1.0]).repeat(n, 1)
    surface = ops.SurfacePoints.of(points.to(device), normals.to(device))
    color = torch.randint(0, 256, (16, 24, 3), generator=generator).to(torch.uint8)
    images = dict(depth=1 + 0.1 * uniform(generator, 16, 24), color=color)
    return dict(surface=surface) | on_device(device, images | dict(pose=POSE, intrinsics=CAMERA, noise=(1e-6, 1e-6)))


def _seen(generator, n):
    colors = torch.randint(0, 256, (n, 3), generator=generator).to(torch.uint8)
    return dict(colors=colors, weights=uniform(generator, n))


def add_colors(generator, device, n):
    return on_device(device, dict(sums=uniform(generator, n, 4)) | _seen(generator, n))


def add_detail(generator, device, n):
    """`n` edges between as many points."""
    ends = torch.randint(0, max(n, 1), (n, 2), generator=generator)
    return on_device(device, dict(sums=uniform(generator, n, 5), ends=ends) | _seen(generator, 2 * n))
