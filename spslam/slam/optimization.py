"""What tracking and mapping share: the settings of a render step and Adam on poses."""

import torch

from spslam import ops
from spslam.config import Config

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-8  # Adam's published constants


def render_options(
    config: Config, stream: ops.Stream, frame: int, iteration: int, pose_gradient: bool = True
) -> ops.RenderOptions:
    """The sampling, losses and random counters of one render step, from the configuration."""
    return ops.RenderOptions(
        num_uniform=config.sampling.uniform,
        num_surface=config.sampling.surface,
        near=config.sampling.near,
        far=config.sampling.far,
        truncation=config.scene.truncation_m,
        cosine_targets=config.loss.cosine_targets,
        weight_rgb=config.loss.rgb,
        weight_depth=config.loss.depth,
        weight_free_space=config.loss.free_space,
        weight_sdf=config.loss.sdf,
        seed=config.seed,
        stream=stream,
        frame=frame,
        iteration=iteration,
        pose_gradient=pose_gradient,
    )


def quaternion_gradient(poses: torch.Tensor, grad_poses: torch.Tensor) -> torch.Tensor:
    """Gradients for the seven pose numbers from those for left increments.

    For R(q) and a left increment omega about the camera's centre, dq = (0, omega) q / 2; so the gradient in the unit
    quaternion's tangent space is 2 (0, g_omega) q.

    Args:
        poses: float32 [F, 7], unit quaternion (w, x, y, z) and translation.
        grad_poses: float32 [F, 6] gradient for translation (3) and omega (3).

    Returns:
        float32 [F, 7].
    """
    w, x, y, z = poses[:, :4].unbind(1)
    a, b, c = grad_poses[:, 3:].unbind(1)
    rotation = 2 * torch.stack(
        [-a * x - b * y - c * z, a * w + b * z - c * y, b * w + c * x - a * z, c * w + a * y - b * x], 1
    )
    return torch.cat([rotation, grad_poses[:, :3]], 1)


class PoseAdam:
    """Adam on poses [F, 7] in place, with separate rates for rotation and translation."""

    def __init__(self, poses: torch.Tensor, rotation_rate: float, translation_rate: float):
        self.poses = poses
        self.rates = poses.new_tensor([rotation_rate] * 4 + [translation_rate] * 3)
        self.first = torch.zeros_like(poses)
        self.second = torch.zeros_like(poses)

    def step(self, grad_poses: torch.Tensor, step: int) -> None:
        """One step, `step` counted from 1; quaternions are renormalised."""
        gradient = quaternion_gradient(self.poses, grad_poses)
        self.first.mul_(BETA1).add_(gradient, alpha=1 - BETA1)
        self.second.mul_(BETA2).addcmul_(gradient, gradient, value=1 - BETA2)
        corrected = (self.second / (1 - BETA2**step)).sqrt_().add_(EPSILON)
        self.poses -= self.rates / (1 - BETA1**step) * self.first / corrected
        self.poses[:, :4] /= self.poses[:, :4].norm(dim=1, keepdim=True)
