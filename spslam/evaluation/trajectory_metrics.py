"""Absolute and relative trajectory error (Sturm et al. 2012), as ``evo`` computes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spslam.geometry import inverse, rotation_angle, umeyama


@dataclass(frozen=True)
class Alignment:
    """The motion that carries an estimated trajectory onto the true one: ``x -> scale R x + t``.

    Attributes
    ----------
    rotation : float64 [3,3].
    translation : float64 [3], meters.
    scale : 1 for a rigid alignment.
    """

    rotation: np.ndarray
    translation: np.ndarray
    scale: float

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Points [...,3] of the estimate's world in the truth's world, float64."""
        return self.scale * (np.asarray(points, dtype=np.float64) @ self.rotation.T) + self.translation


def align(estimated: np.ndarray, reference: np.ndarray, with_scale: bool = False) -> Alignment:
    """The alignment that minimizes the squared distances between camera positions (Umeyama 1991).

    Parameters
    ----------
    estimated : [F,4,4] ``T_world_camera``, finite.
    reference : [F,4,4] true poses of the same frames, NaN where unknown; those frames are left out.
    with_scale : align by a similarity instead of a rigid motion.

    Returns the identity when no true pose is known.
    """
    estimated, reference, known = _checked("align", estimated, reference)
    if not known.any():
        return Alignment(np.eye(3), np.zeros(3), 1.0)
    return Alignment(*umeyama(estimated[known, :3, 3], reference[known, :3, 3], with_scale))


def absolute_errors(estimated: np.ndarray, reference: np.ndarray, alignment: Alignment) -> np.ndarray:
    """Distance [F] in meters of each aligned camera position from the true one, NaN where that is unknown."""
    estimated, reference, known = _checked("absolute_errors", estimated, reference)
    errors = np.linalg.norm(alignment.apply(estimated[:, :3, 3]) - reference[:, :3, 3], axis=1)
    return np.where(known, errors, np.nan)


def ate(estimated: np.ndarray, reference: np.ndarray, with_scale: bool = False) -> dict[str, float]:
    """Absolute trajectory error over all frames with a true pose, after alignment without scale.

    Parameters as for :func:`align`.

    Returns
    -------
    ``ate_rmse_cm``, ``ate_median_cm``, ``ate_max_cm``. With ``with_scale`` they are called ``ate_scaled_rmse_cm`` and
    so on, beside ``ate_scale``, so that the two can't be mistaken for each other. Empty when no true pose is known.
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
    """Relative pose error: the drift over every ``delta`` frames, as root mean square.

    The error of a step from frame i to i + delta is ``(Q_i^-1 Q_j)^-1 (P_i^-1 P_j)``, P estimated and Q true; steps
    with an unknown end are left out. No alignment is needed.

    Returns
    -------
    ``rpe_cm`` (length of its translation) and ``rpe_deg`` (angle of its rotation). Empty when there is no step.
    """
    estimated, reference, known = _checked("rpe", estimated, reference)
    if delta < 1:
        raise ValueError(f"rpe: delta must be at least 1, got {delta}")
    start = np.flatnonzero(known[:-delta] & known[delta:])
    if not start.size:
        return {}
    true_steps = inverse(reference[start]) @ reference[start + delta]
    steps = inverse(estimated[start]) @ estimated[start + delta]
    errors = inverse(true_steps) @ steps
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
