"""Keyframes and edges as tensors: how checkpoints and maps store them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch

from spslam.camera import Camera
from spslam.slam.graph.edges import EDGE_KINDS, GraphEdge, Link
from spslam.slam.graph.keyframe import Keyframe, KeyframeCamera

Tensors = Mapping[str, torch.Tensor]


def camera_tensor(cameras: Sequence[KeyframeCamera]) -> torch.Tensor:
    """Cameras as float64 [C, 10]: step, width, height, fx, fy, cx, cy, max_depth_m, normal_step_px, max_jump."""
    rows = []
    for camera in cameras:
        k = camera.camera
        image = k.width, k.height, k.fx, k.fy, k.cx, k.cy
        rows.append([camera.step, *image, camera.max_depth_m, camera.normal_step_px, camera.max_jump])
    return torch.tensor(rows, dtype=torch.float64).view(-1, 10)


def cameras_of(tensor: torch.Tensor) -> list[KeyframeCamera]:
    """Cameras of `camera_tensor`; raises ValueError where a number can't be a camera's."""
    cameras = []
    for step, width, height, fx, fy, cx, cy, *rest in tensor.tolist():
        image = Camera(int(width), int(height), fx, fy, cx, cy)
        max_depth_m, normal_step_px, max_jump = rest
        cameras.append(KeyframeCamera(int(step), image, max_depth_m, int(normal_step_px), max_jump))
    return cameras


def keyframe_tensors(keyframes: Sequence[Keyframe], cameras: Sequence[KeyframeCamera]) -> dict[str, torch.Tensor]:
    """Keyframes as tensors; their images, which differ in size with the camera, are one after the other."""
    sizes = [keyframe.depth.numel() for keyframe in keyframes]
    depth, intensity = torch.zeros(sum(sizes), dtype=torch.uint16), torch.zeros(sum(sizes), dtype=torch.uint8)
    begin = 0
    for keyframe, size in zip(keyframes, sizes, strict=True):
        depth[begin : begin + size] = keyframe.depth.reshape(-1)
        intensity[begin : begin + size] = keyframe.intensity.reshape(-1)
        begin += size
    numbers = {camera: i for i, camera in enumerate(cameras)}
    return {
        "frames": torch.tensor([keyframe.frame for keyframe in keyframes], dtype=torch.int64),
        "camera": torch.tensor([numbers[keyframe.camera] for keyframe in keyframes], dtype=torch.int64),
        "cameras": camera_tensor(cameras),
        "depth": depth,
        "intensity": intensity,
    }


def keyframes_of(tensors: Tensors, cameras: Sequence[KeyframeCamera]) -> Iterator[Keyframe]:
    """Keyframes of `keyframe_tensors`, as views of the tensors."""
    begin = 0
    for frame, number in zip(tensors["frames"].tolist(), tensors["camera"].tolist(), strict=True):
        camera = cameras[number]
        shape = camera.camera.height, camera.camera.width
        end = begin + shape[0] * shape[1]
        depth, intensity = (tensors[name][begin:end].view(shape) for name in ("depth", "intensity"))
        yield Keyframe(frame, depth, intensity, camera)
        begin = end


def link_tensors(links: Sequence[Link]) -> dict[str, torch.Tensor]:
    """How each keyframe was reached from the one before."""
    return {
        "links": stacked([link.pose for link in links], 4),
        "relocalized": torch.tensor([link.relocalized for link in links], dtype=torch.bool),
    }


def links_of(tensors: Tensors) -> list[Link]:
    """What `link_tensors` made tensors of."""
    links = tensors["links"].cpu().numpy().copy(), tensors["relocalized"].tolist()
    return [Link(*each) for each in zip(*links, strict=True)]


def edge_tensors(prefix: str, edges: Sequence[GraphEdge]) -> dict[str, torch.Tensor]:
    """Edges, under names that begin with a prefix."""
    ends = [(EDGE_KINDS.index(edge.kind), edge.source, edge.target) for edge in edges]
    return {
        f"{prefix}ends": torch.tensor(ends, dtype=torch.int64).view(-1, 3),
        f"{prefix}measured": stacked([edge.measured for edge in edges], 4),
        f"{prefix}information": stacked([edge.information for edge in edges], 6),
    }


def edges_of(prefix: str, tensors: Tensors) -> list[GraphEdge]:
    """What `edge_tensors` made tensors of."""
    ends = tensors[f"{prefix}ends"].tolist()
    matrices = (tensors[f"{prefix}{name}"].cpu().numpy().copy() for name in ("measured", "information"))
    return [
        GraphEdge(EDGE_KINDS[kind], source, target, measured, information)
        for (kind, source, target), measured, information in zip(ends, *matrices, strict=True)
    ]


def pair_tensor(pairs: set[tuple[int, int]]) -> torch.Tensor:
    """Pairs of numbers as int64 [N, 2], sorted."""
    return torch.tensor(sorted(pairs), dtype=torch.int64).view(-1, 2)


def pairs_of(tensor: torch.Tensor) -> set[tuple[int, int]]:
    """What `pair_tensor` made a tensor of."""
    return {(one, other) for one, other in tensor.tolist()}


def stacked(matrices: Sequence[np.ndarray], size: int) -> torch.Tensor:
    """float64 [N, size, size] of N matrices."""
    return torch.from_numpy(np.array(matrices, np.float64).reshape(-1, size, size))
