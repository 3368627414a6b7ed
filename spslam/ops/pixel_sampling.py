"""The pixels of a frame that tracking and mapping work on: drawn, with normals, and packed for one upload."""

from dataclasses import dataclass

import torch

from spslam.ops import _library, trusted  # noqa: F401
from spslam.ops._checks import check, check_key, check_tensor
from spslam.ops._public import public_op
from spslam.ops.scene_view import Intrinsics

_MAX_SIDE = 2**16 - 1  # a record has 16 bits per coordinate
_MAX_COUNT = 2**30


@dataclass(frozen=True)
class PixelSampling:
    """How `sample_frame_pixels` draws.

    Attributes:
        count: pixels to draw, P.
        min_depth, max_depth: pixels nearer or farther, m, are not drawn.
        step_px, max_jump: of the normals, see `depth_normals`.
        thumbnail_step: distance of the depth thumbnail's pixels, px; the first lies at half of it.
        depth_image_step: distance of the pixels of the small depth and intensity images, px; the first lies at 0. With
            0 there are none.
        depth_image_unit: m, of the small image's depth.
        shared: whether the kernels' threads (`set_num_threads`) share a frame on the CPU; else the calling thread does
            it alone.
    """

    count: int
    min_depth: float
    max_depth: float
    step_px: int
    max_jump: float
    thumbnail_step: int
    depth_image_step: int = 0
    depth_image_unit: float = 1e-3
    shared: bool = False

    def thumbnail_shape(self, height: int, width: int) -> tuple[int, int]:
        """Rows and columns of the depth thumbnail of an image."""
        first, step = self.thumbnail_step // 2, self.thumbnail_step
        return len(range(first, height, step)), len(range(first, width, step))

    def depth_image_shape(self, height: int, width: int) -> tuple[int, int]:
        """Rows and columns of the small images of an image; 0 and 0 where there are none."""
        return _depth_image_size(height, self.depth_image_step), _depth_image_size(width, self.depth_image_step)


