"""What the tensors of a map, a checkpoint, a prior and a pretraining state must be.

One table for each kind of file: dtype, shape and range of every tensor, and how tensors depend on each other. A file is
held against its table before a kernel sees anything of it, so kernels may index with what they are given.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from spslam.errors import SpslamError

# Coordinates of vertices are packed with 21 bits per axis, see `spslam.ops.voxel_hash`.
_VOXEL_MIN, _VOXEL_MAX = -(2**20), 2**20 - 1
# Origins and sizes of planes are int32 in the kernels; their sums must be too.
_MOST_TEXELS_FROM_ORIGIN = 2**30
_PLANES, _PLANE_NUMBERS = 3, 5  # first row, origin u, origin v, size u, size v
# Adam on quaternions leaves them this close to unit length.
_UNIT_TOLERANCE = 1e-2

Sizes = dict[str, int]
Layout = tuple[torch.dtype, tuple[int, ...]]
Relation = Callable[[Mapping[str, Tensor], Sizes], None]


@dataclass(frozen=True)
class TensorRule:
    """What one tensor must be. Floating-point values must always be finite.

    Attributes:
        dtype: of its values.
        shape: of each axis the size, or the name of a size: a name stands for the same number in the whole file.
        low: least value; None for any.
        high: largest value; None for any.
        optional: whether the file may lack it.
    """

    dtype: torch.dtype
    shape: tuple[int | str, ...]
    low: float | None = None
    high: float | None = None
    optional: bool = False


@dataclass(frozen=True)
class TensorSchema:
    """The tensors of one kind of file.

    Attributes:
        rules: by name of the tensor. Other tensors in a file are ignored.
        relations: called with the tensors and the sizes, after all rules hold; raise SpslamError.
        pairs: names of optional tensors of which a file must have both or neither.
    """

    rules: Mapping[str, TensorRule]
    relations: tuple[Relation, ...] = ()
    pairs: tuple[tuple[str, str], ...] = field(default=())

    def check_layouts(self, layouts: Mapping[str, Layout], sizes: Mapping[str, int]) -> Sizes:
        """Checks names, dtypes and shapes, which a file's header tells before any tensor is read.

        Args:
            layouts: dtype and shape by name.
            sizes: those that are known beforehand, by name.

        Returns:
            All sizes, by name.

        Raises:
            SpslamError: names the first tensor at fault.
        """
        known = dict(sizes)
        for name, rule in self.rules.items():
            if name in layouts:
                _check_layout(name, layouts[name], rule, known)
            elif not rule.optional:
                raise SpslamError(f"tensor {name} is missing")
        for one, other in self.pairs:
            if (one in layouts) != (other in layouts):
                raise SpslamError(f"tensors {one} and {other} must both be there, got one of them")
        return known

    def check(self, tensors: Mapping[str, Tensor], sizes: Mapping[str, int]) -> None:
        """Checks everything; raises SpslamError, which names the first tensor at fault.

        Args:
            tensors: by name, on any device.
            sizes: those that are known beforehand, by name.
        """
        layouts = {name: (tensor.dtype, tuple(tensor.shape)) for name, tensor in tensors.items()}
        known = self.check_layouts(layouts, sizes)
        for name, rule in self.rules.items():
            if name in tensors:
                _check_values(name, tensors[name], rule)
        for relation in self.relations:
            relation(tensors, known)


def check_plane_layout(layout: Sequence[int], rows: int) -> None:
    """Checks that three planes follow each other in a table of texels exactly as their sizes imply.

    Args:
        layout: 15 numbers, (first row, origin u, origin v, size u, size v) of each plane.
        rows: of the table.

    Raises:
        ValueError: names the first number at fault.
    """
    if len(layout) != _PLANES * _PLANE_NUMBERS:
        raise ValueError(f"layout must have {_PLANES * _PLANE_NUMBERS} numbers, got {len(layout)}")
    first = 0
    for plane in range(_PLANES):
        begin, u, v, size_u, size_v = (int(number) for number in layout[_PLANE_NUMBERS * plane :][:_PLANE_NUMBERS])
        if size_u < 0 or size_v < 0:
            raise ValueError(f"layout of plane {plane} must have sizes of at least 0, got {size_u} and {size_v}")
        farthest = max(abs(u), abs(v), abs(u + size_u), abs(v + size_v))
        if farthest > _MOST_TEXELS_FROM_ORIGIN:
            raise ValueError(f"layout of plane {plane} must stay within 2^30 texels of the origin, got {farthest}")
        if begin != first:
            raise ValueError(f"layout of plane {plane} must begin at row {first}, got {begin}")
        first += size_u * size_v
    if first != rows:
        raise ValueError(f"texels must have the {first} rows of the layout, got {rows}")


def _check_layout(name: str, layout: Layout, rule: TensorRule, sizes: Sizes) -> None:
    dtype, shape = layout
    fits = dtype == rule.dtype and len(shape) == len(rule.shape)
    for actual, wanted in zip(shape, rule.shape, strict=False):
        fits &= actual == (sizes.setdefault(wanted, actual) if isinstance(wanted, str) else wanted)
    if not fits:
        wanted = ", ".join(str(sizes.get(size, size) if isinstance(size, str) else size) for size in rule.shape)
        raise SpslamError(f"tensor {name} must be {_name(rule.dtype)} [{wanted}], got {_name(dtype)} {list(shape)}")


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def _check_values(name: str, tensor: Tensor, rule: TensorRule) -> None:
    if tensor.numel() == 0:
        return
    if rule.dtype == torch.bool:
        # Any byte can stand in a file, and kernels take one above 1 for neither true nor false.
        if int(tensor.view(torch.uint8).max()) > 1:
            raise SpslamError(f"tensor {name} must be 0 or 1, got {int(tensor.view(torch.uint8).max())}")
        return
    if not rule.dtype.is_floating_point and rule.low is None and rule.high is None:
        return
    low, high = (bound.item() for bound in torch.aminmax(tensor))
    if not (math.isfinite(low) and math.isfinite(high)):
        raise SpslamError(f"tensor {name} must be finite, got NaN or infinity")
    if rule.low is not None and low < rule.low:
        raise SpslamError(f"tensor {name} must be at least {rule.low:g}, got {low:g}")
    if rule.high is not None and high > rule.high:
        raise SpslamError(f"tensor {name} must be at most {rule.high:g}, got {high:g}")


def _check_planes(prefix: str) -> Relation:
    def check(tensors: Mapping[str, Tensor], sizes: Sizes) -> None:
        try:
            check_plane_layout(tensors[f"{prefix}planes.layout"].tolist(), sizes["texels"])
        except ValueError as fault:
            raise SpslamError(f"tensor {prefix}planes.layout: {fault}") from None

    return check


def _check_unit_quaternions(tensors: Mapping[str, Tensor], sizes: Sizes) -> None:
    lengths = tensors["frames.poses"][:, :4].double().norm(dim=1)
    if bool(((lengths - 1).abs() > _UNIT_TOLERANCE).any()):
        raise SpslamError("tensor frames.poses must begin with unit quaternions, got others")


def _check_pixels(tensors: Mapping[str, Tensor], sizes: Sizes) -> None:
    """Pixel records lie in the image and have a depth; finite also in frames without pixels."""
    records = tensors["pixels.records"]
    for axis, words in (("width", records[..., 0] & 0xFFFF), ("height", records[..., 0] >> 16 & 0xFFFF)):
        if words.numel() and int(words.max()) >= sizes[axis]:
            raise SpslamError(f"tensor pixels.records must lie in the image, got a pixel beyond its {axis}")
    depth = records[..., 1].contiguous().view(torch.float32)
    _check_values("pixels.records (depth)", depth, TensorRule(torch.float32, (), low=0))


def _check_depth_keyframes(tensors: Mapping[str, Tensor], sizes: Sizes) -> None:
    frames = tensors.get("depth_keyframes.frames")
    if frames is None:
        if sizes["depth_images"]:
            raise SpslamError("tensor depth_keyframes.images is missing")
    elif len(frames) and int(frames.max()) >= sizes["frames"]:
        raise SpslamError(f"tensor depth_keyframes.frames must be below {sizes['frames']}, got {int(frames.max())}")


def _check_moments(tensors: Mapping[str, Tensor], sizes: Sizes) -> None:
    """Rows of the texels' moments move with the texels, so there must be as many at least."""
    rows = sizes.get("texel_rows", sizes["texels"])
    if rows < sizes["texels"]:
        raise SpslamError(f"tensor moments.texels.first must have at least {sizes['texels']} rows, got {rows}")


