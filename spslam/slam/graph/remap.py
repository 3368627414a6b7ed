"""The map made again from keyframes, where the graph has moved them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch

from spslam import ops
from spslam.config import Config
from spslam.geometry import compose, interpolate_pose, inverse
from spslam.prior import Prior
from spslam.scene import Scene, SparseVolume
from spslam.slam.encode_frame import encode_frame
from spslam.slam.graph.keyframe import Keyframe
from spslam.slam.poses import pose_tensor

SAMPLED_SHARE = 1.5  # pixels that are drawn for each that is encoded, as not all have a normal
SAMPLED_AHEAD = 16  # keyframes, of 300 kB of pixels each


@dataclass(frozen=True)
class _Drawn:
    """Pixels that were drawn of a keyframe, and its pose, in one buffer: an upload is one copy.

    Attributes:
        words: int32 [6 N + 7]: records, normals, pose; page-locked where they go to a GPU.
        count: N.
    """

    words: torch.Tensor
    count: int

    def to(self, device: torch.device) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Records int32 [N, 3], normals float32 [N, 3] and the pose float32 [7] on a device; waits for nothing."""
        records, normals, pose = self.words.to(device, non_blocking=True).split([3 * self.count, 3 * self.count, 7])
        return records.view(-1, 3), normals.view(torch.float32).view(-1, 3), pose.view(torch.float32)


def encode_keyframe(volume: SparseVolume, keyframe: Keyframe, pose: np.ndarray, prior: Prior, config: Config) -> None:
    """Fuses a keyframe into a volume as mapping fuses frames; the same bytes every time.

    Args:
        volume: changed.
        keyframe: in the host's memory.
        pose: float64 [4, 4] T_world_camera.
        prior: on the volume's device.
        config: of the run.
    """
    _encode(volume, keyframe, _drawn(keyframe, pose, config, volume.device), prior, config)


def encode_keyframes(
    volume: SparseVolume,
    posed: Iterable[tuple[Keyframe, np.ndarray]],
    prior: Prior,
    config: Config,
    pool: ThreadPoolExecutor | None = None,
) -> None:
    """Does so with several keyframes and their poses, one after the other.

    Args:
        volume: changed.
        posed: keyframes and their float64 [4, 4] T_world_camera.
        prior: on the volume's device.
        config: of the run.
        pool: threads that draw pixels of the next keyframes meanwhile; None draws them in the caller's.
    """
    if pool is None:
        for keyframe, pose in posed:
            encode_keyframe(volume, keyframe, pose, prior, config)
        return
    coming: deque[tuple[Keyframe, Future[_Drawn]]] = deque()

    def fuse_next() -> None:
        keyframe, drawn = coming.popleft()
        _encode(volume, keyframe, drawn.result(), prior, config)

    for keyframe, pose in posed:
        coming.append((keyframe, pool.submit(_drawn, keyframe, pose, config, volume.device)))
        if len(coming) > SAMPLED_AHEAD:
            fuse_next()
    while coming:
        fuse_next()


def _drawn(keyframe: Keyframe, pose: np.ndarray, config: Config, device: torch.device) -> _Drawn:
    records, normals = keyframe.sample(round(SAMPLED_SHARE * config.prior.points_per_frame), config.seed)
    words = torch.empty(6 * len(records) + 7, dtype=torch.int32, pin_memory=device.type == "cuda")
    parts = records, normals.view(torch.int32), pose_tensor(pose, torch.device("cpu")).view(torch.int32)
    torch.cat([part.flatten() for part in parts], out=words)
    return _Drawn(words, len(records))


def _encode(volume: SparseVolume, keyframe: Keyframe, drawn: _Drawn, prior: Prior, config: Config) -> None:
    if not drawn.count:
        return
    points, turned = ops.unproject_pixels(*drawn.to(volume.device), *keyframe.camera.intrinsics)
    encode_frame(volume, points, turned, prior, config.prior, config.seed, config.precision == "tf32")


def empty_volume(scene: Scene) -> SparseVolume:
    """A volume of a scene's settings without vertices."""
    return SparseVolume(scene.settings.voxel_size_m, scene.settings.max_voxels, scene.device)


@contextmanager
def own_stream(device: torch.device) -> Iterator[None]:
    """On CUDA, launches on a stream of its own, so that tracking's need not wait; waits for it at the end."""
    if device.type != "cuda":
        yield
        return
    stream = torch.cuda.Stream(device)
    with torch.cuda.stream(stream):
        yield
    stream.synchronize()


def handed_over(volume: SparseVolume) -> SparseVolume:
    """A volume that was made on another stream, for the current one; the same on the CPU."""
    if volume.device.type != "cuda" or volume.num_voxels == 0:
        return volume
    content = volume.voxel_coords, volume.embeddings, volume.weights
    taken = SparseVolume(volume.voxel_size_m, volume.cells.max_voxels, volume.device)
    taken.restore(*content)
    for tensor in content:
        tensor.record_stream(torch.cuda.current_stream(volume.device))
    return taken


def corrected_poses(poses: np.ndarray, rows: np.ndarray, keyframe_poses: np.ndarray) -> np.ndarray:
    """Poses of all frames after keyframes have moved: each follows the two keyframes that it lies between.

    Args:
        poses: float64 [F, 4, 4] T_world_camera of all frames as they were.
        rows: int64 [K] of the keyframes, ascending.
        keyframe_poses: float64 [K, 4, 4], where they are now.

    Returns:
        float64 [F, 4, 4]. Frames after the last keyframe move as it does.
    """
    corrections = compose(keyframe_poses, inverse(poses[rows]))
    frames = np.arange(len(poses))
    before = np.clip(np.searchsorted(rows, frames, "right") - 1, 0, len(rows) - 1)
    after = np.minimum(before + 1, len(rows) - 1)
    between = np.maximum(rows[after] - rows[before], 1)
    share = np.clip((frames - rows[before]) / between, 0.0, 1.0)
    return interpolate_pose(compose(corrections[before], poses), compose(corrections[after], poses), share)
