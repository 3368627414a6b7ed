"""Whether a frame's brightness agrees with earlier frames' at a pose: geometry may fit in places that are alike."""

import math

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.slam.depth_keyframes import depth_image_intrinsics, depth_unit
from spslam.slam.pixels import FramePixels

CELLS = 2  # of an earlier image in each direction, whose mean brightness does not count: it is alike in many places
POINTS = 2048  # pixels of each earlier frame that are compared
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
    rows: torch.Tensor,
    camera: Camera,
    max_depth_m: float,
) -> torch.Tensor:
    """Sums over the points of earlier frames that a frame sees, for `brightness_correlation`; stays on the device.

    Args:
        pixels: of the frame, with images.
        pose: float32 [7] T_world_camera of the frame.
        records: int32 [F, P, 3] packed pixels of frames.
        poses: float32 [F, 7] T_world_camera of these.
        rows: int64 [M] of the earlier frames among them, on the device.
        camera: of all frames.
        max_depth_m: the largest depth that images hold.

    Returns:
        float64 [5]: sums of 1, b, and of the squares and products m m, b b and m b of the deviations from the means of
        each cell of each earlier frame, for the brightness m in earlier frames and b in this one. Zeros where M = 0.
    """
    return ops.comparison.brightness_sums(
        (records, poses, rows),
        POINTS,
        ops.Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy),
        (camera.height, camera.width),
        CELLS,
        pose,
        ops.comparison.ShownImages(
            pixels.depth_image, pixels.intensity_image, depth_image_intrinsics(camera), depth_unit(max_depth_m)
        ),
        MAX_DEPTH_DIFFERENCE,
    )


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
