"""A stand-in for pyorbslam3: the camera is at x = its time when tracked, 1 cm beside that in the end.

A frame without depth is not tracked. The vocabulary's text makes the library fail.
"""

import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np


class Sensor:
    RGBD = "rgbd"


class Slam:
    def __init__(self, vocab_file, settings_file, sensor, use_viewer=False):
        text = Path(vocab_file).read_text()
        if text == "refused":
            raise RuntimeError("Vocabulary is not one of ORB features")
        if text == "fatal":
            print("Wrong path to vocabulary.", flush=True)
            os._exit(3)
        assert Path(settings_file).read_text().startswith("%YAML") and sensor == Sensor.RGBD and not use_viewer
        self.dies_at = 2 if text == "dies" else None
        self.times = []

    def track_rgbd(self, image, depth, timestamp):
        assert image.dtype == np.uint8 and depth.dtype == np.float32 and image.shape[:2] == depth.shape
        if len(self.times) == self.dies_at:
            os._exit(4)
        self.times.append(timestamp)
        pose = np.eye(4, dtype=np.float32)
        pose[0, 3] = timestamp
        return SimpleNamespace(ok=bool(depth.any()), pose_valid=True, pose_wc=pose)

    def shutdown(self):
        pass

    def save_trajectory_tum(self, filename):
        """The last frame's map was discarded; frames that were not tracked have a pose."""
        rows = (f"{time:.6f} {time:.9f} 0.010000000 0 0 0 0 1" for time in self.times[:-1])
        Path(filename).write_text("\n".join(rows) + "\n")
