"""The frame loop: what happens to one frame, in order."""

import math
import time
from dataclasses import dataclass

import numpy as np
import torch

from spslam.camera import Camera
from spslam.config import Config
from spslam.datasets.base import RgbdFrame
from spslam.errors import DatasetError
from spslam.prior import load_prior
from spslam.slam.mapper import Mapper
from spslam.slam.pixels import FramePixels, sample_frame
from spslam.slam.state import SlamState, pose_tensor
from spslam.slam.tracker import Tracker, TrackingResult
from spslam.trajectory import Trajectory

MAX_DISTANCE_M = 10_000.0  # a float32 still tells a millimetre there


@dataclass(frozen=True)
class FrameReport:
    """What happened to one frame; a line of log.jsonl.

    Attributes:
        frame: number of the frame in the run, from 0.
        index: its index in the data set.
        timestamp: s.
        lost: whether its pose is not to be trusted.
        valid_depth: share of pixels with usable depth.
        tracking_iterations, tracking_ms: of this frame; 0 for the first.
        residual_cm: weighted RMS distance of its pixels to the map; None where it was not tracked.
        inliers: share of its pixels on mapped surface; None where it was not tracked.
        encode_ms: allocation, encoding and fusion; 0 where the frame was not mapped.
        mapping_iterations, mapping_ms: of the joint optimisation after this frame.
        loss: total loss of the last mapping iteration; None where there was none.
        voxels: allocated vertices.
    """

    frame: int
    index: int
    timestamp: float
    lost: bool
    valid_depth: float
    tracking_iterations: int
    tracking_ms: float
    residual_cm: float | None
    inliers: float | None
    encode_ms: float
    mapping_iterations: int
    mapping_ms: float
    loss: float | None
    voxels: int


class SlamSystem:
    """Tracks and maps RGB-D frames, one `process` call each.

    Example:
        >>> system = SlamSystem(load_config("folder"), camera)          # doctest: +SKIP
        >>> for frame in frames: system.process(frame)                  # doctest: +SKIP
        >>> system.finish(); system.trajectory().save_tum("path.txt")   # doctest: +SKIP
    """

    def __init__(
        self,
        config: Config,
        camera: Camera,
        first_pose: np.ndarray | None = None,
        device: torch.device | str = "cpu",
    ):
        """A system that has seen nothing.

        Args:
            config: settings.
            camera: pinhole intrinsics of all frames.
            first_pose: float64 [4, 4] T_world_camera of the first frame; identity where not given.
            device: where the map lives and the kernels run.

        Raises:
            DatasetError: the first pose lies too far from the world's origin.
        """
        self.config = config
        self.camera = camera
        self.device = torch.device(device)
        prior = load_prior(config.prior.weights) if config.prior.enabled else None
        decoder = prior.decoder_params if prior is not None and config.prior.decoder == "pretrained" else None
        self.first_pose = np.eye(4) if first_pose is None else np.asarray(first_pose, np.float64)
        _check_first_pose(self.first_pose)
        self.state = SlamState.start(config, camera, self.first_pose, decoder, self.device)
        self.tracker = Tracker(config, camera)
        self.mapper = Mapper(config, camera, prior)

    def process(self, frame: RgbdFrame, pixels: FramePixels | None = None) -> FrameReport:
        """Takes the next frame in.

        Args:
            frame: colour, depth, timestamp.
            pixels: `sample_frame(frame, camera, config)`, if that was done ahead on another thread.

        Raises:
            SpslamError: the map or the pixels would pass a limit of the configuration. The frame has then been taken
                in half, and the system must not be given another.
        """
        if pixels is None:
            pixels = sample_frame(frame, self.camera, self.config)
        pixels = pixels.to(self.device)
        number = len(self.state.frames)
        tracked, tracking_ms = _timed(lambda: self._track(pixels, number))
        self.state.frames.append(tracked.pose, frame.timestamp, frame.index, tracked.lost, pixels.lattice)
        self.state.pixels.add(pixels.records)
        # A lost frame must not touch the map.
        mapped = not tracked.lost and self._is_mapping_frame(number)
        self.state.unmapped = not mapped
        encode_ms, mapping_ms, iterations, losses = self._map(pixels, number) if mapped else (0.0, 0.0, 0, None)
        return FrameReport(
            frame=number,
            index=frame.index,
            timestamp=frame.timestamp,
            lost=bool(self.state.frames.lost[-1]),
            valid_depth=pixels.valid_share,
            tracking_iterations=tracked.iterations,
            tracking_ms=tracking_ms,
            residual_cm=_known(tracked.residual_cm),
            inliers=_known(tracked.inlier_share),
            encode_ms=encode_ms,
            mapping_iterations=iterations,
            mapping_ms=mapping_ms,
            loss=None if losses is None else float(losses[0]),
            voxels=self.state.scene.volume.num_voxels,
        )

    def finish(self) -> None:
        """Optimises once more if frames came after the last mapping call. Call it after the last frame."""
        if self.state.unmapped:
            self.mapper.optimize(self.state, self.config.mapping.iterations)
            self.state.unmapped = False

    def trajectory(self) -> Trajectory:
        """Poses of all frames as they are refined up to now."""
        frames = self.state.frames
        return Trajectory(frames.timestamps.numpy().copy(), frames.matrices(), frames.lost.numpy().copy())

    def _track(self, pixels: FramePixels, number: int) -> TrackingResult:
        if self.state.scene.volume.num_voxels == 0:
            pose = pose_tensor(self.first_pose, self.device)
            return TrackingResult(pose, 0, math.nan, math.nan, lost=self.tracker.is_blind(pixels))
        start = self.tracker.predict(self.state.frames)
        return self.tracker.track(self.state.scene, pixels, start, number)

    def _is_mapping_frame(self, number: int) -> bool:
        return number % self.config.mapping.every == 0 or self.state.scene.volume.num_voxels == 0

    def _map(self, pixels: FramePixels, number: int) -> tuple[float, float, int, torch.Tensor | None]:
        first = self.state.scene.volume.num_voxels == 0
        _, encode_ms = _timed(lambda: self.mapper.integrate(self.state, pixels))
        if self.state.scene.volume.num_voxels == 0:
            # Depth without a surface in it: the map must begin with a later frame, and so must the path.
            self.state.frames.lost[-1] = True
            return encode_ms, 0.0, 0, None
        iterations = self.config.mapping.first_iterations if first else self.config.mapping.iterations
        losses, mapping_ms = _timed(lambda: self.mapper.optimize(self.state, iterations))
        return encode_ms, mapping_ms, iterations, losses


def _check_first_pose(pose: np.ndarray) -> None:
    distance = float(np.linalg.norm(pose[:3, 3]))
    if not distance <= MAX_DISTANCE_M:
        raise DatasetError(
            f"the first pose must lie within {MAX_DISTANCE_M / 1000:.0f} km of the world's origin, got "
            f"{distance / 1000:.0f} km; scene.first_pose=identity starts at the origin instead"
        )


def _known(number: float) -> float | None:
    """None for NaN, which JSON has no word for."""
    return None if math.isnan(number) else number


def _timed(call):
    started = time.perf_counter()
    result = call()
    return result, 1e3 * (time.perf_counter() - started)
