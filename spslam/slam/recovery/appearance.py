"""Whether a frame's colors are those of the map where it is laid: plain shapes are alike in many places."""

import math

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.scene import Scene
from spslam.slam.pixels import unpack_points
from spslam.slam.poses import rotations
from spslam.slam.reference_image import LUMA_OF_WHITE, luma

POINTS = 2048  # of a frame
NEAR = 0.5  # of the truncation, from the mapped surface
FEW_POINTS = 100  # say nothing
PLAIN = 0.05  # deviation of the map's brightness: with less there is nothing to be like
LEAST_DEVIATION = 0.02  # of the picture's brightness: less is the camera's noise
DARK, BLINDED = 0.05, 0.95  # mean brightness of a picture without light, or with too much


def brightness_sums(scene: Scene, records: torch.Tensor, pose: torch.Tensor, camera: Camera) -> torch.Tensor:
    """Sums over the pixels near mapped surface for `brightness_correlation`; stays on the device.

    Args:
        scene: the map.
        records: int32 [P, 3] packed pixels.
        pose: float32 [7] T_world_camera.
        camera: of the pixels.

    Returns:
        float64 [6]: pixels, the map's brightness m and the picture's b, and m m, b b, m b. Zeros where P = 0.
    """
    points = unpack_points(records, camera) @ rotations(pose[None, :4])[0].T + pose[4:]
    distance, inside = scene.sdf(points)
    near = inside & (distance.abs() < NEAR)
    mapped, seen = _brightness(scene.color(points).double()), luma(records).double() / LUMA_OF_WHITE
    columns = torch.stack([torch.ones_like(mapped), mapped, seen, mapped * mapped, seen * seen, mapped * seen])
    return torch.where(near, columns, 0).sum(1)


def brightness_correlation(
    pixels: float, mapped: float, seen: float, mapped_2: float, seen_2: float, both: float
) -> float:
    """Correlation from -1 to 1 of the map's brightness and the picture's, of `brightness_sums`.

    It does not change with exposure. NaN where nothing can be told: few pixels, a plain part of the map, the dark.
    """
    if not pixels >= FEW_POINTS:
        return math.nan
    mean_mapped, mean_seen = mapped / pixels, seen / pixels
    deviation_mapped = math.sqrt(max(mapped_2 / pixels - mean_mapped**2, 0.0))
    deviation_seen = math.sqrt(max(seen_2 / pixels - mean_seen**2, 0.0))
    if deviation_mapped < PLAIN or not DARK < mean_seen < BLINDED:
        return math.nan
    return (both / pixels - mean_mapped * mean_seen) / (deviation_mapped * max(deviation_seen, LEAST_DEVIATION))


def _brightness(colors: torch.Tensor) -> torch.Tensor:
    """Of colors [P, 3] in [0, 1]."""
    red, green, blue = (weight * channel for weight, channel in zip(ops.LUMA_WEIGHTS, colors.unbind(1), strict=True))
    return (red + green + blue) / sum(ops.LUMA_WEIGHTS)
