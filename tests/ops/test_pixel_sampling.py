"""Pixels drawn from a frame, against NumPy: bit for bit on the CPU, where all but normals is on CUDA too."""

import dataclasses
import threading

import numpy as np
import pytest
import torch

from spslam import ops
from spslam.geometry import quaternion_to_matrix
from tests.ops.arguments import opcheck
from tests.reference import pixel_sampling as reference

CAMERA = (61.0, 59.5, 33.2, 21.7)
SAMPLING = ops.PixelSampling(
    1000, min_depth=0.1, max_depth=6.0, step_px=3, max_jump=0.05, thumbnail_step=16, depth_image_step=2
)
# Float32 points within some meters.
POINT_TOLERANCE_M = 2e-6
# Of unit normals by another order of operations; noise of millimeters between pixels makes some of them out of little.
NORMAL_TOLERANCE = 1e-4
KEY = (2**33 + 5, ops.RandomStream.PIXEL_DATABASE, 17)


def frame(generator, height=50, width=70, noise=0.004):
    """Depth of a slanted wall with a box before it, holes and what sensors return for nothing; random colors."""
    v, u = np.mgrid[:height, :width]
    depth = 2.0 + 0.01 * (u - 31) - 0.004 * (v - 23)
    depth[10:30, 20:40] -= 0.5
    depth += noise * torch.randn(height, width, generator=generator).numpy()
    depth[40:44, 5:9] = 0
    depth[5, 50], depth[6, 52], depth[20, 10], depth[8, 8], depth[9, 9] = np.nan, np.inf, -1, 0.05, 6.1
    color = torch.randint(0, 256, (height, width, 3), generator=generator, dtype=torch.uint8)
    return torch.from_numpy(depth.astype(np.float32)), color


