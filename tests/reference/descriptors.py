"""The two nearest of many binary descriptors, in plain NumPy: all distances, bit by bit."""

import numpy as np


def nearest_descriptors(descriptors, others):
    """Rows int64 [N] of the nearest, -1 without any, and distances int32 [N, 2]; uint8 [N, B] and [M, B]."""
    far = 8 * descriptors.shape[1] + 1
    bits = np.unpackbits(descriptors, axis=1)[:, None] != np.unpackbits(others, axis=1)[None]
    distances = bits.sum(2)
    padded = np.concatenate([distances, np.full((len(descriptors), 2), far)], 1)
    nearest = padded.argmin(1)
    nearest[nearest >= len(others)] = -1
    return nearest, np.sort(padded, 1)[:, :2].astype(np.int32)
