"""Which points of a surface frames see, with which colors, and sums of these over frames. Not differentiable."""

from dataclasses import dataclass

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._checks import check, check_tensor
from spslam.ops._public import changed_in_place, public_op
from spslam.ops.depth_planes import DEFAULT_NOISE, check_noise
from spslam.ops.scene_view import Intrinsics, check_intrinsics

# kSeenRun of csrc/include/spslam/seen_points.h.
_RUN = 1024
_MAX_SIDE = 1 << 14
_SUMS, _DETAIL_SUMS = 4, 5


@dataclass(frozen=True)
class SurfacePoints:
    """Points of a surface that are looked for in frames; `SurfacePoints.of` makes one.

    Attributes:
        points: float32 [N, 3], world, m.
        normals: float32 [N, 3], unit vectors towards free space.
        spheres: float32 [N / 1024 rounded up, 4], center and radius of a ball around each 1024 points, m.
    """

    points: torch.Tensor
    normals: torch.Tensor
    spheres: torch.Tensor

    @staticmethod
    def of(points: torch.Tensor, normals: torch.Tensor) -> "SurfacePoints":
        """Of points, float32 [N, 3], and their normals, next to each other where they are in the tensor, for speed.

        Raises:
            TypeError, ValueError: points of another dtype or shape.

        Example:
            >>> SurfacePoints.of(torch.tensor([[0.0, 0.0, 1.0], [2.0, 0.0, 1.0]]), torch.ones(2, 3)).spheres.tolist()
            [[1.0, 0.0, 1.0, 1.0]]
        """
        check_tensor("SurfacePoints.of", "points", points, ("N", 3), torch.float32)
        whole = len(points) // _RUN * _RUN
        runs = [points[:whole].reshape(-1, _RUN, 3)]
        if whole < len(points):
            runs.append(points[None, whole:])
        low, high = torch.cat([run.amin(1) for run in runs]), torch.cat([run.amax(1) for run in runs])
        # Not finite where a point of the run is not: such a run is never left out.
        spheres = torch.cat((0.5 * (low + high), 0.5 * (high - low).norm(dim=1, keepdim=True)), 1)
        return SurfacePoints(points, normals, spheres)

    def __len__(self) -> int:
        return len(self.points)


