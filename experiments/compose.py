"""`spslam.ops.render_step` composed of separate ops with autograd, for comparison with the fused step.

The separate ops come from one of two libraries: OPS, the public ops of spslam, or TORCH, plain torch. Ray sampling and
hash lookup are the public ops in both, as torch has neither Philox nor a hash table.
"""

from dataclasses import dataclass
from typing import Any

import torch

from spslam import ops

HIDDEN = 32


class OpsParts:
    """The parts as public ops of spslam."""

    trilinear_interpolate = staticmethod(ops.trilinear_interpolate)
    tri_plane_interpolate = staticmethod(ops.tri_plane_interpolate)
    volume_render = staticmethod(ops.volume_render)
    rendering_losses = staticmethod(ops.rendering_losses)

    @staticmethod
    def mlp(x: torch.Tensor, params: torch.Tensor, outputs: int, activation: ops.Activation) -> torch.Tensor:
        return ops.mlp(x, params, HIDDEN, outputs, activation)


class TorchParts:
    """The parts in plain torch, written for speed: no loop, gathers by index_select, fused linear layers."""

    @staticmethod
    def trilinear_interpolate(embeddings, corner_ids, local_coords):
        x, y, z = torch.stack([1 - local_coords, local_coords], 1).unbind(-1)
        weights = (z[:, :, None, None] * y[:, None, :, None] * x[:, None, None, :]).reshape(-1, 8)
        rows = embeddings.index_select(0, corner_ids.clamp(min=0).flatten())
        return torch.bmm(weights[:, None], rows.view(-1, 8, embeddings.shape[1]))[:, 0]

    @staticmethod
    def tri_plane_interpolate(texels, points, cell_size, layout):
        position = points * (1 / cell_size)
        rows, weights = [], []
        for plane, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
            offset, origin_u, origin_v, size_u, size_v = layout[5 * plane : 5 * plane + 5]
            u = (position[:, a] - origin_u).clamp(0, size_u - 1)
            v = (position[:, b] - origin_v).clamp(0, size_v - 1)
            iu, iv = u.detach().floor().clamp(max=size_u - 2), v.detach().floor().clamp(max=size_v - 2)
            row = offset + iu.long() * size_v + iv.long()
            fu, fv = u - iu, v - iv
            rows += [row, row + 1, row + size_v, row + size_v + 1]
            weights += [(1 - fu) * (1 - fv), (1 - fu) * fv, fu * (1 - fv), fu * fv]
        gathered = texels.index_select(0, torch.stack(rows, 1).flatten()).view(len(points), 12, -1)
        return torch.bmm(torch.stack(weights, 1)[:, None], gathered)[:, 0]

    @staticmethod
    def mlp(x, params, outputs, activation):
        widths, offset = (x.shape[1], HIDDEN, HIDDEN, outputs), 0
        for layer, (columns, rows) in enumerate(zip(widths[:-1], widths[1:], strict=True)):
            weight = params[offset : offset + rows * columns].view(rows, columns)
            bias = params[offset + rows * columns : offset + rows * columns + rows]
            offset += rows * columns + rows
            x = torch.nn.functional.linear(x, weight, bias)
            x = x.relu() if layer < 2 else x
        return x.tanh() if activation == ops.Activation.TANH else x.sigmoid()

    @staticmethod
    def volume_render(sdf, color, t, valid, truncation):
        bell = torch.sigmoid(sdf / truncation) * torch.sigmoid(-sdf / truncation)
        crossing = torch.where(valid & (sdf < 0), t, torch.inf).amin(1, keepdim=True)
        weights = torch.where(valid & (bell >= 1e-3) & (t <= crossing + truncation), bell, 0)
        total = weights.sum(1, keepdim=True)
        weights = weights / torch.where(total > 0, total, 1)
        return torch.bmm(weights[:, None], color)[:, 0], (weights * t).sum(1), weights

    @staticmethod
    def rendering_losses(
        color, depth, sdf, t, valid, rendered, target_color, target_depth, cosine, truncation, cosine_targets
    ):
        measured = target_depth > 0
        scale = torch.where((cosine > 0) & cosine_targets, cosine.clamp(min=0.15), 1)
        distance = (target_depth[:, None] - t) * scale[:, None]
        near = (distance.abs() < truncation) & valid & measured[:, None]
        free = (distance >= truncation) & measured[:, None]
        sdf_term = ((sdf * truncation - distance).square() * near).sum(1) / near.sum(1).clamp(min=1)
        free_term = ((sdf - 1).square() * (free & valid)).sum(1) / free.sum(1).clamp(min=1)
        rendered = rendered & measured
        rgb_term = (color - target_color).square().mean(1) * rendered
        depth_term = (depth - target_depth).square() * rendered
        return torch.stack([rgb_term, depth_term, free_term, sdf_term], 1).mean(0)


