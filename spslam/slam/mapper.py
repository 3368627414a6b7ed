"""Grows the map from new frames and optimises it together with the poses (sections III.A, III.C, III.D)."""

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.geometry import quaternion_to_matrix
from spslam.prior import Prior, encode_frame
from spslam.slam.covisibility import POINTS, select_frames
from spslam.slam.optimization import quaternion_gradient, render_options
from spslam.slam.pixels import FramePixels, unpack_points
from spslam.slam.state import Moments, SlamState


class Mapper:
    """Works on a `SlamState` in place; holds no state of its own but scratch."""

    def __init__(self, config: Config, camera: Camera, prior: Prior | None):
        self.config = config
        self.camera = camera
        self.intrinsics = ops.Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy)
        self.prior = prior

    def integrate(self, state: SlamState, pixels: FramePixels) -> None:
        """Allocates voxels around the newest frame's surface, fills them from the prior, and covers it with planes."""
        if len(pixels.records) == 0:
            return
        pose, scene = state.frames.poses[-1], state.scene
        points = self._to_world(unpack_points(pixels.records, self.camera), pose)
        margin = self.config.scene.truncation_m
        moved = scene.planes.cover(torch.stack([points.min(0).values - margin, points.max(0).values + margin]))
        if moved is not None and "texels" in state.moments:
            state.moments["texels"].move_rows(moved, len(scene.planes.texels))
        normals = self._rotate(pixels.normals, pose)
        encode_frame(scene.volume, points, normals, self.prior, self.config.prior, self.config.seed)

    def optimize(self, state: SlamState, iterations: int) -> torch.Tensor | None:
        """Joint optimisation of scene and poses over selected frames.

        Args:
            state: changed in place.
            iterations: I_m.

        Returns:
            float32 [5] losses of the last iteration (total, rgb, depth, free space, SDF); None where there was none.
        """
        if iterations == 0 or state.scene.volume.num_voxels == 0:
            return None
        if not bool(state.usable.any()):
            return None
        frames = self._select(state)
        if self.config.mapping.reset_moments:
            _reset(state)
        losses = None
        for iteration in range(iterations):
            losses = self._iterate(state, frames, iteration)
        return losses

    def _iterate(self, state: SlamState, frames: torch.Tensor, iteration: int) -> torch.Tensor:
        config, scene, newest = self.config, state.scene, len(state.frames) - 1
        device = scene.device
        count = config.mapping.pixels
        slot = torch.arange(count) * len(frames) // count
        draw = ops.sample_indices(
            config.seed, ops.Stream.MAPPING_PIXELS, newest, iteration, count, state.pixels.pixels_per_frame, device
        )
        records = state.pixels.records[frames[slot].to(device), draw]
        selected = frames.to(device)
        state.stamp += 1
        state.steps += 1
        gradients = self._gradients(state)
        step = ops.render_step(
            scene.view(),
            ops.RayBatch(
                records,
                slot.to(device, torch.int32),
                state.frames.poses[selected],
                self.intrinsics,
            ),
            render_options(config, ops.Stream.MAPPING_RAYS, newest, iteration, config.mapping.optimize_poses),
            gradients,
        )
        self._step_scene(state, step)
        if step.grad_poses is not None:
            self._step_poses(state, selected, step.grad_poses)
        return step.losses

    def _gradients(self, state: SlamState) -> ops.SceneGradients:
        """Buffers for the gradients of what is optimised, grown to the scene's size."""
        scene, config = state.scene, self.config
        frozen: tuple[torch.Tensor | None, torch.Tensor | None] = (None, None)
        embeddings = texels = frozen
        if config.mapping.optimize_geometry:
            embeddings = _buffers(state, "embeddings", scene.volume.embeddings)
        if config.loss.rgb > 0:
            texels = _buffers(state, "texels", scene.planes.texels)
        return ops.SceneGradients(*embeddings, *texels, stamp=state.stamp)

    def _step_scene(self, state: SlamState, step: ops.RenderStep) -> None:
        mapping, scene = self.config.mapping, state.scene
        if step.grad_geometry is not None:
            self._adam_rows(state, "embeddings", scene.volume.embeddings, mapping.embedding_rate)
            self._adam_dense(
                state, "geometry_decoder", scene.geometry_decoder, step.grad_geometry, mapping.decoder_rate
            )
        if step.grad_color is not None:
            self._adam_rows(state, "texels", scene.planes.texels, mapping.plane_rate)
            self._adam_dense(state, "color_decoder", scene.color_decoder, step.grad_color, mapping.color_decoder_rate)

    def _adam_rows(self, state: SlamState, name: str, parameter: torch.Tensor, rate: float) -> None:
        m, rows = state.moments[name], len(parameter)
        ops.sparse_adam_(
            parameter,
            m.gradient[:rows],
            m.first[:rows],
            m.second[:rows],
            m.stamps[:rows],
            state.stamp,
            lr=rate,
            step=state.steps,
        )

    def _adam_dense(
        self, state: SlamState, name: str, parameter: torch.Tensor, gradient: torch.Tensor, rate: float
    ) -> None:
        if rate == 0:
            return
        m = _moments(state, name, parameter)
        ops.sparse_adam_(parameter, gradient, m.first, m.second, lr=rate, step=state.steps)

    def _step_poses(self, state: SlamState, selected: torch.Tensor, grad_poses: torch.Tensor) -> None:
        poses = state.frames.poses
        m = _moments(state, "poses", poses)
        # The frame that founded the map holds the world in place.
        free = selected != state.usable.nonzero()[0, 0].to(selected.device)
        rows = selected[free]
        m.gradient[rows] = quaternion_gradient(poses[rows], grad_poses[free])
        m.stamps[rows] = state.stamp
        self._adam_rows(state, "poses", poses, self.config.mapping.pose_rate)
        poses[rows, :4] /= poses[rows, :4].norm(dim=1, keepdim=True)

    def _select(self, state: SlamState) -> torch.Tensor:
        config, frames, usable = self.config, state.frames, state.usable
        current = int(usable.nonzero()[-1])
        records = state.pixels.records[current]
        draw = ops.sample_indices(
            config.seed, ops.Stream.COVISIBILITY, len(frames) - 1, 0, POINTS, len(records), records.device
        )
        points = self._to_world(unpack_points(records[draw], self.camera), frames.poses[current])
        rotations = _rotations(frames.poses)
        return select_frames(points, rotations, frames.poses[:, 4:], frames.lattices, usable, self.camera, config)

    def _to_world(self, points: torch.Tensor, pose: torch.Tensor) -> torch.Tensor:
        return self._rotate(points, pose) + pose[4:]

    @staticmethod
    def _rotate(vectors: torch.Tensor, pose: torch.Tensor) -> torch.Tensor:
        return vectors.to(pose.device) @ _rotations(pose[None])[0].T


def _rotations(poses: torch.Tensor) -> torch.Tensor:
    """float32 [F, 3, 3] rotations of poses [F, 7]."""
    matrices = quaternion_to_matrix(poses[:, :4].double().cpu().numpy())
    return torch.from_numpy(matrices).to(poses.device, torch.float32)


def _moments(state: SlamState, name: str, parameter: torch.Tensor) -> Moments:
    if name not in state.moments:
        state.moments[name] = Moments.like(parameter)
    state.moments[name].fit(len(parameter))
    return state.moments[name]


def _buffers(state: SlamState, name: str, parameter: torch.Tensor) -> tuple[torch.Tensor | None, torch.Tensor | None]:
    """Where the gradient of a parameter's rows, and which rows have one, are kept."""
    moments = _moments(state, name, parameter)
    return moments.gradient, moments.stamps


def _reset(state: SlamState) -> None:
    for moments in state.moments.values():
        moments.reset()
    state.steps = 0
