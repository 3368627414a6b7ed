"""The planes that a depth image measured: what signed distances are taken from. Not differentiable."""

import math

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._checks import check, check_tensor
from spslam.ops._public import public_op
from spslam.ops.scene_view import Intrinsics, check_intrinsics

PLANE_SIZE = 5  # kPlaneSize of csrc/include/spslam/tsdf.h
# The unknown sensor's of `SensorNoise.unknown`: 3 mm, and 1.3 mm at 1 m that grow with the square of depth.
DEFAULT_NOISE = (9e-6, 1.69e-6)


@public_op()
def measure_planes(
    depth: torch.Tensor,
    intrinsics: Intrinsics,
    noise: tuple[float, float] = DEFAULT_NOISE,
    shared_noise: bool = False,
) -> torch.Tensor:
    """Fits a plane to the surface around each pixel of a depth image.

    Inverse depth is linear in the image where a surface is flat. It is fitted by weighted least squares over the 5 x 5
    pixels around, with Tukey's biweight of the distance from a plane through the pixel, whose slope along each axis is
    the smaller difference to a neighbor: pixels of another surface take no part. Where the residuals are as small as
    the noise, depth is the plane's, which has the noise of some ten pixels and not of one; where they show the shape
    of the surface, it is the pixel's own.

    The weight is s^2 / (s^2 + variance(z)) cos(angle of incidence), s = 3 mm being the error of poses and surface,
    less where under two thirds of the window lie on the surface, and 0 under a fifth: at edges, on flying pixels and
    where depth is unknown.

    Args:
        depth: float32 [H, W], m; 0, negative and not finite are unknown.
        intrinsics: of the image, px.
        noise: floor (m^2) and growth (1/m^2) of the variance of a depth z, floor + growth z^4; the first two numbers of
            `SensorNoise.model`.
        shared_noise: whether neighbors share their noise, as where a sensor smoothed depth. A mean over them takes
            nothing from it and would blur once more, so planes are fitted as if there were none: depth is the pixel's
            own unless the window is flat to rounding. The weight counts the noise.

    Returns:
        float32 [H, W, 5]: unit normal away from the camera in camera axes (x right, y down, z forward), distance of the
        plane from the camera (m), and weight in [0, 1]; all 0 where there is none. An image without pixels gives an
        empty tensor. The same bits for any number of threads.

    Raises:
        TypeError, ValueError: a tensor of another dtype or shape, more than 16384 pixels per side, or a number out of
            range.

    Example:
        >>> wall = torch.full((8, 8), 2.0)
        >>> plane = measure_planes(wall, Intrinsics(8.0, 8.0, 3.5, 3.5))[4, 4]
        >>> [round(number, 3) + 0.0 for number in plane[:4].tolist()]
        [0.0, 0.0, 1.0, 2.0]
    """
    name = "measure_planes"
    check_tensor(name, "depth", depth, ("H", "W"), torch.float32)
    check_intrinsics(name, intrinsics)
    check_noise(name, noise)
    return torch.ops.spslam.measure_planes(depth, list(intrinsics), *noise, shared_noise)


def check_noise(name: str, noise: tuple[float, float]) -> None:
    """Raises ValueError where `noise` is not floor and growth of a variance."""
    check(
        len(noise) == 2 and all(0 <= number < math.inf for number in noise),
        name,
        "noise",
        "be two numbers of at least 0",
        noise,
    )


@torch.library.register_fake("spslam::measure_planes")
def _(depth, *_):
    return depth.new_empty((*depth.shape, PLANE_SIZE))
