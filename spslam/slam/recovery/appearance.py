"""Whether a frame's brightness agrees with earlier frames' at a pose: geometry may fit in places that are alike."""

import math

import torch

from spslam.camera import Camera
from spslam.slam.depth_keyframes import depth_image_intrinsics, depth_unit
from spslam.slam.pixels import FramePixels, unpack_points
from spslam.slam.poses import rotations
from spslam.slam.reference_image import LUMA_OF_WHITE, luma

CELLS = 2  # of an earlier image in each direction, whose mean brightness does not count: it is alike in many places
LEVELS = 65535  # of brightness
POINTS = 2048  # pixels of each earlier frame that are compared
MIN_DEPTH_M = 0.05
MAX_DEPTH_DIFFERENCE = 0.05  # of the depth; a point that differs more is not on the surface seen
MIN_POINTS = 100  # with fewer the correlation is unknown
MIN_DEVIATION = 0.03  # standard deviation of the earlier frames' brightness; below it the correlation is unknown
NOISE_DEVIATION = 0.02  # standard deviation of the image's brightness; smaller ones are the camera's noise
MIN_BRIGHTNESS, MAX_BRIGHTNESS = 0.05, 0.95  # mean of the image; beyond it is under- or overexposed


def brightness_sums(
    pixels: FramePixels,
    pose: torch.Tensor,
    records: torch.Tensor,
    poses: torch.Tensor,
    camera: Camera,
    max_depth_m: float,
) -> torch.Tensor:
    """Sums over the points of earlier frames that a frame sees, for `brightness_correlation`; stays on the device.

    Args:
        pixels: of the frame, with images.
        pose: float32 [7] T_world_camera of the frame.
        records: int32 [F, P, 3] packed pixels of earlier frames.
        poses: float32 [F, 7] T_world_camera of these.
        camera: of all frames.
        max_depth_m: the largest depth that images hold.

    Returns:
        float64 [5]: sums of 1, b, and of the squares and products m m, b b and m b of the deviations from the means of
        each cell of each earlier frame, for the brightness m in earlier frames and b in this one. Zeros where F = 0.
    """
    shape = records.shape[:2]
    flat = records.reshape(-1, 3)
    points = unpack_points(flat, camera).view(*shape, 3)
    world = points @ rotations(poses[:, :4]).transpose(1, 2) + poses[:, None, 4:]
    visible, seen = _seen(pixels, (world - pose[4:]) @ rotations(pose[None, :4]), camera, max_depth_m)
    # Whole numbers, so that sums do not depend on their order.
    seen = (seen * (LEVELS / 255)).round().long()
    stored = (luma(flat).double() * (LEVELS / LUMA_OF_WHITE)).round().long().view(shape)
    products = torch.stack([torch.ones_like(seen), stored, seen, stored * stored, seen * seen, stored * seen], 2)
    cells = _cells(flat, camera).view(shape) + CELLS**2 * torch.arange(len(poses), device=pose.device)[:, None]
    sums = products.new_zeros(len(poses) * CELLS**2, 6)
    sums.index_add_(0, cells.flatten(), torch.where(visible[..., None], products, 0).flatten(0, 1))
    count, m, b, mm, bb, mb = sums.double().unbind(1)
    n, level = count.clamp(min=1), 1 / LEVELS
    squares = [(product - x * y / n).sum() for product, x, y in ((mm, m, m), (bb, b, b), (mb, m, b))]
    return torch.stack([count.sum(), b.sum() * level, *(square * level**2 for square in squares)])


def brightness_correlation(points: float, seen: float, stored_2: float, seen_2: float, both: float) -> float:
    """Correlation in [-1, 1] of the brightness in earlier frames and in a frame, of `brightness_sums`.

    It is invariant to exposure. NaN where it is unknown: few points, uniform color, a dark or overexposed image.
    """
    if not points >= MIN_POINTS:
        return math.nan
    deviation_stored, deviation_seen = math.sqrt(stored_2 / points), math.sqrt(seen_2 / points)
    if deviation_stored < MIN_DEVIATION or not MIN_BRIGHTNESS < seen / points < MAX_BRIGHTNESS:
        return math.nan
    return both / points / (deviation_stored * max(deviation_seen, NOISE_DEVIATION))


def _seen(
    pixels: FramePixels, points: torch.Tensor, camera: Camera, max_depth_m: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Which points [F, P, 3] in a frame's axes lie on the surface that it sees, and its intensity 0-255 there."""
    x, y, z = points.unbind(-1)
    k = depth_image_intrinsics(camera)
    depth = pixels.depth_image.int() * depth_unit(max_depth_m)
    rows, columns = depth.shape
    u, v = x / z * k.fx + k.cx, y / z * k.fy + k.cy
    inside = (z > MIN_DEPTH_M) & (u >= 0) & (v >= 0) & (u < columns - 1) & (v < rows - 1)
    u, v = torch.where(inside, u, 0), torch.where(inside, v, 0)
    at = (v + 0.5).long() * columns + (u + 0.5).long()
    visible = inside & ((depth.flatten()[at] - z).abs() < MAX_DEPTH_DIFFERENCE * z)
    return visible, _bilinear(pixels.intensity_image.float(), u, v)


def _cells(records: torch.Tensor, camera: Camera) -> torch.Tensor:
    """Number of the image's cell [P] that each packed pixel lies in."""
    column = (records[:, 0] & 0xFFFF) * CELLS // camera.width
    row = ((records[:, 0] >> 16) & 0xFFFF) * CELLS // camera.height
    return (row * CELLS + column).long()


def _bilinear(image: torch.Tensor, u: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Values of an image [H, W] at positions u, v in [0, W - 1) and [0, H - 1)."""
    columns = image.shape[1]
    left, top = u.floor(), v.floor()
    a, b = u - left, v - top
    at, flat = (top * columns + left).long(), image.flatten()
    upper = (1 - a) * flat[at] + a * flat[at + 1]
    lower = (1 - a) * flat[at + columns] + a * flat[at + columns + 1]
    return (1 - b) * upper + b * lower
