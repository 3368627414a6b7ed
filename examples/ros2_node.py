"""A ROS 2 node: color and registered depth in; pose, path, point cloud and TF out.

python examples/ros2_node.py --ros-args -r color:=/camera/color/image_raw \
    -r depth:=/camera/aligned_depth_to_color/image_raw -r camera_info:=/camera/color/camera_info
"""

import threading
import time
from dataclasses import dataclass

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, TransformStamped
from nav_msgs.msg import Path
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField
from std_msgs.msg import Header
from tf2_ros import TransformBroadcaster

import spslam
from spslam.geometry import matrix_to_quaternion
from spslam.live import FrameQueue, LiveFrame

PAIR_TOLERANCE_S = 0.02  # between the stamps of a color and a depth image of one frame
MAX_WAIT_S = 0.06  # frames that waited longer are dropped for newer ones
CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}
DEPTH = {"16UC1": ("u2", 1000), "mono16": ("u2", 1000), "32FC1": ("f4", 1)}  # type, units per meter
CLOUD_STEP_PX = 4
PATH_POSES = 2000  # at most; a message takes time that grows with them


@dataclass(frozen=True)
class StampedFrame(LiveFrame):
    """A frame with the header of its poses: the color image's frame, and the depth image's exact stamp, as TF needs."""

    header: Header