def split(buffer, sampling, shape):
    """Records, normals, depth thumbnail, small depth image and intensity image as the buffer holds them."""
    (h, w), (rows, columns) = sampling.thumbnail_shape(*shape), sampling.depth_image_shape(*shape)
    words, depth_thumbnail, depth_image, intensities = buffer.split(
        [6 * sampling.count, (h * w + 1) // 2, (rows * columns + 1) // 2, (rows * columns + 3) // 4]
    )
    records, normals = words.view(2, sampling.count, 3)
    depth_thumbnail, depth_image = depth_thumbnail.view(torch.float16), depth_image.view(torch.uint16)
    assert not depth_thumbnail[h * w :].any()
    intensities = intensities.view(torch.uint8)
    assert not depth_image[rows * columns :].any() and not intensities[rows * columns :].any()
    return (
        records,
        normals.view(torch.float32),
        depth_thumbnail[: h * w].view(h, w),
        depth_image[: rows * columns].view(rows, columns),
        intensities[: rows * columns].view(rows, columns),
    )


def check_against_numpy(depth, color, sampling, device):
    buffer, num_valid = ops.sample_frame_pixels(depth.to(device), color.to(device), *CAMERA, sampling, *KEY)
    assert buffer.device.type == device.type
    records, normals, depth_thumbnail, depth_image, intensities = split(buffer.cpu(), sampling, depth.shape)
    want = reference.sample_frame_pixels(depth.numpy(), color.numpy(), *CAMERA, sampling, *KEY)
    assert num_valid == want[5]
    np.testing.assert_array_equal(records[:, :2].numpy(), want[0][:, :2])
    np.testing.assert_array_equal(records[:, 2].numpy() & 0xFFFFFF, want[0][:, 2] & 0xFFFFFF)
    if device.type == "cpu":
        np.testing.assert_array_equal(records[:, 2].numpy(), want[0][:, 2])
        np.testing.assert_array_equal(normals.numpy(), want[1])
    else:
        steps = [(words.astype(np.int64) >> 24) & 0xFF for words in (records[:, 2].numpy(), want[0][:, 2])]
        assert (abs(steps[0] - steps[1]) <= 1).all()
        np.testing.assert_allclose(normals.numpy(), want[1], atol=NORMAL_TOLERANCE)
    np.testing.assert_array_equal(depth_thumbnail.numpy(), want[2])
    np.testing.assert_array_equal(depth_image.numpy(), want[3])
    np.testing.assert_array_equal(intensities.numpy(), want[4])
    return records, normals


@pytest.mark.parametrize("noise", [0.0, 0.004, 0.05])
def test_pixels_are_those_of_numpy(noise, device, generator):
    records, normals = check_against_numpy(*frame(generator, noise=noise), SAMPLING, device)
    known = normals.any(1)
    assert 0.3 < known.float().mean() < 1
    assert torch.equal((records[:, 2] >> 24) & 0xFF == 0, ~known)


@pytest.mark.parametrize(
    "change",
    [
        {"count": 1},
        {"count": 16},
        {"count": 0},
        {"count": 40_003},
        {"thumbnail_step": 1},
        {"thumbnail_step": 7},
        {"thumbnail_step": 500},
        {"depth_image_step": 0},
        {"depth_image_step": 1},
        {"depth_image_step": 7, "thumbnail_step": 7},
        {"depth_image_step": 500},
        {"depth_image_step": 1, "depth_image_unit": 2e-5},
        {"step_px": 1},
        {"step_px": 30},
        {"max_jump": 10.0},
        {"min_depth": 0.0, "max_depth": 1000.0},
        {"min_depth": 2.1, "max_depth": 2.2},
    ],
)
def test_any_setting(change, device, generator):
    check_against_numpy(*frame(generator), dataclasses.replace(SAMPLING, **change), device)


@pytest.mark.parametrize("shape", [(1, 1), (1, 90), (90, 1), (5, 3), (33, 129)])
def test_any_size_of_image(shape, device, generator):
    depth = torch.rand(shape, generator=generator) * 3
    color = torch.randint(0, 256, (*shape, 3), generator=generator, dtype=torch.uint8)
    check_against_numpy(depth, color, SAMPLING, device)


def test_half_precision_of_every_size_of_depth(device):
    exponents = torch.arange(-26, 9).repeat_interleave(64)
    depth = (2.0**exponents * (1 + torch.linspace(0, 1, 64).repeat(35) ** 2)).view(35, 64)
    depth[3, :33] = 1 + torch.arange(33) / 2**14  # ties, to even
    sampling = dataclasses.replace(SAMPLING, count=0, thumbnail_step=1, min_depth=0.0, max_depth=1e9)
    huge = torch.tensor([[65519.0, 65520.0, 1e30]])
    for image, largest in ((depth, 1e9), (huge, 1e38)):
        black = torch.zeros(*image.shape, 3, dtype=torch.uint8, device=device)
        changed = dataclasses.replace(sampling, max_depth=largest)
        buffer, _ = ops.sample_frame_pixels(image.to(device), black, *CAMERA, changed, *KEY)
        assert torch.equal(split(buffer.cpu(), sampling, image.shape)[2], image.half())


def test_without_valid_depth_all_but_intensities_is_zero(device, generator):
    depth, color = (image.to(device) for image in frame(generator))
    for nothing in (torch.zeros_like(depth), torch.full_like(depth, torch.nan), depth.new_zeros(0, 0)):
        shape = nothing.shape
        buffer, num_valid = ops.sample_frame_pixels(nothing, color[: shape[0], : shape[1]], *CAMERA, SAMPLING, *KEY)
        assert num_valid == 0
        *others, intensities = split(buffer.cpu(), SAMPLING, shape)
        assert not any(part.any() for part in others)
        assert intensities.any() == (intensities.numel() > 0)


def test_strided_images(generator):
    depth, color = frame(generator)
    want = ops.sample_frame_pixels(depth, color, *CAMERA, SAMPLING, *KEY)
    got = ops.sample_frame_pixels(
        depth.T.contiguous().T,
        color.flip(2).flip(2).permute(2, 0, 1).contiguous().permute(1, 2, 0),
        *CAMERA,
        SAMPLING,
        *KEY,
    )
    assert torch.equal(got[0], want[0])
    assert got[1] == want[1]


def test_the_key_decides(device, generator):
    depth, color = (image.to(device) for image in frame(generator))
    buffers = [
        ops.sample_frame_pixels(depth, color, *CAMERA, SAMPLING, *key)[0]
        for key in (KEY, KEY, (1, *KEY[1:]), (*KEY[:2], 18), (KEY[0], 3, KEY[2]))
    ]
    assert torch.equal(buffers[0], buffers[1])
    assert all(not torch.equal(buffers[0], other) for other in buffers[2:])


@pytest.mark.parametrize("shape", [(150, 90), (33, 64), (32, 5), (1, 40)])
def test_threads_that_share_a_frame_sample_the_same(generator, shape):
    depth, color = frame(generator)
    rows, columns = (torch.arange(size) % known for size, known in zip(shape, depth.shape, strict=True))
    depth, color = depth[rows][:, columns], color[rows][:, columns]
    sampling = dataclasses.replace(SAMPLING, count=3000)
    want, valid = ops.sample_frame_pixels(depth, color, *CAMERA, sampling, *KEY)
    before = ops.get_num_threads()
    try:
        for threads in (1, 2, 5):
            ops.set_num_threads(threads)
            shared = dataclasses.replace(sampling, shared=True)
            found, count = ops.sample_frame_pixels(depth, color, *CAMERA, shared, *KEY)
            assert count == valid and torch.equal(found, want)
    finally:
        ops.set_num_threads(before)


def test_threads_sample_side_by_side(generator):
    frames = [frame(generator, height=40 + 7 * i) for i in range(6)]
    want = [ops.sample_frame_pixels(*f, *CAMERA, SAMPLING, *KEY)[0] for f in frames]
    wrong = []

    def work(i):
        for _ in range(20):
            if not torch.equal(ops.sample_frame_pixels(*frames[i], *CAMERA, SAMPLING, *KEY)[0], want[i]):
                wrong.append(i)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(len(frames))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_wrong_arguments_are_named(generator):
    depth, color = frame(generator)

    def sample(depth=depth, color=color, fx=CAMERA[0], number=KEY[2], **change):
        sampling = dataclasses.replace(SAMPLING, **change)
        return ops.sample_frame_pixels(depth, color, fx, *CAMERA[1:], sampling, *KEY[:2], number)

    for change, message in (
        ({"count": -1}, r"count must be in \[0, 2\^30\], got -1"),
        ({"min_depth": -1.0}, "min_depth must be at least 0, got -1.0"),
        ({"step_px": 0}, r"step_px must be in \[1, 65535\], got 0"),
        ({"max_jump": 0.0}, "max_jump must be positive, got 0.0"),
        ({"depth_image_step": -1}, r"depth_image_step must be in \[0, 65535\], got -1"),
        ({"depth_image_unit": 0.0}, "depth_image_unit must be positive, got 0.0"),
        ({"thumbnail_step": 0}, r"thumbnail_step must be in \[1, 65535\], got 0"),
        ({"fx": 0.0}, "fx must be positive, got 0.0"),
        ({"number": -1}, r"frame must be in \[0, 2\^32 - 1\], got -1"),
        ({"number": 2**32}, r"frame must be in \[0, 2\^32 - 1\], got 4294967296"),
        ({"color": color[1:]}, r"color must have shape \[50, 70, 3\], got \[49, 70, 3\]"),
        ({"depth": torch.zeros(1, 70_000), "color": color}, r"depth must fit 16 bits per side, got \(1, 70000\)"),
    ):
        with pytest.raises(ValueError, match=f"sample_frame_pixels: {message}"):
            sample(**change)
    with pytest.raises(TypeError, match="sample_frame_pixels: depth must be float32, got float64"):
        sample(depth=depth.double())
    with pytest.raises(TypeError, match="sample_frame_pixels: color must be uint8, got float32"):
        sample(color=color.float())


def test_opcheck(device, generator):
    scalars, integers = [*CAMERA, 0.1, 6.0, 0.05, 1e-3], [100, 3, 16, 2, 0, 7, 0, 3]
    opcheck(
        torch.ops.spslam.sample_frame_pixels,
        (*frame(generator), scalars, integers),
        device,
        test_utils=("test_schema", "test_autograd_registration"),
    )


def test_opcheck_of_unprojection(device):
    records, normals, pose = torch.zeros(4, 3, dtype=torch.int32), torch.zeros(4, 3), torch.ones(7)
    opcheck(torch.ops.spslam.unproject_pixels, (records, normals, pose, *CAMERA), device)


def test_unprojection_is_the_formula(device, generator):
    depth, color = frame(generator)
    buffer, _ = ops.sample_frame_pixels(depth, color, *CAMERA, SAMPLING, *KEY)
    records, normals, _, _, _ = split(buffer, SAMPLING, depth.shape)
    pose = torch.tensor([0.7, -0.3, 0.5, 0.2, 1.5, -2.0, 0.3])  # not of unit length
    rotation = torch.from_numpy(quaternion_to_matrix(pose[:4].double().numpy() / pose[:4].double().norm().item()))
    u, v = records[:, 0] & 0xFFFF, records[:, 0] >> 16
    z = records[:, 1].contiguous().view(torch.float32).double()
    in_camera = torch.stack([(u - CAMERA[2]) / CAMERA[0] * z, (v - CAMERA[3]) / CAMERA[1] * z, z], 1)
    points, world_normals = ops.unproject_pixels(*(x.to(device) for x in (records, normals, pose)), *CAMERA)
    assert torch.allclose(points.cpu().double(), in_camera @ rotation.T + pose[4:], atol=POINT_TOLERANCE_M)
    assert torch.allclose(world_normals.cpu().double(), normals.double() @ rotation.T, atol=1e-6)
    empty = ops.unproject_pixels(*(x.to(device) for x in (records[:0], normals[:0], pose)), *CAMERA)
    assert [x.shape for x in empty] == [(0, 3), (0, 3)]


def test_unprojection_names_wrong_arguments():
    records, normals, pose = torch.zeros(4, 3, dtype=torch.int32), torch.zeros(4, 3), torch.ones(7)
    with pytest.raises(ValueError, match=r"unproject_pixels: normals must have shape \[4, 3\], got \[3, 3\]"):
        ops.unproject_pixels(records, normals[1:], pose, *CAMERA)
    with pytest.raises(ValueError, match=r"unproject_pixels: pose must have shape \[7\], got \[6\]"):
        ops.unproject_pixels(records, normals, pose[1:], *CAMERA)
    with pytest.raises(ValueError, match="unproject_pixels: fx must be positive, got 0"):
        ops.unproject_pixels(records, normals, pose, 0, *CAMERA[1:])
    with pytest.raises(TypeError, match="unproject_pixels: records must be int32, got int64"):
        ops.unproject_pixels(records.long(), normals, pose, *CAMERA)
