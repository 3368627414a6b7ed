"""Interpolation from its definition: gather all corners, weigh, add. Gradients by autograd."""

import torch


def trilinear_interpolate(embeddings, corner_ids, local_coords):
    k = torch.arange(8, device=corner_ids.device)
    bits = torch.stack([k & 1, k >> 1 & 1, k >> 2 & 1], 1).to(local_coords.dtype)
    weights = (bits * local_coords[:, None] + (1 - bits) * (1 - local_coords[:, None])).prod(-1)
    inside = ((corner_ids >= 0) & (corner_ids < len(embeddings))).all(1)
    ids = torch.where(inside[:, None], corner_ids, 0).long()
    if len(embeddings) == 0:
        return embeddings.new_zeros(len(corner_ids), embeddings.shape[1])
    return torch.where(inside[:, None], (embeddings[ids] * weights[..., None]).sum(1), 0)


def _between_texels(texels, u, v):
    """texels [U, V, C] at clamped positions u, v [N] in texels."""
    size_u, size_v = texels.shape[:2]
    u, v = u.clamp(0, size_u - 1), v.clamp(0, size_v - 1)
    iu = u.detach().floor().long().clamp(max=max(size_u - 2, 0))
    iv = v.detach().floor().long().clamp(max=max(size_v - 2, 0))
    ju, jv = (iu + 1).clamp(max=size_u - 1), (iv + 1).clamp(max=size_v - 1)
    fu, fv = (u - iu)[:, None], (v - iv)[:, None]
    low = texels[iu, iv] * (1 - fv) + texels[iu, jv] * fv
    high = texels[ju, iv] * (1 - fv) + texels[ju, jv] * fv
    return low * (1 - fu) + high * fu


def bilinear_interpolate(texels, uv):
    return _between_texels(texels.transpose(0, 1), uv[:, 0], uv[:, 1])


def tri_plane_interpolate(texels, points, cell_size, layout):
    total = 0
    for plane, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
        offset, origin_u, origin_v, size_u, size_v = layout[5 * plane : 5 * plane + 5]
        grid = texels[offset : offset + size_u * size_v].view(size_u, size_v, -1)
        total = total + _between_texels(grid, points[:, a] / cell_size - origin_u, points[:, b] / cell_size - origin_v)
    return total
