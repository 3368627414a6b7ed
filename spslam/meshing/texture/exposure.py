"""How bright each frame is beside the others: automatic exposure and white balance, undone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from spslam.meshing.texture.views import ColorView, SeenVertices

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

# Vertices that are compared, spread over the mesh; more tell nothing new.
_COMPARED = 20_000
# Levels outside are clipped, or nearly.
_DARKEST, _BRIGHTEST = 8.0, 245.0
# Colors are means over so many pixels per axis, as texture is not registered to a pixel.
_BOX_PX = 5
# A difference of log colors counts half where it is so large: highlights, and another surface.
_SCALE = 0.1
_ROUNDS = 4
# What "as the others" counts, as a share of what a frame's colors say on average. It keeps gains from drifting along a
# sequence by what else changes with the view: vignetting, highlights.
_PRIOR = 0.05
# The system is solved until its residual is that share of the right side's, as exactly as by elimination: what is left
# is far below float32, by which colors are multiplied. Some 60 steps do it.
_TOLERANCE, _MOST_STEPS = 1e-14, 1000


class Exposures:
    """Colors of the same vertices in many frames, and the gains by which they agree.

    log color(frame, vertex) = log gain(frame) + log albedo(vertex) for each channel, solved by iteratively reweighted
    least squares with Cauchy's weights; the albedos are eliminated.

    Args:
        vertices: V of the mesh.
        frames: F.
    """

    def __init__(self, vertices: int, frames: int) -> None:
        self._step = max(vertices // _COMPARED, 1)
        self._vertices, self._frames = -(-vertices // self._step), frames
        self._seen: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def add(self, view: ColorView, seen: SeenVertices) -> None:
        """Takes a frame's colors of the compared vertices in."""
        rows = np.flatnonzero(seen.ids % self._step == 0)
        x, y = (np.rint(each[rows]).astype(np.int32) for each in (seen.u, seen.v))
        colors = cv2.blur(view.frame.color, (_BOX_PX, _BOX_PX))[y, x].astype(np.float32)
        kept = (colors.min(1) > _DARKEST) & (colors.max(1) < _BRIGHTEST)
        vertices = (seen.ids[rows] // self._step)[kept].astype(np.int32)
        self._seen.append((np.full(len(vertices), view.number, np.int32), vertices, np.log(colors[kept])))

    def gains(self) -> np.ndarray:
        """What colors of each frame are to be multiplied by, float64 [F, 3]; their geometric mean is 1.

        1 for frames that share no vertex with others. Deterministic.
        """
        gains = np.ones((self._frames, 3))
        if not self._seen:
            return gains
        frames, vertices, logs = (np.concatenate(each) for each in zip(*self._seen, strict=True))
        if not len(frames):
            return gains
        for channel in range(3):
            gains[:, channel] = np.exp(-self._solve(frames, vertices, logs[:, channel].astype(np.float64)))
        return gains

    def _solve(self, frames: np.ndarray, vertices: np.ndarray, logs: np.ndarray) -> np.ndarray:
        """Log gains [F] of the frames as they are."""
        from scipy.sparse import coo_matrix

        shape = self._frames, self._vertices
        weights = np.ones(len(logs))
        offsets = np.zeros(self._frames)
        present = np.bincount(frames, minlength=self._frames) > 0
        for _ in range(_ROUNDS):
            counts = coo_matrix((weights, (frames, vertices)), shape).tocsr()
            per_vertex = np.maximum(np.bincount(vertices, weights, self._vertices), 1e-12)
            per_frame = np.bincount(frames, weights, self._frames)
            diagonal = per_frame + _PRIOR * float(per_frame[present].mean())
            albedo = np.bincount(vertices, weights * logs, self._vertices) / per_vertex
            right = np.bincount(frames, weights * (logs - albedo[vertices]), self._frames)
            offsets = _offsets(counts, per_vertex, diagonal, right)
            albedo = np.bincount(vertices, weights * (logs - offsets[frames]), self._vertices) / per_vertex
            weights = 1 / (1 + ((logs - offsets[frames] - albedo[vertices]) / _SCALE) ** 2)
        return np.where(present, offsets - offsets[present].mean(), 0.0)


def _offsets(counts: csr_matrix, per_vertex: np.ndarray, diagonal: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solves (diag(diagonal) - counts diag(1 / per_vertex) counts^T) x = right by preconditioned conjugate gradients.

    Frames that see a common vertex are all coupled, so the matrix itself would have F^2 numbers. Scaled by its diagonal
    its eigenvalues are at most 1 and, by the prior, some hundredths or more. Products are summed by one thread.

    Args:
        counts: [F, V], weights of the vertices in the frames.
        per_vertex: [V], sums of these.
        diagonal: [F], sums of these and the prior.
        right: [F].

    Returns:
        x [F].
    """
    transposed = counts.T
    solution, residual = np.zeros_like(right), right.copy()
    direction = scaled = residual / diagonal
    size = first_size = float(np.sum(residual * scaled))
    for _ in range(_MOST_STEPS):
        if size <= _TOLERANCE**2 * first_size:
            break
        product = diagonal * direction - counts @ ((transposed @ direction) / per_vertex)
        step = size / float(np.sum(direction * product))
        solution += step * direction
        residual -= step * product
        scaled = residual / diagonal
        before, size = size, float(np.sum(residual * scaled))
        direction = scaled + size / before * direction
    return solution