def _map_rules(prefix: str) -> dict[str, TensorRule]:
    rules = {
        "origin": TensorRule(torch.float64, (3,)),
        "volume.voxel_coords": TensorRule(torch.int32, ("voxels", 3), _VOXEL_MIN, _VOXEL_MAX),
        "volume.embeddings": TensorRule(torch.float32, ("voxels", "embedding")),
        "volume.weights": TensorRule(torch.float32, ("voxels",), low=0),
        "planes.texels": TensorRule(torch.float32, ("texels", "features")),
        "planes.layout": TensorRule(torch.int64, (_PLANES * _PLANE_NUMBERS,)),
        "geometry_decoder": TensorRule(torch.float32, ("geometry_parameters",)),
        "color_decoder": TensorRule(torch.float32, ("color_parameters",)),
    }
    return {prefix + name: rule for name, rule in rules.items()}


def _moment_rules(names: Iterable[tuple[str, tuple[int | str, ...]]]) -> dict[str, TensorRule]:
    """Adam's moments; both are there or none. Tables may have spare rows, so their number is free."""
    rules = {}
    for name, shape in names:
        rules[f"moments.{name}.first"] = TensorRule(torch.float32, shape, optional=True)
        rules[f"moments.{name}.second"] = TensorRule(torch.float32, shape, low=0, optional=True)
    return rules


