"""How evenly a recording's color images were taken, by their content, beside what their time stamps say.

Points are followed by optical flow from each color image to the next. The ground truth's path says when the camera was
where it sees them so: that is the time of the second image, from the first one's stamp on.

python -m experiments.frame_intervals --data DATA/tum-fr1-rpy-60
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from spslam.datasets.files import FileDataset
from spslam.datasets.pairing import interpolate_trajectory, sorted_trajectory
from spslam.datasets.tum import MAX_GROUND_TRUTH_GAP_S, open_tum
from spslam.geometry import inverse
from spslam.trajectory import Trajectory

WINDOW = {"winSize": (31, 31), "maxLevel": 4}
MOST_BACK_PX = 0.5  # between a point and where it is followed back to
LEAST_POINTS = 40
MOST_OFF_S, STEP_S = 0.025, 0.001


def followed(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points float32 [P, 2] of an image (px), and where they are in another one."""
    gray = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (first, second)]
    points = cv2.goodFeaturesToTrack(gray[0], 600, 0.005, 8)
    there, found, _ = cv2.calcOpticalFlowPyrLK(*gray, points, None, **WINDOW)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(*reversed(gray), there, None, **WINDOW)
    near = np.linalg.norm(back - points, axis=2)[:, 0] < MOST_BACK_PX
    known = (found[:, 0] > 0) & (found_back[:, 0] > 0) & near
    return points[known, 0], there[known, 0]


def interval(dataset: FileDataset, truth: Trajectory, index: int) -> float:
    """From color image `index` to the next one, s; NaN where too little is seen."""
    frame, times = dataset[index], dataset.timestamps()
    points, there = followed(frame.color, dataset[index + 1].color)
    depth = frame.depth[points[:, 1].round().astype(int), points[:, 0].round().astype(int)]
    points, there, depth = points[depth > 0], there[depth > 0], depth[depth > 0]
    if len(points) < LEAST_POINTS or frame.pose is None:
        return float("nan")
    k = dataset.camera
    rays = np.c_[(points - (k.cx, k.cy)) / (k.fx, k.fy), np.ones(len(points))]
    world = rays * depth[:, None] @ frame.pose[:3, :3].T + frame.pose[:3, 3]
    period = float(np.diff(times).mean())
    steps = period + np.arange(-MOST_OFF_S, MOST_OFF_S + STEP_S / 2, STEP_S)
    errors = []
    for pose in interpolate_trajectory(truth, times[index] + steps, MAX_GROUND_TRUTH_GAP_S):
        to_camera = inverse(pose)
        seen = world @ to_camera[:3, :3].T + to_camera[:3, 3]
        off = seen[:, :2] / seen[:, 2:] * (k.fx, k.fy) + (k.cx, k.cy) - there
        errors.append(float(np.median(np.linalg.norm(off, axis=1))))
    return float(steps[int(np.argmin(errors))])


def main() -> None:
    """Prints each interval, and how far they are from the stamps' and from even ones."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="a sequence in TUM's layout")
    folder = parser.parse_args().data
    dataset, truth = open_tum(folder), Trajectory.load_tum(folder / "groundtruth.txt", skip_unknown=True)
    path = sorted_trajectory(truth.timestamps, truth.poses)
    found = 1000 * np.array([interval(dataset, path, i) for i in range(len(dataset) - 1)])
    stamped = 1000 * np.diff(dataset.timestamps())
    for i, (one, other) in enumerate(zip(found, stamped, strict=True)):
        print(f"{i} to {i + 1}: {one:.0f} ms by content, {other:.1f} ms by stamps")
    for name, expected in (("even ones", np.full_like(found, stamped.mean())), ("stamps", stamped)):
        print(f"median distance from {name}: {np.nanmedian(np.abs(found - expected)):.1f} ms")


if __name__ == "__main__":
    main()
