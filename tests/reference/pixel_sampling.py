"""Sampling a frame's pixels, in NumPy: mask, draw, normals, packing, thumbnail, depth image, one after the other."""

import numpy as np
import torch

from spslam import ops


def usable_depth(depth: np.ndarray, min_depth: float, max_depth: float) -> np.ndarray:
    """float32 [H, W] depth (m) with everything outside the range, and what is not finite, set to 0."""
    usable = np.nan_to_num(depth, nan=0.0, posinf=0.0, neginf=0.0)
    return np.where((usable >= min_depth) & (usable <= max_depth), usable, np.float32(0)).astype(np.float32)


def sample_frame_pixels(depth, color, fx, fy, cx, cy, sampling: ops.PixelSampling, seed, stream, frame):
    """Records int32 [P, 3], normals float32 [P, 3], thumbnail, depth image, intensity image, number of valid pixels."""
    depth = usable_depth(depth, sampling.min_depth, sampling.max_depth)
    valid = np.flatnonzero(depth)
    count = sampling.count if len(valid) else 0
    chosen = valid[ops.sample_indices(seed, stream, frame, 0, count, max(len(valid), 1)).numpy()]
    v, u = np.divmod(chosen, depth.shape[1])
    pixels = torch.from_numpy(np.stack([u, v], 1).astype(np.int32))
    normals = ops.depth_normals(
        torch.from_numpy(depth), pixels, fx, fy, cx, cy, sampling.step_px, sampling.max_jump
    ).numpy()
    facing = np.abs(normals[:, 0] * ((u - cx) / fx) + normals[:, 1] * ((v - cy) / fy) + normals[:, 2])
    rgbc = np.empty((count, 4), np.uint8)
    rgbc[:, :3] = color.reshape(-1, 3)[chosen]
    rgbc[:, 3] = np.clip(np.rint(facing * 128), 0, 255)
    records = np.empty((count, 3), np.uint32)
    records[:, 0] = u.astype(np.uint32) | (v.astype(np.uint32) << 16)
    records[:, 1] = depth.ravel()[chosen].view(np.uint32)
    records[:, 2] = rgbc.view(np.uint32)[:, 0]
    step = sampling.thumbnail_step
    depth_thumbnail = depth[step // 2 :: step, step // 2 :: step].astype(np.float16)
    return (
        records.view(np.int32),
        normals,
        depth_thumbnail,
        _depth_image(depth, sampling),
        _intensity_image(color, sampling),
        len(valid),
    )


def _depth_image(depth: np.ndarray, sampling: ops.PixelSampling) -> np.ndarray:
    if sampling.depth_image_step == 0:
        return np.zeros((0, 0), np.uint16)
    kept = depth[:: sampling.depth_image_step, :: sampling.depth_image_step]
    units = np.floor(kept * (np.float32(1) / np.float32(sampling.depth_image_unit)) + np.float32(0.5))
    return np.where(units < 65536, units, 0).astype(np.uint16)


def _intensity_image(color: np.ndarray, sampling: ops.PixelSampling) -> np.ndarray:
    if sampling.depth_image_step == 0:
        return np.zeros((0, 0), np.uint8)
    kept = np.asarray(color)[:: sampling.depth_image_step, :: sampling.depth_image_step].astype(np.int64)
    return ((kept @ np.array(ops.LUMA_WEIGHTS) + 500) // 1000).astype(np.uint8)
