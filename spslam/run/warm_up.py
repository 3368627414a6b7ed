"""Warm-up before the first frame: loading a CUDA kernel at its first use takes longer than running it."""

import contextlib

import numpy as np
import torch

from spslam.camera import Camera
from spslam.config import Config
from spslam.datasets.base import RgbdFrame
from spslam.slam.device_events import event_recorder
from spslam.slam.frame_report import FrameReport
from spslam.slam.system import SlamSystem

FRAMES = 4
DEPTH_M = 2.0
RELIEF_M = 0.1
WAVES = 6  # across the image
MOST_VOXELS = 2**22
PIXELS_MB = 64


def warm_up(config: Config, camera: Camera, device: torch.device) -> list[FrameReport]:
    """Processes a few synthetic frames of a wall with a system that is then discarded.

    They come as a camera's do; a dataset's, which reading processes sample, need no more kernels than these.

    On CUDA the wall also vanishes and comes back, so that a frame that is lost late in a run need not wait for what
    finds it again to be loaded.

    Args:
        config: of the run; used with few iterations.
        camera: intrinsics of the run's frames.
        device: of the run.

    Returns:
        The reports of the frames before. Loaded kernels and reserved memory are all that remains; results don't change.
    """
    shortened = _shortened(config)
    loads = device.type == "cuda"
    frames = [_wall_frame(camera, config, index) for index in range(FRAMES + (2 if loads else 0))]
    if loads:
        frames[-2] = _other_frame(frames[-2])
    with contextlib.closing(SlamSystem(shortened, camera, device=device)) as system:
        reports = [system.submit(system.prepare(frame)).result() for frame in frames]
        system.finish()
    event_recorder(device)().wait()
    return reports[:FRAMES]


def _shortened(config: Config) -> Config:
    """The configuration with few iterations, mapping after each frame, fewer frames per mapping call than exist, and
    without the process and the limits that are the run's."""
    mapping = config.mapping.model_copy(
        update={"every": 1, "iterations": 2, "first_iterations": 4, "frames": 2, "recent": 1, "covisible": 1}
    )
    run = config.run.model_copy(update={"graph_solver": "thread"})
    # Limits of the run's map: the wall may be larger than the run's scene.
    scene = config.scene.model_copy(update={"max_voxels": max(config.scene.max_voxels, MOST_VOXELS)})
    pixels = config.pixels.model_copy(update={"budget_mb": max(config.pixels.budget_mb, PIXELS_MB)})
    return config.model_copy(update={"mapping": mapping, "run": run, "scene": scene, "pixels": pixels})


def _wall_frame(camera: Camera, config: Config, index: int) -> RgbdFrame:
    """A frame of a wall with some relief, within the valid depth range."""
    dataset = config.dataset
    depth_m = float(np.clip(DEPTH_M, 1.1 * dataset.min_depth_m, 0.9 * dataset.max_depth_m))
    v, u = np.mgrid[: camera.height, : camera.width] * (2 * np.pi * WAVES / camera.width)
    relief = np.sin(u) * np.cos(v)
    depth = (depth_m * (1 + RELIEF_M / DEPTH_M / 2 * relief)).astype(np.float32)
    color = np.repeat((127 + 100 * relief).astype(np.uint8)[..., None], 3, axis=2)
    return RgbdFrame(index, float(index), color, depth)


def _other_frame(frame: RgbdFrame) -> RgbdFrame:
    """A frame of another place: mirrored, and steeply inclined."""
    slope = np.linspace(0.6, 1.0, frame.depth.shape[1], dtype=np.float32)
    depth, color = (np.ascontiguousarray(image[:, ::-1]) for image in (slope * frame.depth, frame.color))
    return RgbdFrame(frame.index, frame.timestamp, 255 - color, depth)
