"""Valid calls of the ops of signed distance blocks; see `cases`."""

import torch

from spslam import ops
from tests.ops.case_inputs import on_device, uniform

CAMERA = ops.Intrinsics(20.0, 20.0, 11.5, 7.5)
POSE = torch.tensor([1.0, 0, 0, 0, 0.02, -0.1, 0.05])
SIZES = dict(voxel_size=0.05, truncation=0.15)


def planes(generator, device, n):
    """`n` rows of an image 24 px wide."""
    return on_device(device, dict(depth=1 + 0.01 * uniform(generator, n, 24), intrinsics=CAMERA, noise=(1e-6, 1e-6)))


def touched_blocks(generator, device, n):
    image = ops.measure_planes(**planes(generator, "cpu", n))
    return on_device(device, dict(planes=image, pose=POSE, intrinsics=CAMERA, **SIZES, step=2))


def integrate(generator, device, n):
    """`n` blocks, of which a frame sees some."""
    steps = torch.arange(n, dtype=torch.int32)
    coords = torch.stack((steps % 5 - 2, steps // 5 % 5 - 2, steps // 25), 1)
    call = touched_blocks(generator, "cpu", 16) | dict(
        block_coords=coords,
        sdf=uniform(generator, n, 512),
        weights=uniform(generator, n, 512),
        colors=torch.zeros(n, 512, 4, dtype=torch.uint16),
        color=torch.randint(0, 256, (16, 24, 3), generator=generator).to(torch.uint8),
        max_weight=10.0,
    )
    call.pop("step")
    return on_device(device, call)


def _field(generator):
    volume = ops.TsdfVolume(**SIZES)
    volume.integrate(1 + 0.01 * uniform(generator, 16, 24), POSE, CAMERA)
    names = ("hash_keys", "hash_values", "sdf", "weights", "colors")
    return dict(zip(names, volume.field(), strict=True)) | dict(voxel_size=volume.voxel_size, min_weight=1e-3)


def query(generator, device, n):
    points = (uniform(generator, n, 3) - 0.5) * 0.6 + torch.tensor([0.0, 0.0, 1.0])
    return on_device(device, _field(generator) | dict(points=points))


def ray_cast(generator, device, n):
    """`n` rows of 8 px."""
    view = dict(pose=POSE, intrinsics=CAMERA, size=(8, n), depth_range=(0.1, 3.0))
    return on_device(device, _field(generator) | view)
