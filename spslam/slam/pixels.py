"""Pixels of one frame: which are kept, and how they are packed.

A pixel record is three 32-bit words: u | v << 16; the bits of the float32 depth (m); r | g << 8 | b << 16 | c << 24.
c is the foreshortening n . d times 128 (n the surface normal, d the ray direction with camera z = 1; 0 = unknown): it
turns a depth difference along the ray into a distance to the surface's tangent plane.
"""

from dataclasses import dataclass

import numpy as np
import torch

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.datasets.base import RgbdFrame

FORESHORTENING_SCALE = 128.0
LATTICE_STEP_PX = 16


@dataclass(frozen=True)
class FramePixels:
    """What tracking and mapping need of a frame.

    Attributes:
        records: int32 [P, 3] packed pixels in random order, so that any prefix is an even sample; P = 0 without depth.
        normals: float32 [P, 3] unit normals in camera axes, turned to the camera; 0 where unknown.
        lattice: float16 [h, w] depth (m) at every `LATTICE_STEP_PX`-th pixel, 0 where invalid, for co-visibility.
        valid_share: share of the image's pixels with usable depth.
    """

    records: torch.Tensor
    normals: torch.Tensor
    lattice: torch.Tensor
    valid_share: float

    def to(self, device: torch.device) -> "FramePixels":
        """The same on another device."""
        return FramePixels(self.records.to(device), self.normals.to(device), self.lattice.to(device), self.valid_share)


def sample_frame(frame: RgbdFrame, camera: Camera, config: Config) -> FramePixels:
    """Draws `pixels.per_frame` pixels with valid depth, with replacement, and finds their normals.

    Args:
        frame: colour and depth; `frame.index` keys the draw.
        camera: pinhole intrinsics of the frame.
        config: sections `dataset` (depth range), `pixels` and `prior` (normals).
    """
    depth = usable_depth(frame.depth, config.dataset.min_depth_m, config.dataset.max_depth_m)
    valid = np.flatnonzero(depth)
    count = config.pixels.per_frame if len(valid) else 0
    draw = ops.sample_indices(config.seed, ops.Stream.PIXEL_DATABASE, frame.index, 0, count, max(len(valid), 1)).numpy()
    chosen = valid[draw]
    v, u = np.divmod(chosen, camera.width)
    normals = ops.depth_normals(
        torch.from_numpy(depth),
        torch.from_numpy(np.stack([u, v], 1).astype(np.int32)),
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        config.prior.normal_step_px,
        config.prior.max_jump,
    )
    offset = LATTICE_STEP_PX // 2
    lattice = depth[offset::LATTICE_STEP_PX, offset::LATTICE_STEP_PX]
    return FramePixels(
        records=torch.from_numpy(
            _pack(u, v, depth.ravel()[chosen], frame.color.reshape(-1, 3)[chosen], normals, camera)
        ),
        normals=normals,
        lattice=torch.from_numpy(lattice.astype(np.float16)),
        valid_share=len(valid) / depth.size,
    )


def usable_depth(depth: np.ndarray, min_depth_m: float, max_depth_m: float) -> np.ndarray:
    """float32 [H, W] depth (m) with everything outside the range, and what is not finite, set to 0."""
    usable = np.nan_to_num(depth, nan=0.0, posinf=0.0, neginf=0.0)
    return np.where((usable >= min_depth_m) & (usable <= max_depth_m), usable, np.float32(0)).astype(
        np.float32, copy=False
    )


def unpack_points(records: torch.Tensor, camera: Camera) -> torch.Tensor:
    """Surface points of pixel records in camera axes: float32 [P, 3], m."""
    u = (records[:, 0] & 0xFFFF).float()
    v = ((records[:, 0] >> 16) & 0xFFFF).float()
    z = records[:, 1].contiguous().view(torch.float32)
    return torch.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], 1)


def _pack(
    u: np.ndarray, v: np.ndarray, depth: np.ndarray, color: np.ndarray, normals: torch.Tensor, camera: Camera
) -> np.ndarray:
    n = normals.numpy()
    foreshortening = np.abs(n[:, 0] * ((u - camera.cx) / camera.fx) + n[:, 1] * ((v - camera.cy) / camera.fy) + n[:, 2])
    records = np.empty((len(u), 3), np.uint32)
    records[:, 0] = u.astype(np.uint32) | (v.astype(np.uint32) << 16)
    records[:, 1] = depth.astype(np.float32).view(np.uint32)
    bytes_ = np.empty((len(u), 4), np.uint8)
    bytes_[:, :3] = color
    bytes_[:, 3] = np.clip(np.rint(foreshortening * FORESHORTENING_SCALE), 0, 255)
    records[:, 2] = bytes_.view(np.uint32)[:, 0]
    return records.view(np.int32)
