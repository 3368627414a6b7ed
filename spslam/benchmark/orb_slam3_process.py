"""The process that ORB-SLAM3 runs in: takes frames over a connection and answers with poses.

Started as a module, with the connection's file descriptor, the folder and the vocabulary as arguments.
"""

from __future__ import annotations

import os
import signal
import sys
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

# Kinds of answers: (DONE, result) or (FAILED, reason).
DONE, FAILED = "done", "failed"
# Files in the folder that both processes use.
SETTINGS, TRAJECTORY = "settings.yaml", "orb_slam3.txt"


def serve(connection: Connection, folder: Path, vocabulary: Path) -> None:
    """Runs ORB-SLAM3 until the other end closes the connection; ends this process.

    The first answer comes when ORB-SLAM3 is ready. Then a request (color, depth, time stamp in s) is answered by the
    pose, float64 [4, 4] or None where ORB-SLAM3 is not tracking. None ends tracking and writes the final trajectory.

    Args:
        connection: to the process that has the frames.
        folder: with `SETTINGS`; the final trajectory goes to `TRAJECTORY`, unless no frame was tracked.
        vocabulary: ORB-SLAM3's vocabulary.
    """
    try:
        _answer(connection, folder, vocabulary)
    except (EOFError, ConnectionError):
        pass
    except Exception as error:
        connection.send((FAILED, str(error)))
    finally:
        # Not by the interpreter's exit: the library's destructors can hang or crash while its threads run.
        os.kill(os.getpid(), signal.SIGKILL)


def _answer(connection: Connection, folder: Path, vocabulary: Path) -> None:
    import pyorbslam3

    slam = pyorbslam3.Slam(vocabulary, folder / SETTINGS, pyorbslam3.Sensor.RGBD, use_viewer=False)
    connection.send((DONE, None))
    has_tracked = False
    while (frame := connection.recv()) is not None:
        pose = _track(slam, *frame)
        has_tracked |= pose is not None
        connection.send((DONE, pose))
    slam.shutdown()
    if has_tracked:  # without a keyframe the library reads beyond the end of a list
        slam.save_trajectory_tum(str(folder / TRAJECTORY))
    connection.send((DONE, None))
    connection.recv()


def _track(slam: Any, color: np.ndarray, depth: np.ndarray, timestamp: float) -> np.ndarray | None:
    found = slam.track_rgbd(np.ascontiguousarray(color), np.ascontiguousarray(depth), timestamp)
    # After a failure the pose stays "valid" for a while, but is that of an earlier frame.
    return np.array(found.pose_wc, np.float64) if found.ok else None


if __name__ == "__main__":
    serve(Connection(int(sys.argv[1])), Path(sys.argv[2]), Path(sys.argv[3]))