@public_op()
def see_points(
    surface: SurfacePoints,
    depth: torch.Tensor,
    color: torch.Tensor,
    pose: torch.Tensor,
    intrinsics: Intrinsics,
    noise: tuple[float, float] = DEFAULT_NOISE,
) -> tuple[torch.Tensor, torch.Tensor]:
    """The points of a surface that a frame sees from their front, and their colors in it.

    What hides others is the points themselves, drawn into a depth buffer whose gaps of less than 3 px are closed, and
    the frame's depth: a point is hidden 4 mm and 2 px of the slanted surface behind the nearest ones, and 2 cm and
    three deviations of the noise behind what was measured. Depth that was measured behind a point does not hide it, nor
    does unknown depth: the colors that a frame has there are those that the surface is seen with.

    Args:
        surface: the points and their normals.
        depth: float32 [H, W], m, 0 where unknown.
        color: uint8 [H, W, 3].
        pose: float32 [7] of the frame, T_world_camera: unit quaternion (w, x, y, z) and translation (m).
        intrinsics: of the frame, px.
        noise: floor (m^2) and growth (1/m^2) of the variance of depth, see `measure_planes`.

    Returns:
        uint8 [N, 3] colors, bilinear between pixels, and float32 [N] weights: the pixels that the frame has for an area
        of surface there, 1/m^2. Both are 0 of points that are not seen, as those that are not finite. N = 0 gives empty
        tensors. The same bits for any number of threads.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, more than 16384 pixels per side, or a number
            out of range.

    Example:
        >>> points = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 3.0], [0.0, 9.0, 2.0]])
        >>> surface = SurfacePoints.of(points, torch.tensor([[0.0, 0.0, -1.0]]).expand(3, 3))
        >>> color, pose = torch.full((8, 8, 3), 90, dtype=torch.uint8), torch.tensor([1.0, 0, 0, 0, 0, 0, 0])
        >>> colors, weights = see_points(surface, torch.zeros(8, 8), color, pose, Intrinsics(8.0, 8.0, 4.0, 4.0))
        >>> weights.tolist(), colors[0].tolist()
        ([16.0, 0.0, 0.0], [90, 90, 90])
    """
    name = "see_points"
    points = surface.points
    check_tensor(name, "surface.points", points, ("N", 3), torch.float32)
    check_tensor(name, "surface.normals", surface.normals, (len(points), 3), torch.float32, like=points)
    runs = -(-len(points) // _RUN)
    check_tensor(name, "surface.spheres", surface.spheres, (runs, 4), torch.float32, like=points)
    check_tensor(name, "depth", depth, ("H", "W"), torch.float32, like=points)
    check(max(depth.shape) <= _MAX_SIDE, name, "depth", f"have at most {_MAX_SIDE} px per side", list(depth.shape))
    check_tensor(name, "color", color, (*depth.shape, 3), torch.uint8, like=depth)
    check_tensor(name, "pose", pose, (7,), torch.float32, like=depth)
    check_intrinsics(name, intrinsics)
    check_noise(name, noise)
    tensors = points, surface.normals, surface.spheres, depth, color, pose
    return torch.ops.spslam.see_points(*tensors, list(intrinsics), list(noise))


@public_op(as_given=("sums",))
def add_seen_colors_(sums: torch.Tensor, colors: torch.Tensor, weights: torch.Tensor) -> None:
    """Adds weighted colors, and the weights, to the sums that a mean is made of.

    Args:
        sums: float32 [N, 4], changed in place: red, green and blue times weight, and weight.
        colors: uint8 [N, 3].
        weights: float32 [N]; those that are not above 0 are left out.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device.

    Example:
        >>> sums = torch.zeros(1, 4)
        >>> add_seen_colors_(sums, torch.tensor([[10, 20, 30]], dtype=torch.uint8), torch.tensor([2.0]))
        >>> sums.tolist()
        [[20.0, 40.0, 60.0, 2.0]]
    """
    name = "add_seen_colors_"
    check_tensor(name, "sums", sums, ("N", _SUMS), torch.float32)
    _check_seen(name, colors, weights, sums)
    check_tensor(name, "weights", weights, (len(sums),), torch.float32, like=sums)
    torch.ops.spslam.add_seen_colors_(sums, colors, weights)
    changed_in_place(sums)


@public_op(as_given=("sums",))
def add_color_detail_(sums: torch.Tensor, colors: torch.Tensor, weights: torch.Tensor, ends: torch.Tensor) -> None:
    """Adds what a frame says of the color in the middle of edges, where it sees the middle and both ends.

    Args:
        sums: float32 [M, 5], changed in place. Per edge: the difference between the color in its middle and the mean of
            those at its ends (red, green, blue), that difference squared, and 1.
        colors, weights: uint8 [N, 3] and float32 [N] of `see_points`; the middles of the edges are the last M of the
            points, in order.
        ends: int64 [M, 2], the points at the ends, below N - M; edges with others are left out.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or more edges than points.

    Example:
        >>> colors = torch.tensor([[10, 10, 10], [20, 20, 20], [18, 15, 15]], dtype=torch.uint8)
        >>> sums = torch.zeros(1, 5)
        >>> add_color_detail_(sums, colors, torch.ones(3), torch.tensor([[0, 1]]))
        >>> sums.tolist()
        [[3.0, 0.0, 0.0, 9.0, 1.0]]
    """
    name = "add_color_detail_"
    check_tensor(name, "sums", sums, ("M", _DETAIL_SUMS), torch.float32)
    _check_seen(name, colors, weights, sums)
    check(len(sums) <= len(colors), name, "sums", "have at most as many rows as colors", list(sums.shape))
    check_tensor(name, "ends", ends, (len(sums), 2), torch.int64, like=sums)
    torch.ops.spslam.add_color_detail_(sums, colors, weights, ends)
    changed_in_place(sums)


def _check_seen(name: str, colors: torch.Tensor, weights: torch.Tensor, like: torch.Tensor) -> None:
    check_tensor(name, "colors", colors, ("N", 3), torch.uint8, like=like)
    check_tensor(name, "weights", weights, (len(colors),), torch.float32, like=like)


@torch.library.register_fake("spslam::see_points")
def _(points, *_):
    return points.new_empty(points.shape, dtype=torch.uint8), points.new_empty(len(points))


@torch.library.register_fake("spslam::add_seen_colors_")
def _(*_):
    return None


@torch.library.register_fake("spslam::add_color_detail_")
def _(*_):
    return None
