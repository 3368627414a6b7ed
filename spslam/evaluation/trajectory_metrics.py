"""Absolute trajectory error (ATE) and relative pose error (RPE), Sturm et al. 2012; same results as `evo`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spslam.geometry import inverse, rotation_angle, umeyama


@dataclass(frozen=True)
class Alignment:
    """The transform that aligns an estimated trajectory with the ground truth: `x -> scale R x + t`.

    Attributes:
        rotation: float64 [3, 3].
        translation: float64 [3], meters.
        scale: 1 for a rigid alignment.
    """

    rotation: np.ndarray
    translation: np.ndarray
    scale: float

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Transforms points [..., 3] from the world frame of the estimate to that of the ground truth, float64."""
        return self.scale * (np.asarray(points, dtype=np.float64) @ self.rotation.T) + self.translation


def align(estimated: np.ndarray, reference: np.ndarray, with_scale: bool = False) -> Alignment:
    """The alignment that minimizes the squared distances between camera positions (Umeyama 1991).

    Args:
        estimated: [F, 4, 4] `T_world_camera`, finite.
        reference: [F, 4, 4] ground-truth poses of the same frames, NaN where unknown; those frames are ignored.
        with_scale: align by a similarity instead of a rigid transform.

    Returns:
        The alignment; the identity without a ground-truth pose.

    Raises:
        ValueError: poses of another shape, or an estimated pose that is not finite.
    """
    estimated, reference, known = _checked("align", estimated, reference)
    if not known.any():
        return Alignment(np.eye(3), np.zeros(3), 1.0)
    return Alignment(*umeyama(estimated[known, :3, 3], reference[known, :3, 3], with_scale))


def absolute_errors(estimated: np.ndarray, reference: np.ndarray, alignment: Alignment) -> np.ndarray:
    """Distance [F] in meters of each aligned camera position from the ground truth, NaN where it is unknown."""
    estimated, reference, known = _checked("absolute_errors", estimated, reference)
    errors = np.linalg.norm(alignment.apply(estimated[:, :3, 3]) - reference[:, :3, 3], axis=1)
    return np.where(known, errors, np.nan)


def ate(estimated: np.ndarray, reference: np.ndarray, with_scale: bool = False) -> dict[str, float]:
    """Absolute trajectory error over all frames with a ground-truth pose, after alignment.

    Args:
        estimated: see `align`.
        reference: see `align`.
        with_scale: align with scale.

    Returns:
        `ate_rmse_cm`, `ate_median_cm`, `ate_max_cm`. With `with_scale` their names are `ate_scaled_rmse_cm` and so on,
        and there is `ate_scale`, so that the two cannot be confused. Empty without a ground-truth pose.
    """
    alignment = align(estimated, reference, with_scale)
    errors = absolute_errors(estimated, reference, alignment)
    errors = errors[np.isfinite(errors)]
    if not errors.size:
        return {}
    name = "ate_scaled" if with_scale else "ate"
    metrics = {
        f"{name}_rmse_cm": 100 * float(np.sqrt(np.mean(errors**2))),
        f"{name}_median_cm": 100 * float(np.median(errors)),
        f"{name}_max_cm": 100 * float(errors.max()),
    }
    return {**metrics, "ate_scale": alignment.scale} if with_scale else metrics


def rpe(estimated: np.ndarray, reference: np.ndarray, delta: int = 1) -> dict[str, float]:
    """Relative pose error: the root mean square of the drift over `delta` frames.

    The error from frame i to j = i + delta is `(Q_i^-1 Q_j)^-1 (P_i^-1 P_j)`, with P estimated and Q ground truth.
    Pairs with an unknown pose are ignored. Needs no alignment.

    Args:
        estimated: see `align`.
        reference: see `align`.
        delta: distance of the frames, at least 1.

    Returns:
        `rpe_cm`, of the length of the translation, and `rpe_deg`, of the angle of the rotation. Empty without a pair.
    """
    estimated, reference, known = _checked("rpe", estimated, reference)
    if delta < 1:
        raise ValueError(f"rpe: delta must be at least 1, got {delta}")
    start = np.flatnonzero(known[:-delta] & known[delta:])
    if not start.size:
        return {}
    reference_steps = inverse(reference[start]) @ reference[start + delta]
    steps = inverse(estimated[start]) @ estimated[start + delta]
    errors = inverse(reference_steps) @ steps
    lengths, angles = np.linalg.norm(errors[:, :3, 3], axis=1), np.degrees(rotation_angle(errors[:, :3, :3]))
    return {
        "rpe_cm": 100 * float(np.sqrt(np.mean(lengths**2))),
        "rpe_deg": float(np.sqrt(np.mean(angles**2))),
    }


def _checked(function: str, estimated: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    estimated, reference = np.asarray(estimated, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    if estimated.ndim != 3 or estimated.shape[1:] != (4, 4) or estimated.shape != reference.shape:
        raise ValueError(
            f"{function}: estimated and reference must both have shape (F, 4, 4), "
            f"got {estimated.shape} and {reference.shape}"
        )
    broken = np.flatnonzero(~np.isfinite(estimated).all(axis=(1, 2)))
    if broken.size:
        raise ValueError(f"{function}: estimated must be finite, got a non-finite pose at frame {broken[0]}")
    return estimated, reference, np.isfinite(reference).all(axis=(1, 2))
