"""Philox and the samples along a ray, in NumPy and torch."""

import numpy as np
import torch


def philox4x32(counter: np.ndarray, key: tuple[int, int]) -> np.ndarray:
    """Philox4x32-10 (Salmon et al. 2011) of uint32 counters [N, 4]; returns uint32 [N, 4]."""
    c = counter.astype(np.uint64)
    k0, k1 = np.uint64(key[0]), np.uint64(key[1])
    mask = np.uint64(0xFFFFFFFF)
    for _ in range(10):
        p0, p1 = np.uint64(0xD2511F53) * c[:, 0], np.uint64(0xCD9E8D57) * c[:, 2]
        c = np.stack(
            [(p1 >> np.uint64(32)) ^ c[:, 1] ^ k0, p1 & mask, (p0 >> np.uint64(32)) ^ c[:, 3] ^ k1, p0 & mask], 1
        )
        k0, k1 = (k0 + np.uint64(0x9E3779B9)) & mask, (k1 + np.uint64(0xBB67AE85)) & mask
    return c.astype(np.uint32)


def philox_words(seed: int, stream: int, frame: int, iteration: int, count: int) -> np.ndarray:
    """The first word of counter elements 0 to count - 1."""
    columns = [np.arange(count)] + [np.full(count, x) for x in (iteration, frame, stream)]
    return philox4x32(np.stack(columns, 1).astype(np.uint32), (seed & 0xFFFFFFFF, seed >> 32))[:, 0]


def sample_along_rays(depth, num_uniform, num_surface, near, far, truncation, *key):
    """Stratified samples from near to far times the depth and within the truncation, sorted."""
    rays, samples = len(depth), num_uniform + num_surface
    words = philox_words(*key, rays * samples)
    u = torch.from_numpy((words >> 8).astype(np.float64) / 2**24).to(depth).view(rays, samples)
    i = torch.arange(num_uniform).to(depth)
    j = torch.arange(num_surface).to(depth)
    d = depth[:, None]
    uniform = d * (near + (far - near) * (i + u[:, :num_uniform]) / max(num_uniform, 1))
    surface = d + truncation * (2 * (j + u[:, num_uniform:]) / max(num_surface, 1) - 1)
    return torch.where(d > 0, torch.cat([uniform, surface], 1).sort(1).values, 0)
