"""Runs the ROS 2 node on generated frames, in a process with rclpy or with the fakes; prints what came out as JSON."""

import importlib.util
import json
import sys
import time
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, TransformStamped
from nav_msgs.msg import Path as PathMessage
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from spslam.datasets.generated import GeneratedDataset

ROOT, MESH, FRAMES = Path(__file__).parents[2], sys.argv[1], 12
TIMEOUT_S = 60
COLOR_LATER_NS = 5_000_000  # color is taken after depth, whose stamp poses have


def load_example():
    spec = importlib.util.spec_from_file_location("ros2_node", ROOT / "examples" / "ros2_node.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["ros2_node"] = module
    spec.loader.exec_module(module)
    return module


def stamp(message, number, later_ns=0):
    message.header.stamp.sec, message.header.stamp.nanosec = 1_700_000_000, 33_333_333 * number + 7 + later_ns
    message.header.frame_id = "camera_color_optical_frame"
    return message


def image(array, encoding, number, later_ns=0):
    step = array.strides[0]
    height, width = array.shape[:2]
    return stamp(
        Image(height=height, width=width, encoding=encoding, step=step, data=array.tobytes()), number, later_ns
    )


def main():
    rclpy.init()
    example = load_example()
    node, driver = example.SlamNode(), Node("driver")
    node.options["mesh"] = MESH
    room, came = GeneratedDataset(300, 160, 120), {"pose": [], "path": [], "points": [], "tf": []}
    kinds = {"pose": PoseStamped, "path": PathMessage, "points": PointCloud2, "tf": TransformStamped}
    for topic, kind in kinds.items():
        driver.create_subscription(kind, topic, came[topic].append, 10)
    publishers = {
        topic: driver.create_publisher(kind, topic, qos_profile_sensor_data)
        for topic, kind in (("camera_info", CameraInfo), ("color", Image), ("depth", Image))
    }
    info = CameraInfo(width=160, height=120, d=[0.0] * 5)
    info.k = room.camera.matrix().reshape(-1).tolist()
    uncalibrated = CameraInfo(width=160, height=120, d=[])
    uncalibrated.k = [0.0] * 9

    def spin_until(done):
        began = time.monotonic()
        while not done() and time.monotonic() - began < TIMEOUT_S:
            rclpy.spin_once(node, timeout_sec=0.02)
            rclpy.spin_once(driver, timeout_sec=0.02)
        assert done(), {topic: len(messages) for topic, messages in came.items()}

    def send_info():
        publishers["camera_info"].publish(uncalibrated)  # of no use, and said
        publishers["camera_info"].publish(info)
        return node.system is not None

    spin_until(send_info)
    for number in range(FRAMES + 1):
        frame = room[max(number - 1, 0)]
        color = image(np.ascontiguousarray(frame.color[..., ::-1]), "bgr8", number, COLOR_LATER_NS)
        if number == 0:  # of no use, and said
            color = image(frame.color[..., 0].copy(), "mono8", number, COLOR_LATER_NS)
        publishers["depth"].publish(image(np.rint(1000 * frame.depth).astype("<u2"), "16UC1", number))
        publishers["color"].publish(color)
        # One after the other, so that the test does not depend on the machine.
        spin_until(lambda expected=number: len(came["pose"]) >= expected)
    spin_until(lambda: came["points"] and came["path"] and len(came["tf"]) >= FRAMES)
    node.close()
    last, moved, cloud = came["pose"][-1], came["tf"][-1], came["points"][-1]
    points = np.frombuffer(bytes(cloud.data), dtype=np.float32).reshape(-1, 4)
    print(
        json.dumps(
            {
                "poses": [[p.pose.position.x, p.pose.position.y, p.pose.position.z] for p in came["pose"]],
                "stamp": [last.header.stamp.sec, last.header.stamp.nanosec],
                "frames": [last.header.frame_id, moved.child_frame_id, cloud.header.frame_id],
                "tf": [moved.transform.translation.x, moved.transform.rotation.w],
                "path": len(came["path"][-1].poses),
                "points": len(points),
                "median_z": float(np.median(points[:, 2])),
                "failure": str(node.failure),
                "rclpy": rclpy.__file__,
            }
        )
    )


if __name__ == "__main__":
    main()
