"""Grows the map from new frames and optimizes it together with the poses (sections III.A, III.C, III.D)."""

from dataclasses import dataclass

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.prior import Prior
from spslam.scene import Scene
from spslam.slam.covisibility import select_frames
from spslam.slam.encode_frame import encode_frame
from spslam.slam.pixels import FramePixels
from spslam.slam.render_options import render_options
from spslam.slam.state import Moments, SlamState, keeps_moments


@dataclass
class MappingTask:
    """An optimization of the map that is made in one go or in parts; the result is the same if nothing comes between.

    Attributes:
        frames: int64 [n] rows of the frames to draw pixels from.
        newest: number of the newest frame; keys the draws.
        fixed_frame: row whose pose is not changed.
        iterations: to be made in all.
        done: made so far.
    """

    frames: torch.Tensor
    newest: int
    fixed_frame: int
    iterations: int
    done: int = 0

    @property
    def left(self) -> int:
        """Iterations still to be made."""
        return self.iterations - self.done


class Mapper:
    """Works on a `SlamState` in place; holds no state of its own but scratch."""

    def __init__(self, config: Config, camera: Camera, prior: Prior | None):
        self.config = config
        self.camera = camera
        self.intrinsics = ops.Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy)
        self.prior = prior
        self._graph = ops.LaunchGraph()

    def integrate(self, state: SlamState, pixels: FramePixels) -> None:
        """Allocates and encodes voxel vertices around the newest frame's surface; grows the tri-planes to cover it."""
        if pixels.count == 0:
            return
        scene = state.scene
        pose = state.frames.pose_rows[len(state.frames) - 1]
        points, normals = ops.trusted.unproject_pixels(pixels.records, pixels.normals, pose, self.intrinsics)
        tf32 = self.config.precision == "tf32"
        encoded = encode_frame(
            scene.volume, points, normals, self._prior(scene), self.config.prior, self.config.seed, tf32
        )
        state.cover_planes(encoded.bounds)

    def _prior(self, scene: Scene) -> Prior | None:
        """The prior, on the scene's device from the first use on."""
        if self.prior is not None:
            self.prior = self.prior.to(scene.device)
        return self.prior

    def optimize(self, state: SlamState, iterations: int) -> torch.Tensor | None:
        """Joint optimization of scene and poses over selected frames.

        Args:
            state: changed in place.
            iterations: I_m.

        Returns:
            float32 [5] losses of the last iteration (total, rgb, depth, free space, SDF); None where there was none.
        """
        task = self.begin(state, iterations)
        return None if task is None else self.advance(state, task, iterations)

    def begin(self, state: SlamState, iterations: int) -> MappingTask | None:
        """Selects frames and resets the optimizer for an optimization that `advance` makes; None if there is none."""
        if iterations == 0 or state.scene.volume.num_voxels == 0:
            return None
        usable = state.usable
        if not usable.numpy().any():
            return None
        return self.begin_on(state, self._select(state, usable), iterations)

    def begin_on(self, state: SlamState, frames: torch.Tensor, iterations: int) -> MappingTask:
        """As `begin`, of an optimization over given frames, int64 [n] rows; some frame must have pixels and a pose."""
        self._reset(state)
        # The first usable frame is kept fixed: it defines the world frame.
        first_usable = int(state.usable.numpy().argmax())
        return MappingTask(frames, len(state.frames) - 1, first_usable, iterations)

    def advance(self, state: SlamState, task: MappingTask, iterations: int) -> torch.Tensor:
        """Makes the next iterations of a task.

        Args:
            state: changed in place. Frames may have been added since the task began, but not vertices of the map.
            task: its progress is kept up to date.
            iterations: at least 1 and at most what is left.

        Returns:
            float32 [5] losses of the last iteration, as `optimize`.
        """
        config = self.config
        options = render_options(config, ops.RandomStream.MAPPING_RAYS, task.newest, task.done)
        # Kept from the first iteration on, moments have as many steps as there were iterations.
        color_steps = state.stamp if keeps_moments(config, "texels") else state.steps
        losses = ops.trusted.optimize_map_(
            state.scene.view(),
            state.pixels.records,
            state.frames.poses,
            task.frames,
            self.intrinsics,
            options,
            self._moments(state),
            (
                int(ops.RandomStream.MAPPING_PIXELS),
                config.mapping.pixels,
                iterations,
                task.fixed_frame,
                state.steps + 1,
                color_steps + 1,
                state.stamp + 1,
            ),
            self._graph,
        )
        task.done += iterations
        state.steps += iterations
        state.stamp += iterations
        return losses[-1]

    def _moments(self, state: SlamState) -> ops.MapMoments:
        """Adam's state of all that is optimized, grown to the scene's size."""
        mapping, scene = self.config.mapping, state.scene
        geometry, color = mapping.optimize_geometry, self.config.loss.rgb > 0
        volume, planes = scene.volume.embeddings, scene.planes.texels
        return ops.MapMoments(
            embeddings=_moments(state, "embeddings", volume).of_table(mapping.embedding_rate) if geometry else None,
            texels=_moments(state, "texels", planes).of_table(mapping.plane_rate) if color else None,
            geometry_params=_decoder(state, "geometry_decoder", scene.geometry_decoder, mapping.decoder_rate, geometry),
            color_params=_decoder(state, "color_decoder", scene.color_decoder, mapping.color_decoder_rate, color),
            poses=_moments(state, "poses", state.frames.poses).of_tensor(mapping.pose_rate)
            if mapping.optimize_poses
            else None,
        )

    def _reset(self, state: SlamState) -> None:
        forgotten = [each for name, each in state.moments.items() if not keeps_moments(self.config, name)]
        past = [each for moments in forgotten for each in (moments.first, moments.second)]
        if past:
            torch._foreach_zero_(past)
        if self.config.mapping.reset_moments:
            state.steps = 0

    def _select(self, state: SlamState, usable: torch.Tensor) -> torch.Tensor:
        frames = state.frames
        return select_frames(
            state.pixels.records, frames.poses, frames.depth_thumbnails, usable, self.camera, self.config
        )


def _moments(state: SlamState, name: str, parameter: torch.Tensor) -> Moments:
    if name not in state.moments:
        state.moments[name] = Moments.like(parameter)
    state.moments[name].fit(len(parameter))
    return state.moments[name]


def _decoder(
    state: SlamState, name: str, parameter: torch.Tensor, rate: float, optimized: bool
) -> ops.AdamMoments | None:
    """Adam's state of a decoder; None where it stays as it is."""
    return _moments(state, name, parameter).of_tensor(rate) if optimized and rate > 0 else None