# Sizes that are known beforehand: embedding, features, geometry_parameters, color_parameters.
MAP = TensorSchema(_map_rules(""), (_check_planes(""),))

_MOMENTS = (
    ("embeddings", ("embedding_rows", "embedding")),
    ("texels", ("texel_rows", "features")),
    ("geometry_decoder", ("geometry_parameters",)),
    ("color_decoder", ("color_parameters",)),
    ("poses", ("pose_rows", 7)),
)

# And: width and height of the images (px), thumbnail_rows and thumbnail_columns, depth_images, depth_image_rows and
# depth_image_columns (all 0 without depth keyframes).
CHECKPOINT = TensorSchema(
    {
        **_map_rules("scene."),
        "frames.poses": TensorRule(torch.float32, ("frames", 7)),
        "frames.timestamps": TensorRule(torch.float64, ("frames",)),
        "frames.indices": TensorRule(torch.int64, ("frames",), low=0),
        "frames.lost": TensorRule(torch.bool, ("frames",)),
        "frames.consistent_frames": TensorRule(torch.int64, ("frames",), low=0),
        "frames.depth_thumbnails": TensorRule(torch.float16, ("frames", "thumbnail_rows", "thumbnail_columns"), low=0),
        "pixels.records": TensorRule(torch.int32, ("frames", "pixels", 3)),
        "pixels.has_pixels": TensorRule(torch.bool, ("frames",)),
        "noise.model": TensorRule(torch.float32, (4,), low=0),
        "noise.counts": TensorRule(torch.int32, (2, 32, 128), low=0),
        "depth_keyframes.images": TensorRule(
            torch.uint16, ("depth_images", "depth_image_rows", "depth_image_columns"), optional=True
        ),
        "depth_keyframes.intensities": TensorRule(
            torch.uint8, ("depth_images", "depth_image_rows", "depth_image_columns"), optional=True
        ),
        "depth_keyframes.frames": TensorRule(torch.int64, ("depth_images",), low=-1, optional=True),
        **_moment_rules(_MOMENTS),
    },
    (_check_planes("scene."), _check_unit_quaternions, _check_pixels, _check_depth_keyframes, _check_moments),
    (
        ("depth_keyframes.images", "depth_keyframes.intensities"),
        ("depth_keyframes.images", "depth_keyframes.frames"),
        *((f"moments.{name}.first", f"moments.{name}.second") for name, _ in _MOMENTS),
    ),
)

# Known beforehand: encoder_parameters, geometry_parameters.
PRIOR = TensorSchema(
    {
        "encoder": TensorRule(torch.float32, ("encoder_parameters",)),
        "geometry_decoder": TensorRule(torch.float32, ("geometry_parameters",)),
    }
)

# Known beforehand: parameters, of encoder and decoder together.
PRETRAINING = TensorSchema(
    {
        "parameters": TensorRule(torch.float32, ("parameters",)),
        "exp_avg": TensorRule(torch.float32, ("parameters",)),
        "exp_avg_sq": TensorRule(torch.float32, ("parameters",), low=0),
    }
)
