"""Recordings of ROS 1 and ROS 2 (bag, db3, mcap), and RealSense's, which are ROS 1 bags; read by `rosbags`."""

from spslam.datasets.rosbag.realsense import open_realsense
from spslam.datasets.rosbag.recording import RosOptions, open_rosbag

__all__ = ["RosOptions", "open_realsense", "open_rosbag"]
