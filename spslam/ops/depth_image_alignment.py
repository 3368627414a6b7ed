"""Registration of many pairs of depth images in one call: relative poses, and how well two images fit at them.

A pair is a source, of which pixels were drawn, and a target, of which the image is used. A source's pixel of depth z is
the point x = R (z d) + t in the target's axes; its residuals are those of `track_gauss_newton` against one depth
keyframe at the origin, without a map: the signed distance of x from the surface that the target measured and, where the
noise and intensities are given, the difference of intensities, both with robust weights that narrow from iteration to
iteration.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._checks import check, check_count, check_tensor
from spslam.ops._public import public_op
from spslam.ops.scene_view import Intrinsics, check_intrinsics

_COUNTS, _MOMENTS, _NORMALS = 3, 5, 21  # csrc/include/spslam/depth_image_alignment.h


class DrawnPixels(NamedTuple):
    """Pixels drawn from each of N frames of one camera: the sources of pairs.

    Attributes:
        records: int32 [N, P, 3] packed pixel records (see `sample_frame_pixels`), P >= 1.
        normals: float32 [N, P, 3] of the surface at the pixels, in each frame's axes; 0 where unknown.
        numbers: int64 [N] of the frames; they key the draws of pixels.
        intrinsics: in the pixels of the records.
    """

    records: torch.Tensor
    normals: torch.Tensor
    numbers: torch.Tensor
    intrinsics: Intrinsics

    def check(self, function: str) -> None:
        """Raises TypeError or ValueError, naming `function`, where something does not fit."""
        check_tensor(function, "sources.records", self.records, ("N", "P", 3), torch.int32)
        check(self.records.shape[1] > 0, function, "sources.records", "have at least one pixel of each frame", 0)
        shape, like = tuple(self.records.shape), self.records
        check_tensor(function, "sources.normals", self.normals, shape, torch.float32, like=like)
        check_tensor(function, "sources.numbers", self.numbers, shape[:1], torch.int64, like=like)
        check_intrinsics(function, self.intrinsics, "sources.intrinsics")


class DepthImages(NamedTuple):
    """Depth images of one camera: the targets of pairs.

    Attributes:
        depth: uint16 [R, H, W] in `unit`, 0 where unknown.
        unit: m.
        intrinsics: of the images, px.
        intensities: uint8 [R, H, W] intensity (`LUMA_WEIGHTS`) in 1/255; None compares none.
    """

    depth: torch.Tensor
    unit: float
    intrinsics: Intrinsics
    intensities: torch.Tensor | None = None

    def check(self, function: str, like: torch.Tensor) -> None:
        """Raises TypeError or ValueError, naming `function`, where something does not fit."""
        check_tensor(function, "targets.depth", self.depth, ("R", "H", "W"), torch.uint16, like=like)
        check(self.unit > 0, function, "targets.unit", "be positive", self.unit)
        check_intrinsics(function, self.intrinsics, "targets.intrinsics")
        if self.intensities is not None:
            shape = tuple(self.depth.shape)
            check_tensor(function, "targets.intensities", self.intensities, shape, torch.uint8, like=like)


@dataclass(frozen=True, kw_only=True)
class AlignmentOptions:
    """How `align_depth_images` draws pixels, weighs residuals and steps.

    Attributes:
        num_pixels: drawn of each source in each iteration, with replacement.
        iterations: how many.
        kernel_start: first width of the robust kernel of distances, m.
        kernel_end: last width, m, reached one iteration before the last; between them it goes geometrically.
        damping: relative Levenberg damping.
        seed, stream: keys of the draws, with the number of the source's frame, see `philox_uniform`.
    """

    num_pixels: int
    iterations: int
    kernel_start: float
    kernel_end: float
    damping: float
    seed: int
    stream: int

    def check(self, function: str) -> None:
        """Raises ValueError, naming `function`, where a number is out of range."""
        check_count(function, "num_pixels", self.num_pixels)
        check_count(function, "iterations", self.iterations)
        check(self.kernel_start > 0, function, "kernel_start", "be positive", self.kernel_start)
        check(self.kernel_end > 0, function, "kernel_end", "be positive", self.kernel_end)
        check(self.damping >= 0, function, "damping", "be at least 0", self.damping)


class DepthImageComparison(NamedTuple):
    """How well the images of B pairs fit at given poses.

    Attributes:
        seen: int64 [B] pixels of the source that fall on a pixel with depth of the target.
        on_surface: int64 [B] of these, how many lie on the surface there.
        through: int64 [B] of these, how many lie clearly before it: the target looked through them.
        correlation: float64 [B] Pearson's, of the intensities of those on the surface; NaN where there are no
            intensities, or those of either vary by less than `least_deviation`.
        information: float64 [B, 6, 6] sum of J^T J over those on the surface, J being the derivative of the distance
            along the normal, and that of the intensity, in deviations of the noise, by a step (translation m, rotation
            rad about the source's center) in the target's axes.
    """

    seen: torch.Tensor
    on_surface: torch.Tensor
    through: torch.Tensor
    correlation: torch.Tensor
    information: torch.Tensor


@public_op()
def align_depth_images(
    sources: DrawnPixels,
    targets: DepthImages,
    pairs: torch.Tensor,
    poses: torch.Tensor,
    options: AlignmentOptions,
    *,
    noise: torch.Tensor | None = None,
) -> torch.Tensor:
    """Aligns the sources of many pairs with their targets; all iterations in one call, on CUDA one block for each pair.

    Args:
        sources: pixels of N frames.
        targets: R images.
        pairs: int64 [B, 2] rows of source and target.
        poses: float32 [B, 7] starts T_target_source, unit quaternion (w, x, y, z) and translation (m).
        options: pixels, iterations, kernels and random keys.
        noise: float32 [4] of the sensor, `SensorNoise.model`; None weighs near and far alike and compares no
            intensities.

    Returns:
        float32 [B, 7]. A pose that is not finite, or whose pair names an image that is not there, stays as it is, and
        so does one of which no point falls on the target's surface. The same to the bit every time on one device, and
        for any number of CPU threads.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or a number out of range.

    Example:
        >>> plane = torch.full((1, 12, 16), 1000, dtype=torch.uint16)  # a wall at 1 m; the source is at 1.01 m
        >>> column, row = torch.meshgrid(torch.arange(1, 15), torch.arange(1, 11), indexing="ij")
        >>> depth = torch.full_like(row, torch.tensor([1.01]).view(torch.int32).item())
        >>> pixels = torch.stack([column | row << 16, depth, torch.zeros_like(row)], -1).int().view(1, -1, 3)
        >>> camera = Intrinsics(16.0, 16.0, 7.5, 5.5)
        >>> sources = DrawnPixels(pixels, torch.zeros(1, 140, 3), torch.arange(1), camera)
        >>> options = AlignmentOptions(num_pixels=100, iterations=10, kernel_start=0.1, kernel_end=0.01, damping=1e-4,
        ...     seed=0, stream=RandomStream.TRACKING_PIXELS)
        >>> start = torch.tensor([[1.0, 0, 0, 0, 0, 0, 0]])
        >>> targets, pairs = DepthImages(plane, 1e-3, camera), torch.tensor([[0, 0]])
        >>> moved = align_depth_images(sources, targets, pairs, start, options)
        >>> round(moved[0, 6].item(), 3)
        -0.01
    """
    name = "align_depth_images"
    _check_call(name, sources, targets, pairs, poses, noise)
    options.check(name)
    return torch.ops.spslam.align_depth_images(
        *_arguments(sources, targets, [pairs, poses, sources.numbers], noise),
        [options.kernel_start, options.kernel_end, options.damping],
        [options.num_pixels, options.iterations, options.seed, int(options.stream), 0],
    )


@public_op()
def compare_depth_images(
    sources: DrawnPixels,
    targets: DepthImages,
    pairs: torch.Tensor,
    poses: torch.Tensor,
    noise: torch.Tensor,
    *,
    tolerance: float,
    tolerance_deviations: float = 3.0,
    clear_tolerances: float = 2.0,
    least_deviation: float = 0.0,
) -> DepthImageComparison:
    """How well sources of many pairs fit their targets at given poses, and what that says of these.

    Args:
        sources: pixels of N frames.
        targets: R images.
        pairs: int64 [B, 2] rows of source and target.
        poses: float32 [B, 7] T_target_source.
        noise: float32 [4] of the sensor, `SensorNoise.model`.
        tolerance: m; a point is on the surface if its depth is within this and
        tolerance_deviations: so many deviations of the noise of depth of it.
        clear_tolerances: a point so many times that before the surface lies clearly before it.
        least_deviation: of intensities; where those of either image vary less, their correlation is unknown.

    Returns:
        Counts, correlation and information of each pair; zeros and NaN where a pair names an image that is not there or
        its pose is not finite. A normal that is not known adds nothing.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or a number out of range.

    Example:
        >>> plane = torch.full((1, 12, 16), 1000, dtype=torch.uint16)
        >>> one = torch.tensor([1.0]).view(torch.int32).item()
        >>> pixels = torch.tensor([[[8 | 6 << 16, one, 0], [2 | 3 << 16, one, 0]]], dtype=torch.int32)
        >>> normals = torch.tensor([0.0, 0.0, -1.0]).expand(1, 2, 3)
        >>> camera = Intrinsics(16.0, 16.0, 7.5, 5.5)
        >>> sources = DrawnPixels(pixels, normals, torch.zeros(1).long(), camera)
        >>> targets = DepthImages(plane, 1e-3, camera)
        >>> itself, noise = torch.zeros(2, 2).long(), SensorNoise.unknown().model
        >>> poses = torch.tensor([[1.0, 0, 0, 0, 0, 0, 0], [1.0, 0, 0, 0, 0, 0, -0.2]])  # in place; 20 cm before it
        >>> found = compare_depth_images(sources, targets, itself, poses, noise, tolerance=0.01)
        >>> found.seen, found.on_surface, found.through
        (tensor([2, 2]), tensor([2, 0]), tensor([0, 2]))
    """
    name = "compare_depth_images"
    _check_call(name, sources, targets, pairs, poses, noise)
    check(tolerance >= 0, name, "tolerance", "be at least 0", tolerance)
    check(tolerance_deviations >= 0, name, "tolerance_deviations", "be at least 0", tolerance_deviations)
    check(clear_tolerances >= 0, name, "clear_tolerances", "be at least 0", clear_tolerances)
    check(least_deviation >= 0, name, "least_deviation", "be at least 0", least_deviation)
    sums = torch.ops.spslam.compare_depth_images(
        *_arguments(sources, targets, [pairs, poses, sources.normals], noise),
        [tolerance, tolerance_deviations, clear_tolerances],
    )
    counts, moments, normals = sums.split([_COUNTS, _MOMENTS, _NORMALS], dim=1)
    seen, on_surface, through = counts.long().unbind(1)
    rows, columns = torch.triu_indices(6, 6, device=sums.device)
    information = sums.new_zeros(len(sums), 6, 6)
    information[:, rows, columns] = normals
    information[:, columns, rows] = normals
    correlation = _correlation(moments, on_surface, least_deviation)
    return DepthImageComparison(seen, on_surface, through, correlation, information)


def _correlation(moments: torch.Tensor, count: torch.Tensor, least_deviation: float) -> torch.Tensor:
    """Pearson's correlation float64 [B] of sums [B, 5]: both, their squares, their product."""
    one, other, one_square, other_square, product = (moments / count[:, None]).unbind(1)
    variances = torch.stack([one_square - one**2, other_square - other**2])
    known = (variances > max(least_deviation, 1e-6) ** 2).all(0)
    return torch.where(known, (product - one * other) / variances.prod(0).sqrt(), torch.nan)


def _check_call(
    name: str,
    sources: DrawnPixels,
    targets: DepthImages,
    pairs: torch.Tensor,
    poses: torch.Tensor,
    noise: torch.Tensor | None,
) -> None:
    sources.check(name)
    targets.check(name, like=sources.records)
    check_tensor(name, "pairs", pairs, ("B", 2), torch.int64, like=sources.records)
    check_tensor(name, "poses", poses, (len(pairs), 7), torch.float32, like=sources.records)
    if noise is not None:
        check_tensor(name, "noise", noise, (4,), torch.float32, like=sources.records)


def _arguments(
    sources: DrawnPixels, targets: DepthImages, more: list[torch.Tensor], noise: torch.Tensor | None
) -> tuple[list[torch.Tensor], list[float]]:
    """What schemas take: class Arguments and the enum ImageScalar in csrc/bindings/depth_image_alignment.cpp."""
    tensors = [targets.depth, sources.records, *more]
    if noise is not None:
        tensors += [noise] if targets.intensities is None else [noise, targets.intensities]
    return tensors, [*targets.intrinsics, targets.unit, *sources.intrinsics]


@torch.library.register_fake("spslam::align_depth_images")
def _(tensors, image_scalars, scalars, integers):
    return torch.empty_like(tensors[3])


@torch.library.register_fake("spslam::compare_depth_images")
def _(tensors, image_scalars, scalars):
    return tensors[3].new_empty((len(tensors[3]), _COUNTS + _MOMENTS + _NORMALS), dtype=torch.float64)
