"""Recordings that examples are given."""

import cv2
import numpy as np

from spslam.datasets import export_folder
from spslam.datasets.generated import GeneratedDataset


def write_with_gaps(folder, frames):
    """The generated room as a folder, whose second frame has no pose and whose third has no depth."""
    export_folder(GeneratedDataset(frames, 160, 120), folder)
    poses = np.loadtxt(folder / "poses.txt").reshape(frames, -1)
    poses[1] = np.nan
    np.savetxt(folder / "poses.txt", poses)
    path = sorted((folder / "depth").iterdir())[2]
    cv2.imwrite(str(path), 0 * cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
