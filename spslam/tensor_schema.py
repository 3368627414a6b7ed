"""What the tensors of a map, its keyframes, a checkpoint, a prior and a pretraining state must be.

One table for each kind of file: dtype, shape and range of every tensor, and how tensors depend on each other. A file is
held against its table before a kernel sees anything of it, so kernels may index with what they are given.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from spslam.errors import SpslamError
from spslam.tensor_rules import Relation, Sizes, TensorRule, TensorSchema, check_values

# Coordinates of vertices are packed with 21 bits per axis, see `spslam.ops.voxel_hash`.
_VOXEL_MIN, _VOXEL_MAX = -(2**20), 2**20 - 1
# Origins and sizes of planes are int32 in the kernels; their sums must be too.
_MOST_TEXELS_FROM_ORIGIN = 2**30
_EDGE_KINDS = 4  # of `spslam.slam.graph.edges`
_PLANES, _PLANE_NUMBERS = 3, 5  # first row, origin u, origin v, size u, size v
_MOST_CAMERA_PX = 2**15  # of an image's width or height, as far as keyframes go
# Adam on quaternions leaves them this close to unit length.
_UNIT_TOLERANCE = 1e-2


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
    check_values("pixels.records (depth)", depth, TensorRule(torch.float32, (), low=0))


def _check_depth_keyframes(tensors: Mapping[str, Tensor], sizes: Sizes) -> None:
    frames = tensors.get("depth_keyframes.frames")
    if frames is None:
        if sizes["depth_images"]:
            raise SpslamError("tensor depth_keyframes.images is missing")
    elif len(frames) and int(frames.max()) >= sizes["frames"]:
        raise SpslamError(f"tensor depth_keyframes.frames must be below {sizes['frames']}, got {int(frames.max())}")


def _check_depth_history(tensors: Mapping[str, Tensor], sizes: Sizes) -> None:
    frames = tensors.get("depth_history.frames")
    if frames is None:
        if sizes["depth_histories"]:
            raise SpslamError("tensor depth_history.cells is missing")
        return
    numbers = [frames.flatten(), *(tensors[f"depth_history.{name}"].flatten() for name in ("moving", "looked"))]
    if int(torch.cat(numbers).max()) >= sizes["frames"]:
        raise SpslamError(f"tensors depth_history.frames, .moving and .looked must be below {sizes['frames']}")


def _check_features(tensors: Mapping[str, Tensor], sizes: Sizes) -> None:
    """Counts cover the features; frames ascend and exist."""
    frames, counts = tensors["features.frames"], tensors["features.counts"]
    if int(tensors.get("newest.frame", frames.new_tensor(-1))) >= sizes["frames"]:
        raise SpslamError(f"tensor newest.frame must be below {sizes['frames']}")
    if int(counts.sum()) != sizes["features_kept"] or bool((counts > sizes["features_kept"]).any()):
        raise SpslamError(f"tensor features.counts must sum to {sizes['features_kept']}, got {int(counts.sum())}")
    if len(frames) and (int(frames[-1]) >= sizes["frames"] or bool((frames[1:] <= frames[:-1]).any())):
        raise SpslamError(f"tensor features.frames must ascend and be below {sizes['frames']}")


def _check_graph(tensors: Mapping[str, Tensor], sizes: Sizes) -> None:
    """The keyframes are sound, and no more of them are under way than there are."""
    if "graph.frames" not in tensors:
        return
    count = sizes["keyframes"]
    _check_keyframes(tensors, sizes, "graph.")
    _check_ends("graph.waiting_ends", tensors, count)
    if sizes["anchors"]:
        frame, reference = tensors["graph.anchors"].amax(0).tolist()
        if frame >= sizes["frames"] or reference >= count:
            raise SpslamError(f"tensor graph.anchors must name frames and keyframes below {count}")
    done, begun = tensors["graph.numbers"].tolist()
    if not 0 <= done <= count or max(sizes["keyframes_at_start"], sizes["keyframes_moved"]) > count:
        raise SpslamError(f"tensors graph.numbers, graph.start and graph.target must be of {count} keyframes at most")
    if begun >= 0 and sizes["keyframes_at_start"] == 0:
        raise SpslamError("tensor graph.start must have poses where graph.numbers has a solution begun")
    for name in ("waiting_measured", "waiting_correction", "start", "target", "anchor_poses"):
        _check_rigid(f"graph.{name}", tensors[f"graph.{name}"])


def _check_keyframes(tensors: Mapping[str, Tensor], sizes: Sizes, prefix: str) -> None:
    """Keyframes ascend and exist, have the images of their cameras, and edges join them."""
    frames, count = tensors[f"{prefix}frames"], sizes["keyframes"]
    if count and (int(frames[-1]) >= sizes["frames"] or bool((frames[1:] <= frames[:-1]).any())):
        raise SpslamError(f"tensor {prefix}frames must ascend and be below {sizes['frames']}")
    cameras, numbers = tensors[f"{prefix}cameras"], tensors[f"{prefix}camera"]
    whole = cameras[:, [0, 1, 2, 8]]
    if bool((whole != whole.round()).any() | (whole < 1).any() | (whole > _MOST_CAMERA_PX).any()):
        raise SpslamError(f"tensor {prefix}cameras must hold steps and sizes from 1 to {_MOST_CAMERA_PX}")
    if bool((cameras[:, [3, 4, 7, 9]] <= 0).any()):
        raise SpslamError(f"tensor {prefix}cameras must hold focal lengths, depths and jumps above 0")
    if count and int(numbers.max()) >= sizes["cameras"]:
        raise SpslamError(f"tensor {prefix}camera must name cameras below {sizes['cameras']}")
    pixels = int((cameras[numbers, 1] * cameras[numbers, 2]).sum())
    if pixels != sizes["keyframe_pixels"]:
        raise SpslamError(f"tensor {prefix}depth must have the {pixels} pixels of the keyframes' cameras")
    _check_ends(f"{prefix}edge_ends", tensors, count)
    if sizes["tried_pairs"] and int(tensors[f"{prefix}tried"].max()) >= count:
        raise SpslamError(f"tensor {prefix}tried must name keyframes below {count}")
    for name in ("links", "edge_measured"):
        _check_rigid(prefix + name, tensors[prefix + name])


def _check_ends(name: str, tensors: Mapping[str, Tensor], keyframes: int) -> None:
    ends = tensors[name]
    if len(ends) and (int(ends[:, 0].max()) >= _EDGE_KINDS or int(ends[:, 1:].max()) >= keyframes):
        raise SpslamError(f"tensor {name} must name one of {_EDGE_KINDS} kinds and keyframes below {keyframes}")


def _check_archive(tensors: Mapping[str, Tensor], sizes: Sizes) -> None:
    """Keyframes and records are sound, and the recordings have as many frames as there are."""
    _check_keyframes(tensors, sizes, "")
    _check_rigid("frames.poses", tensors["frames.poses"])
    depth = tensors["records"][..., 1].contiguous().view(torch.float32)
    check_values("records (depth)", depth, TensorRule(torch.float32, (), low=0))
    if sizes.get("anchors", 0):
        frame, keyframe = tensors["anchors"].amax(0).tolist()
        if frame >= sizes["frames"] or keyframe >= sizes["keyframes"]:
            raise SpslamError(f"tensor anchors must name frames and keyframes below {sizes['keyframes']}")
    total = int(tensors["recordings"].sum())
    if total != sizes["frames"]:
        raise SpslamError(f"tensor recordings must sum to {sizes['frames']}, got {total}")


def _check_rigid(name: str, matrices: Tensor) -> None:
    """Raises SpslamError where a matrix [N, 4, 4] is no rotation and translation."""
    rotations = matrices[:, :3, :3]
    expected = torch.eye(4, dtype=matrices.dtype, device=matrices.device)
    off = (rotations @ rotations.transpose(1, 2) - expected[:3, :3]).abs()
    if len(matrices) and not (bool((off < _UNIT_TOLERANCE).all()) and bool((matrices[:, 3] == expected[3]).all())):
        raise SpslamError(f"tensor {name} must hold rigid transforms")


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


def _graph_rules(prefix: str) -> dict[str, TensorRule]:
    """The keyframe graph, which is there as a whole or not at all."""
    rules = {
        **_keyframe_rules(),
        "anchors": TensorRule(torch.int64, ("anchors", 2), low=0),
        "anchor_poses": TensorRule(torch.float64, ("anchors", 4, 4)),
        **_edge_rules("waiting"),
        "waiting_correction": TensorRule(torch.float64, ("waitings", 4, 4)),
        "start": TensorRule(torch.float64, ("keyframes_at_start", 4, 4)),
        "target": TensorRule(torch.float64, ("keyframes_moved", 4, 4)),
        "numbers": TensorRule(torch.int64, (2,), low=-1),
        "opened_noise": TensorRule(torch.float32, ("opened_noises", 4), low=0),
    }
    return {prefix + name: replace(rule, optional=True) for name, rule in rules.items()}


def _keyframe_rules() -> dict[str, TensorRule]:
    """Keyframes of any number of cameras, and the edges between them."""
    return {
        "frames": TensorRule(torch.int64, ("keyframes",), low=0),
        "camera": TensorRule(torch.int64, ("keyframes",), low=0),
        "cameras": TensorRule(torch.float64, ("cameras", 10)),
        "depth": TensorRule(torch.uint16, ("keyframe_pixels",)),
        "intensity": TensorRule(torch.uint8, ("keyframe_pixels",)),
        "links": TensorRule(torch.float64, ("keyframes", 4, 4)),
        "relocalized": TensorRule(torch.bool, ("keyframes",)),
        **_edge_rules("edge"),
        "tried": TensorRule(torch.int64, ("tried_pairs", 2), low=0),
        "noise": TensorRule(torch.float32, ("cameras", 4), low=0),
    }


def _edge_rules(name: str) -> dict[str, TensorRule]:
    return {
        f"{name}_ends": TensorRule(torch.int64, (f"{name}s", 3), low=0),
        f"{name}_measured": TensorRule(torch.float64, (f"{name}s", 4, 4)),
        f"{name}_information": TensorRule(torch.float64, (f"{name}s", 6, 6)),
    }


def _newest_rules() -> dict[str, TensorRule]:
    """The last frame's images, and how the camera moved while they were read; all there or none."""
    image = ("depth_image_rows", "depth_image_columns")
    return {
        "newest.frame": TensorRule(torch.int64, (1,), low=-1, optional=True),
        "newest.depth": TensorRule(torch.uint16, image, optional=True),
        "newest.intensity": TensorRule(torch.uint8, image, optional=True),
        "newest.poses": TensorRule(torch.float32, (2, 7), optional=True),
        "newest.readout": TensorRule(torch.float32, (1,), low=-1, high=1, optional=True),
        "newest.seconds": TensorRule(torch.float64, (1,), low=0, optional=True),
    }


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

