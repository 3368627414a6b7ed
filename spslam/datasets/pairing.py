"""Pairing images by time, and poses at the times of images."""

from __future__ import annotations

import numpy as np

from spslam.errors import DatasetError
from spslam.geometry import interpolate_pose
from spslam.trajectory import Trajectory

# A depth camera at 200 Hz has 8 images within 0.02 s.
_MAX_CANDIDATES = 16


def associate(times_a: np.ndarray, times_b: np.ndarray, max_difference: float) -> np.ndarray:
    """Pairs the nearest times of two lists; each time is in one pair at most.

    The closest pairs are taken first, as by TUM RGB-D's `associate.py`.

    Args:
        times_a: [A], ascending.
        times_b: [B], ascending.
        max_difference: pairs are less than this apart.

    Returns:
        Pairs (i, j), int64 [P, 2], ascending.

    Raises:
        ValueError: times are so close to each other that there are over 16 candidates for a pair on average.
    """
    first = np.searchsorted(times_b, times_a - max_difference)
    last = np.searchsorted(times_b, times_a + max_difference)
    count = int((last - first).sum())
    if count > _MAX_CANDIDATES * len(times_a):
        raise ValueError(f"must have at most {_MAX_CANDIDATES} images within {max_difference} s of each, got {count}")
    i = np.repeat(np.arange(len(times_a)), last - first)
    j = np.arange(count) - np.repeat(np.cumsum(last - first) - last, last - first)
    difference = np.abs(times_a[i] - times_b[j])
    near = np.lexsort((j, i, difference))
    near = near[difference[near] < max_difference]
    used_a: set[int] = set()
    used_b: set[int] = set()
    pairs = []
    for pair in zip(i[near].tolist(), j[near].tolist(), strict=True):
        if pair[0] not in used_a and pair[1] not in used_b:
            used_a.add(pair[0])
            used_b.add(pair[1])
            pairs.append(pair)
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def pair_by_time(color_times: np.ndarray, depth_times: np.ndarray, tolerance_s: float, name: str) -> np.ndarray:
    """Pairs color and depth images nearest in time.

    Args:
        color_times: [C], s, ascending.
        depth_times: [D], s, ascending.
        tolerance_s: pairs are less than this apart.
        name: what the error begins with.

    Returns:
        Pairs (color, depth), int64 [F, 2], ascending.

    Raises:
        DatasetError: no pair, with how far the nearest ones are apart; or far too many images within the tolerance.
    """
    try:
        pairs = associate(color_times, depth_times, tolerance_s)
    except ValueError as error:
        raise DatasetError(f"{name}: {error}; dataset.pair_tolerance_s sets how far a pair may be apart") from None
    if not len(pairs):
        apart = _smallest_difference(color_times, depth_times)
        raise DatasetError(
            f"{name}: must have color and depth images within {tolerance_s:g} s of each other, got none: "
            f"{len(color_times)} and {len(depth_times)} images, the nearest two {apart:.3g} s apart; "
            "dataset.pair_tolerance_s sets how far a pair may be apart"
        )
    return pairs


def interpolate_trajectory(trajectory: Trajectory, times: np.ndarray, max_gap: float) -> np.ndarray:
    """Interpolates a trajectory.

    Args:
        trajectory: its timestamps must be strictly ascending.
        times: [F], s.
        max_gap: between two poses further apart than this (s) nothing is interpolated.

    Returns:
        float64 [F, 4, 4], NaN outside the trajectory and in its gaps.
    """
    poses = np.full((len(times), 4, 4), np.nan)
    if len(trajectory) == 0:
        return poses
    after = np.clip(np.searchsorted(trajectory.timestamps, times), 1, max(len(trajectory) - 1, 1))
    after = np.minimum(after, len(trajectory) - 1)
    before = np.maximum(after - 1, 0)
    start, end = trajectory.timestamps[before], trajectory.timestamps[after]
    fraction = np.where(end > start, (times - start) / np.where(end > start, end - start, 1), 0)
    exact = (times == start) | (times == end)
    known = (times >= start) & (times <= end) & ((end - start <= max_gap) | exact)
    poses[known] = interpolate_pose(trajectory.poses[before[known]], trajectory.poses[after[known]], fraction[known])
    return poses


def sorted_trajectory(times: np.ndarray, poses: np.ndarray) -> Trajectory:
    """Poses in order of time, of those with the same time the first.

    Args:
        times: [N], s, in any order.
        poses: [N, 4, 4].
    """
    unique, first = np.unique(times, return_index=True)
    return Trajectory(unique, poses[first])


def _smallest_difference(times_a: np.ndarray, times_b: np.ndarray) -> float:
    if not len(times_a) or not len(times_b):
        return float("nan")
    after = np.searchsorted(times_b, times_a).clip(max=len(times_b) - 1)
    before = (after - 1).clip(min=0)
    return float(np.minimum(np.abs(times_b[after] - times_a), np.abs(times_b[before] - times_a)).min())
