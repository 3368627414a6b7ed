"""The fused step, composed of the other formulas in float64 and differentiated by autograd."""

import numpy as np
import torch

from tests.reference.interpolation import tri_plane_interpolate, trilinear_interpolate
from tests.reference.ray_sampling import sample_along_rays
from tests.reference.volume_rendering import rendering_losses, volume_render

PARAMETERS = ("embeddings", "geometry_params", "texels", "color_params")


def _mlp(x, params, outputs):
    widths, offset = (x.shape[1], 32, 32, outputs), 0
    for layer, (columns, rows) in enumerate(zip(widths[:-1], widths[1:], strict=True)):
        weights = params[offset : offset + rows * columns].view(rows, columns)
        offset += rows * columns
        x = x @ weights.T + params[offset : offset + rows]
        offset += rows
        if layer < 2:
            x = x.relu()
    return x


def unpack(pixels):
    """Pixel records to (u, v, depth, color in [0, 1], foreshortening), float64."""
    words = np.ascontiguousarray(pixels.cpu().numpy()).view(np.uint32)
    color = np.stack([words[:, 2] >> shift & 255 for shift in (0, 8, 16)], 1) / 255
    fields = words[:, 0] & 0xFFFF, words[:, 0] >> 16, words[:, 1].view(np.float32), color, (words[:, 2] >> 24) / 128
    return [torch.from_numpy(np.asarray(f, np.float64)) for f in fields]


def _rotation(q):
    w, x, y, z = (q / q.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _cross_matrix(omega):
    x, y, z = omega.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [torch.stack(row, -1) for row in ([zero, -z, y], [z, zero, -x], [-y, x, zero])]
    return torch.stack(rows, -2)


def _corner_ids(scene, points):
    """The complete row beside the lowest corner of each point's cell, or a row of -1."""
    keys, values = scene.hash_keys.cpu().numpy(), scene.hash_values.cpu().numpy()
    ids = {int(key): int(value) for key, value in zip(keys, values, strict=True) if key >= 0}
    corners = np.concatenate([scene.corner_ids.cpu().numpy(), np.full((1, 8), -1, np.int32)])
    coords = np.floor(points.detach().numpy() / np.float64(np.float32(scene.voxel_size))).astype(np.int64) + 2**20
    packed = coords[:, 0] << 42 | coords[:, 1] << 21 | coords[:, 2]
    return torch.from_numpy(corners[[ids.get(int(key), -1) for key in packed]])


def sdf(scene, parameters, points):
    """Normalized SDF [N] and whether a point is inside, of float64 points [N, 3]."""
    corners = _corner_ids(scene, points)
    u = points / scene.voxel_size
    feature = trilinear_interpolate(parameters["embeddings"], corners, u - u.detach().floor())
    position = (points - torch.tensor(scene.origin, dtype=torch.float64)) * scene.position_scale
    value = _mlp(torch.cat([position, feature], 1), parameters["geometry_params"], 1).tanh()[:, 0]
    inside = corners[:, 0] >= 0
    return torch.where(inside, value, 1), inside


def color(scene, parameters, points):
    """RGB [N, 3] of float64 points [N, 3]."""
    feature = tri_plane_interpolate(parameters["texels"], points, scene.plane_cell_size, scene.plane_layout)
    return _mlp(feature, parameters["color_params"], 3).sigmoid()


def render_step(scene, rays, options):
    """Losses [5] and gradients by name (`poses` and PARAMETERS), float64."""
    parameters = {name: getattr(scene, name).detach().cpu().double().requires_grad_() for name in PARAMETERS}
    frames = rays.ray_frames.cpu().long()
    increments = torch.zeros(len(rays.poses), 6, dtype=torch.float64, requires_grad=True)
    u, v, depth, target_color, foreshortening = unpack(rays.pixels)
    k = rays.intrinsics
    directions = torch.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, torch.ones_like(u)], 1)
    poses = rays.poses.detach().cpu().double()
    directions = (_rotation(poses[frames, :4]) @ directions[..., None])[..., 0]
    # First order in the increment, which is all that its gradient at zero sees.
    directions = directions + (_cross_matrix(increments[frames, 3:]) @ directions[..., None])[..., 0]
    origins = poses[frames, 4:] + increments[frames, :3]
    t = sample_along_rays(
        depth,
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
    points = (origins[:, None] + t[..., None] * directions[:, None]).reshape(-1, 3)
    values, inside = sdf(scene, parameters, points)
    values, inside = values.view(t.shape), inside.view(t.shape) & (depth > 0)[:, None]
    rgb = color(scene, parameters, points).view(*t.shape, 3)
    rendered_color, rendered_depth, weights = volume_render(values, rgb, t, inside, options.truncation)
    terms = rendering_losses(
        rendered_color,
        rendered_depth,
        values,
        t,
        inside,
        weights.sum(1) > 0,
        target_color,
        depth,
        foreshortening,
        options.truncation,
        options.cosine_targets,
    )
    factors = [options.weight_rgb, options.weight_depth, options.weight_free_space, options.weight_sdf]
    total = (terms * terms.new_tensor(factors)).sum()
    leaves = [increments, *parameters.values()]
    gradients = torch.autograd.grad(total, leaves, allow_unused=True)
    found = [torch.zeros_like(leaf) if g is None else g for leaf, g in zip(leaves, gradients, strict=True)]
    return torch.cat([total[None], terms]).detach(), dict(zip(("poses", *PARAMETERS), found, strict=True))