# And: width and height of the images (px), thumbnail_rows and thumbnail_columns, depth_images (0 without depth
# keyframes), depth_image_rows and depth_image_columns; depth_histories (0 where nothing that moves is looked for),
# depth_cell_rows and depth_cell_columns.
CHECKPOINT = TensorSchema(
    {
        **_map_rules("scene."),
        "frames.poses": TensorRule(torch.float32, ("frames", 7)),
        "frames.timestamps": TensorRule(torch.float64, ("frames",)),
        "frames.depth_times": TensorRule(torch.float64, ("frames",)),
        "frames.color_offsets": TensorRule(torch.float64, ("frames",)),
        "frames.indices": TensorRule(torch.int64, ("frames",), low=0),
        "frames.lost": TensorRule(torch.bool, ("frames",)),
        "frames.consistent_frames": TensorRule(torch.int64, ("frames",), low=0),
        "frames.depth_thumbnails": TensorRule(torch.float16, ("frames", "thumbnail_rows", "thumbnail_columns"), low=0),
        "frames.gains": TensorRule(torch.float32, ("frames", 2)),
        "pixels.records": TensorRule(torch.int32, ("frames", "pixels", 3)),
        "pixels.has_pixels": TensorRule(torch.bool, ("frames",)),
        "unjoined.rows": TensorRule(torch.int64, ("unjoined",), low=0),
        "unjoined.poses": TensorRule(torch.float32, ("unjoined", 7)),
        "unjoined.counts": TensorRule(torch.int64, ("segments",), low=0),
        "noise.model": TensorRule(torch.float32, (4,), low=0),
        "noise.counts": TensorRule(torch.int32, (2, 32, 128), low=0),
        "noise.timing": TensorRule(torch.float32, (2,), low=-1, high=1),
        "noise.timing_state": TensorRule(torch.float64, (2, 2), low=-1, high=2e6),
        "features.frames": TensorRule(torch.int64, ("feature_frames",), low=0),
        "features.counts": TensorRule(torch.int64, ("feature_frames",), low=0),
        "features.descriptors": TensorRule(torch.uint8, ("features_kept", 32)),
        "features.points": TensorRule(torch.float32, ("features_kept", 3)),
        **_newest_rules(),
        "depth_keyframes.images": TensorRule(
            torch.uint16, ("depth_images", "depth_image_rows", "depth_image_columns"), optional=True
        ),
        "depth_keyframes.intensities": TensorRule(
            torch.uint8, ("depth_images", "depth_image_rows", "depth_image_columns"), optional=True
        ),
        "depth_keyframes.readouts": TensorRule(torch.float32, ("depth_images",), low=-1, high=1, optional=True),
        "depth_keyframes.frames": TensorRule(torch.int64, ("depth_images",), low=-1, optional=True),
        "depth_history.cells": TensorRule(
            torch.uint16, ("depth_histories", "depth_cell_rows", "depth_cell_columns"), optional=True
        ),
        "depth_history.frames": TensorRule(torch.int64, ("depth_histories",), low=-1, optional=True),
        "depth_history.moving": TensorRule(torch.int64, (), low=-1, optional=True),
        "depth_history.looked": TensorRule(torch.int64, (), low=-1, optional=True),
        "depth_history.off": TensorRule(torch.float64, (2,), low=0, high=1e9, optional=True),
        "depth_history.found": TensorRule(torch.int32, (2,), low=0, optional=True),
        **_graph_rules("graph."),
        **_moment_rules(_MOMENTS),
    },
    (
        _check_planes("scene."),
        _check_unit_quaternions,
        _check_pixels,
        _check_depth_keyframes,
        _check_depth_history,
        _check_features,
        _check_graph,
        _check_moments,
    ),
    (
        *(("depth_keyframes.images", f"depth_keyframes.{name}") for name in ("intensities", "readouts", "frames")),
        *(("depth_history.cells", f"depth_history.{name}") for name in ("frames", "moving", "looked", "off", "found")),
        *(("newest.frame", name) for name in _newest_rules()),
        *(("graph.frames", name) for name in _graph_rules("graph.")),
        *((f"moments.{name}.first", f"moments.{name}.second") for name, _ in _MOMENTS),
    ),
)

# Nothing is known beforehand.
KEYFRAMES = TensorSchema(
    {
        **_keyframe_rules(),
        "records": TensorRule(torch.int32, ("keyframes", "pixels", 3)),
        "recordings": TensorRule(torch.int64, ("recordings",), low=0),
        "frames.poses": TensorRule(torch.float64, ("frames", 4, 4)),
        "frames.timestamps": TensorRule(torch.float64, ("frames",)),
        "frames.lost": TensorRule(torch.bool, ("frames",)),
        "anchors": TensorRule(torch.int64, ("anchors", 2), low=0, optional=True),
    },
    (_check_archive,),
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
