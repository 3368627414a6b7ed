"""Compositing of rays as the papers write it, one ray at a time. Gradients by autograd."""

import torch


def alpha_composite(opacities, values, t, lengths=None, packed_info=None, stop=0.0):
    """Products and sums over explicit lists of the samples of each ray."""
    alpha = opacities if lengths is None else 1 - torch.exp(-opacities * lengths)
    if packed_info is None:
        rays = [range(r * alpha.shape[1], (r + 1) * alpha.shape[1]) for r in range(alpha.shape[0])]
    else:
        rays = [range(first, first + count) for first, count in packed_info.tolist()]
    flat_alpha, flat_t, flat_values = alpha.flatten(), t.flatten(), values.reshape(alpha.numel(), values.shape[-1])
    weights = torch.zeros_like(flat_alpha)
    outputs = []
    for ray in rays:
        samples = torch.tensor(list(ray), dtype=torch.long, device=alpha.device)
        own = flat_alpha[samples]
        reaching = torch.cat([own.new_ones(1), torch.cumprod(1 - own, 0)])[:-1] if len(own) else own
        own_weights = torch.where(reaching >= stop, own * reaching, 0)
        weights = weights.index_add(0, samples, own_weights)
        outputs.append((own_weights @ flat_values[samples], own_weights @ flat_t[samples], own_weights.sum()))
    if not outputs:
        return (
            values.new_zeros(0, values.shape[-1]),
            values.new_zeros(0),
            values.new_zeros(0),
            weights.view(alpha.shape),
        )
    stacked = [torch.stack(part) for part in zip(*outputs, strict=True)]
    return *stacked, weights.view(alpha.shape)


def neus_alpha(front, back, sharpness):
    inside = torch.sigmoid(sharpness * front)
    return ((inside - torch.sigmoid(sharpness * back)) / inside).clamp(min=0)


def volsdf_density(sdf, beta):
    """Cumulative distribution of a Laplace distribution of mean zero at -sdf, over beta."""
    return torch.distributions.Laplace(torch.zeros_like(sdf), beta * torch.ones_like(sdf)).cdf(-sdf) / beta