class SlamNode(Node):
    """Tracks and maps on a thread of its own, so that callbacks never wait."""

    def __init__(self):
        super().__init__("spslam")
        values = {"config": "folder", "preset": "balanced", "device": "cpu", "world_frame": "map", "mesh": ""}
        self.options = {name: self.declare_parameter(name, value).value for name, value in values.items()}
        self.system = self.failure = None
        self.queue = FrameQueue(MAX_WAIT_S)
        self.colors, self.depths = {}, {}
        self.path = Path()
        self.path.header.frame_id = self.options["world_frame"]
        self.pose_publisher = self.create_publisher(PoseStamped, "pose", 10)
        self.path_publisher = self.create_publisher(Path, "path", 1)
        self.cloud_publisher = self.create_publisher(PointCloud2, "points", 1)
        self.transforms = TransformBroadcaster(self)
        self.create_subscription(CameraInfo, "camera_info", self.on_camera_info, qos_profile_sensor_data)
        self.create_subscription(Image, "color", self.on_color, qos_profile_sensor_data)
        self.create_subscription(Image, "depth", self.on_depth, qos_profile_sensor_data)
        self.worker = threading.Thread(target=self.work, daemon=True)
        self.worker.start()

    def on_camera_info(self, info):
        if self.system is not None:
            return
        if any(abs(number) > 1e-3 for number in info.d):
            self.get_logger().warn("the images have lens distortion; subscribe to rectified ones (image_proc)")
        try:
            camera = spslam.Camera(info.width, info.height, info.k[0], info.k[4], info.k[2], info.k[5])
        except ValueError as error:  # a camera that is not calibrated has zeros
            self.get_logger().error(f"camera_info can't be used: {error}", throttle_duration_sec=5.0)
            return
        config = spslam.load_config(self.options["config"], self.options["preset"])
        self.system = spslam.SlamSystem(config, camera, device=self.options["device"])
        self.get_logger().info(f"tracking with {camera}")

    def on_color(self, message):
        self.colors[seconds(message)] = message
        self.pair()

    def on_depth(self, message):
        self.depths[seconds(message)] = message
        self.pair()

    def pair(self):
        """Hands over the newest color image that has a depth image of its time."""
        pairs = [(c, d) for c in self.colors for d in self.depths if abs(c - d) <= PAIR_TOLERANCE_S]
        if pairs and self.system is not None:
            newest, partner = max(pairs, key=lambda pair: (pair[0], -abs(pair[0] - pair[1])))
            self.hand_over(self.colors[newest], self.depths[partner])
            self.colors = {time: color for time, color in self.colors.items() if time > newest}
            self.depths = {time: depth for time, depth in self.depths.items() if time > partner}
        for images in (self.colors, self.depths):
            while len(images) > 10:
                del images[next(iter(images))]  # that came first: stamps go back where a recording starts over

    def hand_over(self, color, depth):
        """Gives a pair of messages to the worker; what can't be a frame is logged and left out."""
        arrived = time.monotonic()
        try:
            rgb, stored, units_per_meter = images(color, depth)
            frame = spslam.RgbdFrame.from_arrays(rgb, stored, seconds(depth), depth_scale=units_per_meter)
        except (TypeError, ValueError) as error:
            self.get_logger().error(f"a frame is left out: {error}", throttle_duration_sec=5.0)
        else:
            header = Header(stamp=depth.header.stamp, frame_id=color.header.frame_id)
            self.queue.put(StampedFrame(frame, arrived, header))

    def work(self):
        """Tracks the newest frame; optimizes the map while there is none."""
        while not self.queue.is_over and rclpy.ok():
            try:
                waiting = self.queue.take(0.01 if self.system is not None and self.system.mapping_left else 0.5)
                if waiting is not None:
                    self.track(waiting)
                if self.system is not None:
                    self.system.optimize_map(2)
            except Exception as error:
                if rclpy.ok():  # else Ctrl-C has ended what publishes
                    self.failure = error
                    self.get_logger().fatal(f"tracking has ended: {error}")
                return

    def track(self, waiting):
        report = self.system.process(waiting.frame, lambda pose: self.publish(waiting, pose), defer_mapping=True)
        if report.lost:
            self.get_logger().warn(f"frame {report.frame} is lost", throttle_duration_sec=1.0)
        elif report.frame % 10 == 0:
            self.cloud_publisher.publish(self.cloud(waiting))
            self.path_publisher.publish(self.path)

    def publish(self, waiting, pose):
        """Pose and TF as soon as the pose is known; nothing of a lost frame."""
        if pose is None:
            return
        stamped, moved = PoseStamped(), TransformStamped()
        for message in (stamped, moved):
            message.header.frame_id, message.header.stamp = self.options["world_frame"], waiting.header.stamp
        w, x, y, z = matrix_to_quaternion(pose[:3, :3]).tolist()
        for rotation in (stamped.pose.orientation, moved.transform.rotation):
            rotation.w, rotation.x, rotation.y, rotation.z = w, x, y, z
        for position in (stamped.pose.position, moved.transform.translation):
            position.x, position.y, position.z = pose[:3, 3].tolist()
        moved.child_frame_id = waiting.header.frame_id
        self.path.poses.append(stamped)
        if len(self.path.poses) > PATH_POSES:
            self.path.poses = self.path.poses[::2]
        self.path.header.stamp = waiting.header.stamp
        self.pose_publisher.publish(stamped)
        self.transforms.sendTransform(moved)

    def cloud(self, waiting):
        """The frame's points in the camera's axes, colored; TF says where they are."""
        step = np.s_[::CLOUD_STEP_PX, ::CLOUD_STEP_PX]
        points = self.system.camera.unproject(waiting.frame.depth)[step]
        color, known = waiting.frame.color[step].astype(np.uint32), points[..., 2] > 0
        rows = np.zeros(int(known.sum()), dtype=[("xyz", "<f4", 3), ("rgb", "<u4")])
        rows["xyz"] = points[known]
        rows["rgb"] = (color[..., 0] << 16 | color[..., 1] << 8 | color[..., 2])[known]
        message = PointCloud2(height=1, width=len(rows), point_step=16, row_step=16 * len(rows), is_dense=True)
        message.header = waiting.header
        message.fields = [
            PointField(name=name, offset=4 * place, datatype=PointField.FLOAT32, count=1)
            for place, name in enumerate(("x", "y", "z", "rgb"))
        ]
        message.data = rows.tobytes()
        return message

    def close(self):
        """Ends tracking; writes the mesh if the parameter `mesh` names a file."""
        self.queue.close()
        self.worker.join()
        if self.system is not None and self.options["mesh"]:
            self.system.finish()
            self.system.mesh().save(self.options["mesh"])


def seconds(message):
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def images(color, depth):
    """RGB [H, W, 3] and depth [H, W] as stored, and the units per meter of that."""
    for message, known in ((color, CHANNELS), (depth, DEPTH)):
        if message.encoding not in known:
            raise ValueError(f"the encoding must be one of {', '.join(known)}, got {message.encoding}")
    pixels = np.frombuffer(color.data, np.uint8).reshape(color.height, color.step)
    pixels = pixels[:, : CHANNELS[color.encoding] * color.width].reshape(color.height, color.width, -1)[..., :3]
    kind, units_per_meter = DEPTH[depth.encoding]
    order = ">" if depth.is_bigendian else "<"
    stored = np.frombuffer(depth.data, order + kind).reshape(depth.height, -1)[:, : depth.width]
    return pixels[..., ::-1] if color.encoding.startswith("bgr") else pixels, stored, units_per_meter


def main():
    rclpy.init()
    node = SlamNode()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.close()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