OPS, TORCH = OpsParts, TorchParts


@dataclass(frozen=True)
class Measurements:
    """Content of R pixel records, in the dtype of the step."""

    directions: torch.Tensor  # [R, 3] in camera axes, z = 1
    depth: torch.Tensor  # [R] m
    color: torch.Tensor  # [R, 3] in [0, 1]
    cosine: torch.Tensor  # [R] foreshortening, 0 where unknown


def unpack_pixels(pixels: torch.Tensor, intrinsics: ops.Intrinsics, dtype: torch.dtype) -> Measurements:
    """Unpacks pixel records int32 [R, 3] (csrc/kernels/pixel_record.h)."""
    uv, bits, rgbc = pixels.unbind(1)
    u, v = (uv & 0xFFFF).to(dtype), (uv >> 16 & 0xFFFF).to(dtype)
    x, y = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy
    channels = torch.stack([rgbc >> shift & 255 for shift in (0, 8, 16, 24)], 1).to(dtype)
    return Measurements(
        directions=torch.stack([x, y, torch.ones_like(x)], 1),
        depth=bits.contiguous().view(torch.float32).to(dtype),
        color=channels[:, :3] / 255,
        cosine=channels[:, 3] / 128,
    )


def rotation_matrices(quaternions: torch.Tensor) -> torch.Tensor:
    """[F, 3, 3] of quaternions (w, x, y, z) [F, 4], normalized first."""
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=1).unbind(1)
    return torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ],
        1,
    ).view(-1, 3, 3)  # fmt: skip


def world_points(
    rays: ops.RayBatch, directions: torch.Tensor, t: torch.Tensor, increments: torch.Tensor | None
) -> torch.Tensor:
    """Sample positions [R, S, 3], differentiable in the left increments [F, 6] of the poses, which are zero."""
    frames, poses = rays.ray_frames.long(), rays.poses.to(directions.dtype)
    turned = torch.bmm(rotation_matrices(poses[:, :4]).index_select(0, frames), directions[..., None])[..., 0]
    centers = poses[:, 4:].index_select(0, frames)
    if increments is not None:
        # exp(omega) to first order, which has the same gradient at zero.
        moved = increments.index_select(0, frames)
        centers = centers + moved[:, :3]
        turned = turned + torch.linalg.cross(moved[:, 3:], turned)
    return centers[:, None] + t[..., None] * turned[:, None]


def compose_render_step(
    scene: ops.SceneView,
    rays: ops.RayBatch,
    options: ops.RenderOptions,
    gradients: ops.SceneGradients | None = None,
    parts: Any = OPS,
    compact: bool = True,
    dtype: torch.dtype = torch.float32,
) -> ops.RenderStep:
    """The composition, with the arguments and results of `spslam.ops.render_step`.

    Args:
        scene, rays, options, gradients: as for `render_step`. Rows of `gradients` with a gradient other than 0 are
            stamped; unlike there, rows that rays reach with a gradient of exactly 0 are not.
        parts: OPS or TORCH.
        compact: decode only the samples inside the volume, which needs a host synchronization; otherwise all samples.
        dtype: float32, or float64 for comparisons.

    Returns:
        losses, grad_poses, grad_geometry and grad_color in `dtype`.
    """
    wanted = _wanted_tables(gradients)
    leaves = {name: getattr(scene, name).to(dtype).detach().requires_grad_(wanted[name]) for name in wanted}
    increments = None
    if options.pose_gradient:
        increments = torch.zeros(len(rays.poses), 6, dtype=dtype, device=rays.poses.device, requires_grad=True)
    terms = _loss_terms(scene, leaves, rays, options, increments, parts, compact, dtype)
    weights = [options.weight_rgb, options.weight_depth, options.weight_free_space, options.weight_sdf]
    total = torch.dot(terms, terms.new_tensor(weights))

    targets = {name: leaf for name, leaf in leaves.items() if leaf.requires_grad}
    if increments is not None:
        targets["poses"] = increments
    found = _gradients_of(total, targets)
    if gradients is not None:
        _add_rows(found.get("embeddings"), gradients.embeddings, gradients.embedding_stamps, gradients.stamp)
        _add_rows(found.get("texels"), gradients.texels, gradients.texel_stamps, gradients.stamp)
    return ops.RenderStep(
        losses=torch.cat([total[None], terms]).detach(),
        grad_poses=found.get("poses"),
        grad_geometry=found.get("geometry_params"),
        grad_color=found.get("color_params"),
    )


