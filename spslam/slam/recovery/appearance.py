"""Whether a frame's brightness agrees with the map's colors at a pose: featureless geometry fits in many places."""

import math

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.scene import Scene
from spslam.slam.pixels import unpack_points
from spslam.slam.poses import rotations
from spslam.slam.reference_image import LUMA_OF_WHITE, luma

POINTS = 2048  # pixels of a frame that are compared
MAX_DISTANCE = 0.5  # from the mapped surface, in units of the truncation
MIN_POINTS = 100  # with fewer the correlation is unknown
MIN_MAP_DEVIATION = 0.05  # standard deviation of the map's brightness; below it the correlation is unknown
NOISE_DEVIATION = 0.02  # standard deviation of the image's brightness; smaller ones are the camera's noise
MIN_BRIGHTNESS, MAX_BRIGHTNESS = 0.05, 0.95  # mean of the image; beyond it is under- or overexposed


def brightness_sums(scene: Scene, records: torch.Tensor, pose: torch.Tensor, camera: Camera) -> torch.Tensor:
    """Sums over the pixels near mapped surface for `brightness_correlation`; stays on the device.

    Args:
        scene: the map.
        records: int32 [P, 3] packed pixels.
        pose: float32 [7] T_world_camera.
        camera: of the pixels.

    Returns:
        float64 [6]: sums of 1, m, b, m m, b b and m b for the map's brightness m and the image's b. Zeros where P = 0.
    """
    points = unpack_points(records, camera) @ rotations(pose[None, :4])[0].T + pose[4:]
    distance, inside = scene.sdf(points)
    near = inside & (distance.abs() < MAX_DISTANCE)
    mapped, seen = _brightness(scene.color(points).double()), luma(records).double() / LUMA_OF_WHITE
    columns = torch.stack([torch.ones_like(mapped), mapped, seen, mapped * mapped, seen * seen, mapped * seen])
    return torch.where(near, columns, 0).sum(1)


def brightness_correlation(
    pixels: float, mapped: float, seen: float, mapped_2: float, seen_2: float, both: float
) -> float:
    """Correlation in [-1, 1] of the map's brightness and the image's, of `brightness_sums`.

    It is invariant to exposure. NaN where it is unknown: few pixels, uniform color, a dark or overexposed image.
    """
    if not pixels >= MIN_POINTS:
        return math.nan
    mean_mapped, mean_seen = mapped / pixels, seen / pixels
    deviation_mapped = math.sqrt(max(mapped_2 / pixels - mean_mapped**2, 0.0))
    deviation_seen = math.sqrt(max(seen_2 / pixels - mean_seen**2, 0.0))
    if deviation_mapped < MIN_MAP_DEVIATION or not MIN_BRIGHTNESS < mean_seen < MAX_BRIGHTNESS:
        return math.nan
    return (both / pixels - mean_mapped * mean_seen) / (deviation_mapped * max(deviation_seen, NOISE_DEVIATION))


def _brightness(colors: torch.Tensor) -> torch.Tensor:
    """Luma in [0, 1] of colors [P, 3] in [0, 1]."""
    red, green, blue = (weight * channel for weight, channel in zip(ops.LUMA_WEIGHTS, colors.unbind(1), strict=True))
    return (red + green + blue) / sum(ops.LUMA_WEIGHTS)
