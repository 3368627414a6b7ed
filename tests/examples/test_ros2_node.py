"""The ROS 2 node on generated frames.

rclpy is installed by ROS, not by this project, so in general a small fake takes its place, as one always does for
tf2_ros. `SPSLAM_TEST_ROS` names a virtual environment with the real rclpy, with which the test is made too:
`python -m venv DIR` and
`DIR/bin/pip install ros-rclpy ros-sensor-msgs ros-nav-msgs ros-geometry-msgs ros-rmw-fastrtps-cpp`.
"""

import json
import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy as np
import pytest

from spslam.datasets.generated import GeneratedDataset

HERE = Path(__file__).parent
ROOT = HERE.parents[1]


def environment(kind):
    """Variables of a process with the fakes, or with the ROS that `SPSLAM_TEST_ROS` names."""
    paths = [ROOT, HERE / "tf2_fake"]
    if kind == "fakes":
        return {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, [*paths, HERE / "ros_fakes"]))}
    ros = os.environ.get("SPSLAM_TEST_ROS")
    if not ros:
        pytest.skip("SPSLAM_TEST_ROS names no environment with rclpy")
    packages = next(Path(ros).glob("lib/python3*/site-packages"))
    libraries = [Path(ros) / "lib", *packages.glob("ros_*.libs")]
    own = sysconfig.get_paths()["purelib"]  # first: ROS brings a NumPy of its own
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(map(str, [*paths, own, packages])),
        "LD_LIBRARY_PATH": os.pathsep.join(map(str, libraries)),
        "ROS_LOG_DIR": str(ROOT / "build" / "ros-log"),
        "ROS_DOMAIN_ID": str(os.getpid() % 100 + 1),
    }


@pytest.mark.parametrize("kind", ["fakes", "ros"])
def test_frames_become_poses_path_points_and_transforms(tmp_path, kind):
    variables, mesh = environment(kind), tmp_path / "room.ply"
    command = [sys.executable, str(HERE / "drive_ros2_node.py"), str(mesh)]
    ended = subprocess.run(command, env=variables, capture_output=True, text=True, timeout=200)
    assert ended.returncode == 0, ended.stderr + ended.stdout
    came = json.loads(ended.stdout.splitlines()[-1])
    assert ("ros_fakes" in came["rclpy"]) == (kind == "fakes")
    room = GeneratedDataset(300, 160, 120)
    true = np.linalg.inv(room.poses()[0]) @ room.poses()[:12]
    np.testing.assert_allclose(came["poses"], true[:, :3, 3], atol=0.01)
    # The stamp is the depth image's to the nanosecond: TF is asked for exactly that.
    assert came["stamp"] == [1_700_000_000, 33_333_333 * 12 + 7]
    assert came["frames"] == ["map", "camera_color_optical_frame", "camera_color_optical_frame"]
    np.testing.assert_allclose(came["tf"][0], came["poses"][-1][0])
    assert came["path"] == 11  # sent with every tenth frame
    assert came["points"] == 40 * 30
    assert came["median_z"] == pytest.approx(3.1, abs=0.2)
    assert came["failure"] == "None"
    assert mesh.stat().st_size > 10_000
    assert "the encoding must be one of rgb8, bgr8, rgba8, bgra8, got mono8" in ended.stdout + ended.stderr
    if kind == "fakes":  # ROS may deliver from the second message on
        assert "camera_info can't be used: Camera: fx must be positive, got 0" in ended.stdout + ended.stderr


NODE = """
import sys, rclpy
from types import SimpleNamespace as Some
import numpy as np
from tests.examples.drive_ros2_node import load_example, stamp
from sensor_msgs.msg import Image
rclpy.init()
example = load_example()
node = example.SlamNode()
header = stamp(Image(), 0).header
frame = Some(header=header)
node.system = Some(mapping_left=0, optimize_map=lambda count: None)

def fail(*_, **__):
    raise RuntimeError("publisher's context is invalid")

"""
EDGES = {
    "a path of any length": """
for _ in range(9 * example.PATH_POSES):
    node.publish(frame, np.eye(4))
assert example.PATH_POSES / 2 <= len(node.path.poses) <= example.PATH_POSES
""",
    "stamps that go back while there is no depth": """
pairs = []
node.hand_over = lambda color, depth: pairs.append((color, depth))
for number in range(20, 35):
    node.on_color(stamp(Image(), number))
for number in range(3):
    node.on_color(stamp(Image(), number))
    node.on_depth(stamp(Image(), number))
assert len(pairs) == 3, pairs
assert len(node.colors) <= 10 and not node.depths
""",
    "Ctrl-C while a frame is tracked": """
def process(image, on_pose, defer_mapping):
    rclpy.ok = lambda: False
    on_pose(np.eye(4))

node.system.process, node.pose_publisher.publish = process, fail
node.queue.put(example.StampedFrame(None, 0.0, header))
node.worker.join(10)
assert not node.worker.is_alive() and node.failure is None
""",
    "tracking that fails": """
node.system.process = fail
node.queue.put(example.StampedFrame(None, 0.0, header))
node.worker.join(10)
assert str(node.failure) == "publisher's context is invalid"
""",
}


@pytest.mark.parametrize("edge", EDGES)
def test_what_happens_in_long_runs_and_at_their_end(edge):
    command = [sys.executable, "-c", NODE + EDGES[edge], "no mesh"]
    ended = subprocess.run(command, env=environment("fakes"), capture_output=True, text=True, timeout=100)
    assert ended.returncode == 0, ended.stderr
    assert "Traceback" not in ended.stderr