def _wanted_tables(gradients: ops.SceneGradients | None) -> dict[str, bool]:
    geometry = gradients is not None and gradients.embeddings is not None
    color = gradients is not None and gradients.texels is not None
    return {"embeddings": geometry, "geometry_params": geometry, "texels": color, "color_params": color}


def _loss_terms(scene, leaves, rays, options, increments, parts, compact, dtype):
    """The four loss terms [4]."""
    seen = unpack_pixels(rays.pixels, rays.intrinsics, dtype)
    t = ops.sample_along_rays(
        seen.depth,
        options.num_uniform,
        options.num_surface,
        options.near,
        options.far,
        options.truncation,
        options.seed,
        options.stream,
        options.frame,
        options.iteration,
    )
    points = world_points(rays, seen.directions, t, increments).view(-1, 3)
    corner_ids, local_coords = ops.voxel_hash_lookup(
        scene.hash_keys, scene.hash_values, scene.corner_ids, points, scene.voxel_size
    )
    valid = (corner_ids[:, 0] >= 0) & (seen.depth > 0).repeat_interleave(t.shape[1])
    active = valid.nonzero()[:, 0] if compact else None
    if active is not None:
        points, corner_ids, local_coords = (x.index_select(0, active) for x in (points, corner_ids, local_coords))

    sdf = _decode_sdf(scene, leaves, points, corner_ids, local_coords, parts)
    color = _decode_color(scene, leaves, points, parts) if options.weight_rgb else points.new_zeros(len(points), 3)
    if active is not None:
        sdf = sdf.new_ones(len(valid)).index_copy(0, active, sdf)
        color = color.new_zeros(len(valid), 3).index_copy(0, active, color)
    valid = valid.view(t.shape)
    sdf = torch.where(valid, sdf.view(t.shape), 1)
    rendered_color, rendered_depth, weights = parts.volume_render(
        sdf, color.view(*t.shape, 3), t, valid, options.truncation
    )
    terms = parts.rendering_losses(
        rendered_color,
        rendered_depth,
        sdf,
        t,
        valid,
        weights.detach().sum(1) > 0,
        seen.color,
        seen.depth,
        seen.cosine,
        options.truncation,
        options.cosine_targets,
    )
    return terms if options.weight_rgb else terms * terms.new_tensor([0.0, 1.0, 1.0, 1.0])


def _decode_sdf(scene, leaves, points, corner_ids, local_coords, parts):
    feature = parts.trilinear_interpolate(leaves["embeddings"], corner_ids, local_coords)
    position = (points - points.new_tensor(scene.origin)) * scene.position_scale
    return parts.mlp(torch.cat([position, feature], 1), leaves["geometry_params"], 1, ops.Activation.TANH)[:, 0]


def _decode_color(scene, leaves, points, parts):
    feature = parts.tri_plane_interpolate(leaves["texels"], points, scene.plane_cell_size, scene.plane_layout)
    return parts.mlp(feature, leaves["color_params"], 3, ops.Activation.SIGMOID)


def _gradients_of(total, targets):
    if not targets or not total.requires_grad:
        return {name: torch.zeros_like(leaf) for name, leaf in targets.items()}
    found = torch.autograd.grad(total, list(targets.values()), allow_unused=True)
    return {
        name: torch.zeros_like(leaf) if g is None else g for (name, leaf), g in zip(targets.items(), found, strict=True)
    }


def _add_rows(found, buffer, stamps, stamp):
    """Adds a table's gradient to its buffer and stamps the rows it touches."""
    if found is None or buffer is None:
        return
    rows = buffer[: len(found)]
    rows += found.to(buffer.dtype)
    if stamps is not None:
        stamps[: len(found)].masked_fill_((found != 0).any(1), stamp)
