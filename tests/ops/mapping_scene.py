"""What the tests of mapping share: a scene with frames and moments, a call on it, and a loop of its parts."""

from dataclasses import replace

import numpy as np
import torch

from spslam import ops
from spslam.geometry import matrix_to_pose7
from tests.ops.scenes import INTRINSICS, OPTIONS, POSES, corner_pixels, make_scene

RENDER_OPTIONS = replace(OPTIONS, seed=2**40 + 3, frame=5, iteration=0)
NUM_PIXELS, ITERATIONS, FIXED = 300, 4, 1
RATES = dict(embeddings=4e-3, texels=4e-3, geometry_params=1e-3, color_params=1e-3, poses=1e-3)


class Map:
    """A scene, the records and poses of five frames, and the moments of all, none of them shared with another."""

    def __init__(self, device, seed=0, spare_rows=3):
        generator = torch.Generator().manual_seed(seed)
        self.device = device
        self.scene = make_scene(generator, random_decoder=True, device=device)
        poses = [POSES[f % len(POSES)] for f in range(5)]
        self.records = torch.stack([corner_pixels(pose, generator, 250) for pose in poses]).to(device)
        self.poses = torch.from_numpy(np.stack([matrix_to_pose7(p) for p in poses])).float()
        self.poses[:, 4:] += 0.005 * torch.randn(5, 3, generator=generator)
        self.poses = self.poses.to(device)
        self.frames = torch.tensor([0, 1, 3, 4])
        self.params = dict(
            embeddings=self.scene.embeddings,
            texels=self.scene.texels,
            geometry_params=self.scene.geometry_params,
            color_params=self.scene.color_params,
            poses=self.poses,
        )
        self.moments = {name: self._moments(param, spare_rows) for name, param in self.params.items()}

    def _moments(self, param, spare_rows):
        rows = len(param) + (spare_rows if param.dim() > 1 else 0)
        first, second = (torch.zeros(rows, *param.shape[1:], device=self.device) for _ in range(2))
        return first, second, ops.new_gradient_sums(first), torch.zeros(rows, dtype=torch.int32, device=self.device)

    def state(self):
        """Everything that a call may change."""
        return [*self.params.values(), *[tensor for moments in self.moments.values() for tensor in moments]]

    def map_moments(self, frozen=()):
        made = {}
        for name, (first, second, gradients, stamps) in self.moments.items():
            if name in ("embeddings", "texels"):
                made[name] = ops.AdamTable(first, second, RATES[name], gradients, stamps)
            else:
                made[name] = ops.AdamMoments(first, second, RATES[name])
        return ops.MapMoments(**{name: None if name in frozen else m for name, m in made.items()})

    def optimize(self, options, iterations=ITERATIONS, frozen=(), **changes):
        arguments = dict(num_pixels=NUM_PIXELS, iterations=iterations, fixed_frame=FIXED, first_step=1, first_stamp=1)
        moments = self.map_moments(frozen)
        return ops.optimize_map_(
            self.scene,
            self.records,
            self.poses,
            self.frames,
            INTRINSICS,
            options,
            moments,
            **(arguments | changes),
        )

    def loop(self, options, iterations=ITERATIONS):
        """The same, part by part."""
        losses = [self._iterate(replace(options, iteration=options.iteration + i), i + 1) for i in range(iterations)]
        return torch.stack(losses)

    def _iterate(self, options, step):
        frames, device = self.frames.to(self.device), self.device
        slot = torch.arange(NUM_PIXELS) * len(frames) // NUM_PIXELS
        pixel_stream = ops.RandomStream.MAPPING_PIXELS
        per_frame = self.records.shape[1]
        draw = ops.sample_indices(
            options.seed, pixel_stream, options.frame, options.iteration, NUM_PIXELS, per_frame, device
        )
        rays = ops.RayBatch(
            self.records[frames[slot.to(device)], draw], slot.int().to(device), self.poses[frames], INTRINSICS
        )
        sums = {name: torch.zeros_like(self.params[name]) for name in ("embeddings", "texels")}
        stamps = {name: self.moments[name][3] for name in sums}
        gradients = ops.SceneGradients(sums["embeddings"], stamps["embeddings"], sums["texels"], stamps["texels"], step)
        result = ops.render_step(self.scene, rays, options, gradients)
        for name, gradient in sums.items():
            self._adam(name, gradient, step, stamps[name][: len(gradient)])
        self._adam("geometry_params", result.grad_geometry, step)
        self._adam("color_params", result.grad_color, step)
        self._step_poses(frames, result.grad_poses, step)
        return result.losses

    def _adam(self, name, gradient, step, stamps=None):
        rows = len(gradient)
        first, second = (moment[:rows] for moment in self.moments[name][:2])
        ops.sparse_adam_(self.params[name], gradient, first, second, stamps, step, lr=RATES[name], step=step)

    def _step_poses(self, frames, grad_poses, step):
        free = frames != FIXED
        rows, (w, x, y, z) = frames[free], self.poses[frames[free], :4].unbind(1)
        a, b, c = grad_poses[free, 3:].unbind(1)
        turn = [-a * x - b * y - c * z, a * w + b * z - c * y, b * w + c * x - a * z, c * w + a * y - b * x]
        gradient = torch.zeros_like(self.poses)
        gradient[rows] = torch.cat([2 * torch.stack(turn, 1), grad_poses[free, :3]], 1)
        stamps = torch.zeros(len(self.poses), dtype=torch.int32, device=self.device)
        stamps[rows] = 1
        self._adam("poses", gradient, step, stamps)  # of stamp `step`: none unless it is 1
        if step != 1:
            stamps[rows] = step
            self._adam("poses", gradient, step, stamps)
        self.poses[rows, :4] /= self.poses[rows, :4].norm(dim=1, keepdim=True)
