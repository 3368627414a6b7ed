"""Colors of surface that no frame saw well, brought to agree with the texture around it."""

from __future__ import annotations

import numpy as np

from spslam.meshing.mesh import TriangleMesh
from spslam.meshing.texture.atlas import Texels

# Rings of vertices over which the difference at the border fades, about.
_RINGS = 64


def fitted_to_seen(mesh: TriangleMesh, corners: Texels, sums: np.ndarray) -> np.ndarray:
    """Own colors of vertices, moved where the texture ends by its difference from them.

    The difference spreads from seen vertices to others as the mean of its neighbors, some rings far, so there is no
    step where the texture's exposure is another than the mesh's.

    Args:
        mesh: with the own colors.
        corners: of `corner_texels`.
        sums: float32 [V, 4], of `accumulate` for these.

    Returns:
        float32 [V, 3], 0 to 255.
    """
    from scipy.sparse import coo_matrix

    own = mesh.colors.astype(np.float32)
    texture = np.zeros((len(own), 4), np.float32)
    rows = mesh.faces[corners.faces, (corners.weights @ np.array([1, 2])).astype(np.int64)]
    texture[rows] = sums
    seen = texture[:, 3] > 0
    if seen.all() or not seen.any():
        return own
    difference = np.zeros_like(own)
    difference[seen] = texture[seen, :3] / texture[seen, 3:] - own[seen]
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    edges = np.concatenate([edges, edges[:, ::-1]])
    edges = edges[~seen[edges[:, 0]]]
    shares = coo_matrix((np.ones(len(edges), np.float32), (edges[:, 0], edges[:, 1])), (len(own), len(own))).tocsr()
    unseen = np.flatnonzero(~seen)
    shares = shares[unseen]
    counts = np.maximum(np.asarray(shares.sum(1)).reshape(-1, 1), 1)
    for _ in range(_RINGS):
        difference[unseen] = (shares @ difference) / counts
    return np.clip(own + difference, 0, 255)