def _depth_image_size(size: int, step: int) -> int:
    return -(-size // step) if step > 0 else 0


@public_op()
def sample_frame_pixels(
    depth: torch.Tensor,
    color: torch.Tensor,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    sampling: PixelSampling,
    seed: int,
    stream: int,
    frame: int,
) -> tuple[torch.Tensor, int]:
    """Draws pixels of valid depth, with replacement, finds their normals and packs them (section III.D of SP-SLAM).

    Pixel i of the result is number `sample_indices(seed, stream, frame, 0, P, valid)[i]` of the valid ones, row by
    row; its normal is that of `depth_normals`. Its record is three words: u | v << 16; the bits of the float32 depth
    (m); r | g << 8 | b << 16 | c << 24, c being |n . d| times 128, rounded and at most 255 (n the normal, d the ray
    direction with camera z = 1; 0 = unknown). Runs without Python's lock.

    Args:
        depth: float32 [H, W], meters; not finite, 0 and outside the range is invalid.
        color: uint8 [H, W, 3].
        fx, fy, cx, cy: pinhole camera, px.
        sampling: how many, and what is valid.
        seed, stream, frame: key of the draw, as in `philox_uniform`.

    Returns:
        buffer int32 [3 P + 3 P + ceil(h w / 2) + ceil(h' w' / 2) + ceil(h' w' / 4)]: the records [P, 3]; the normals
        [P, 3] as the bits of float32; the depth thumbnail, float16 [h, w] (m, 0 where invalid) at every
        `thumbnail_step`-th pixel, two per word; the small depth image, uint16 [h', w'] in `depth_image_unit`, rounded
        (0 where invalid or beyond 65535), at every `depth_image_step`-th pixel, two per word; and of the same pixels
        the intensity image, uint8 [h', w'] (`LUMA_WEIGHTS`, 1/255), four per word. And the number of valid pixels.
        Where that is 0, records and normals are 0. The same bits on every run, for any number of threads; devices
        differ by rounding in normals, and by that in c. On CUDA this waits for the device.

    Raises:
        ValueError: wrong shapes or devices, or a number out of range.
        TypeError: wrong dtypes.

    Example:
        >>> sampling = PixelSampling(4, min_depth=0.1, max_depth=9.0, step_px=2, max_jump=0.1, thumbnail_step=16)
        >>> depth, color = torch.ones(32, 48), torch.zeros(32, 48, 3, dtype=torch.uint8)
        >>> buffer, valid = sample_frame_pixels(depth, color, 50.0, 50.0, 24.0, 16.0, sampling, 0, 0, 0)
        >>> buffer.shape, valid
        (torch.Size([27]), 1536)
    """
    name = "sample_frame_pixels"
    check_tensor(name, "depth", depth, ["H", "W"], torch.float32)
    height, width = depth.shape
    check(
        max(height, width) <= _MAX_SIDE and height * width < 2**31,
        name,
        "depth",
        "fit 16 bits per side",
        (height, width),
    )
    check_tensor(name, "color", color, [height, width, 3], torch.uint8, like=depth)
    check(fx > 0, name, "fx", "be positive", fx)
    check(fy > 0, name, "fy", "be positive", fy)
    check(0 <= sampling.count <= _MAX_COUNT, name, "count", "be in [0, 2^30]", sampling.count)
    check(sampling.min_depth >= 0, name, "min_depth", "be at least 0", sampling.min_depth)
    check(1 <= sampling.step_px <= _MAX_SIDE, name, "step_px", "be in [1, 65535]", sampling.step_px)
    check(sampling.max_jump > 0, name, "max_jump", "be positive", sampling.max_jump)
    check(
        1 <= sampling.thumbnail_step <= _MAX_SIDE, name, "thumbnail_step", "be in [1, 65535]", sampling.thumbnail_step
    )
    check(
        0 <= sampling.depth_image_step <= _MAX_SIDE,
        name,
        "depth_image_step",
        "be in [0, 65535]",
        sampling.depth_image_step,
    )
    check(sampling.depth_image_unit > 0, name, "depth_image_unit", "be positive", sampling.depth_image_unit)
    check_key(name, frame)
    buffer, num_valid = torch.ops.spslam.sample_frame_pixels(
        depth, color, *_arguments(sampling, (fx, fy, cx, cy), (seed, stream, frame))
    )
    return buffer, num_valid


def _arguments(
    sampling: PixelSampling, camera: tuple[float, ...], key: tuple[int, ...]
) -> tuple[list[float], list[int]]:
    """The schema's scalars and integers: the enums Scalar and Integer in csrc/bindings/pixel_sampling.cpp."""
    scalars = [*camera, sampling.min_depth, sampling.max_depth, sampling.max_jump, sampling.depth_image_unit]
    steps = [sampling.step_px, sampling.thumbnail_step, sampling.depth_image_step]
    return scalars, [sampling.count, *steps, int(sampling.shared), *(int(part) for part in key)]


@public_op()
def unproject_pixels(
    records: torch.Tensor, normals: torch.Tensor, pose: torch.Tensor, fx: float, fy: float, cx: float, cy: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Surface points and normals of a frame's pixels in the world: R z ((u - cx) / fx, (v - cy) / fy, 1) + t and R n.

    Args:
        records: int32 [P, 3], see `sample_frame_pixels`.
        normals: float32 [P, 3], camera axes.
        pose: float32 [7], T_world_camera as quaternion (w, x, y, z), of any length but 0, and translation (m).
        fx, fy, cx, cy: pinhole camera, px.

    Returns:
        points float32 [P, 3], m, and normals float32 [P, 3]; devices differ by rounding. P = 0 gives empty tensors, NaN
        in a depth, a normal or the pose NaN. Not differentiable.

    Raises:
        ValueError: wrong shapes or devices, `fx` or `fy` not positive.
        TypeError: wrong dtypes.

    Example:
        >>> depth = torch.tensor([2.0]).view(torch.int32).item()
        >>> records, normals = torch.tensor([[30 | 10 << 16, depth, 0]], dtype=torch.int32), torch.zeros(1, 3)
        >>> pose = torch.tensor([1.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0])
        >>> unproject_pixels(records, normals, pose, 10.0, 10.0, 20.0, 20.0)[0]
        tensor([[ 2.5000, -2.0000,  2.0000]])
    """
    name = "unproject_pixels"
    check_tensor(name, "records", records, ["P", 3], torch.int32)
    check_tensor(name, "normals", normals, [records.shape[0], 3], torch.float32, like=records)
    check_tensor(name, "pose", pose, [7], torch.float32, like=records)
    check(fx > 0, name, "fx", "be positive", fx)
    check(fy > 0, name, "fy", "be positive", fy)
    return trusted.unproject_pixels(records, normals, pose.detach(), Intrinsics(fx, fy, cx, cy))


@torch.library.register_fake("spslam::unproject_pixels")
def _(records, normals, pose, fx, fy, cx, cy):
    return torch.empty_like(normals), torch.empty_like(normals)


@torch.library.register_fake("spslam::sample_frame_pixels")
def _(depth, color, scalars, integers):
    count, _, thumbnail_step, depth_image_step = integers[:4]
    height, width = (max(0, -((thumbnail_step // 2 - size) // thumbnail_step)) for size in depth.shape)
    rows, columns = (_depth_image_size(size, depth_image_step) for size in depth.shape)
    words = 6 * count + -(-height * width // 2) + -(-rows * columns // 2) + -(-rows * columns // 4)
    return depth.new_empty((words,), dtype=torch.int32), 0
