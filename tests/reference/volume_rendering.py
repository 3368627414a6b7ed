"""Rendering weights and losses as the equations write them. Gradients by autograd."""

import torch


def rendering_weights(sdf, t, valid, truncation):
    bell = torch.sigmoid(sdf / truncation) * torch.sigmoid(-sdf / truncation)
    crossing = torch.where(valid & (sdf < 0), t, torch.inf).amin(1, keepdim=True) if sdf.shape[1] else t[:, :0]
    weights = torch.where(valid & (bell >= 1e-3) & (t <= crossing + truncation), bell, 0)
    total = weights.sum(1, keepdim=True)
    return torch.where(total > 0, weights / torch.where(total > 0, total, 1), 0)


def volume_render(sdf, color, t, valid, truncation):
    weights = rendering_weights(sdf, t, valid, truncation)
    return (weights[..., None] * color).sum(1), (weights * t).sum(1), weights


def rendering_losses(
    color, depth, sdf, t, valid, rendered, target_color, target_depth, cosine, truncation, cosine_targets
):
    measured = (target_depth > 0) & target_depth.isfinite()
    rendered = rendered & measured
    c = torch.where((cosine > 0) & cosine_targets, cosine.clamp(min=0.15), 1)[:, None]
    distance = (target_depth[:, None] - t) * c
    near = (distance.abs() < truncation) & valid & measured[:, None]
    free = (distance >= truncation) & measured[:, None]
    near_error = torch.where(near, (sdf * truncation - distance) ** 2, 0).sum(1) / near.sum(1).clamp(min=1)
    free_error = torch.where(free & valid, (sdf - 1) ** 2, 0).sum(1) / free.sum(1).clamp(min=1)
    color_error = torch.where(rendered[:, None], (color - target_color) ** 2, 0).mean(1)
    depth_error = torch.where(rendered, (depth - target_depth) ** 2, 0)
    return torch.stack([color_error, depth_error, free_error, near_error]).sum(1) / max(len(depth), 1)
