"""ROS bags of given frames, written by `rosbags` and by `mcap`'s own writer."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from spslam.datasets.lens import Lens
from spslam.geometry import matrix_to_quaternion

pytest.importorskip("rosbags")
pytest.importorskip("mcap_ros2")
from mcap_ros2.writer import Writer as McapWriter  # noqa: E402
from rosbags.rosbag1 import Writer as Writer1  # noqa: E402
from rosbags.rosbag2 import StoragePlugin  # noqa: E402
from rosbags.rosbag2 import Writer as Writer2  # noqa: E402
from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: E402

START_S = 1_700_000_000
COLOR_FRAME, DEPTH_FRAME, BASE, WORLD = "color_optical", "depth_optical", "base_link", "map"
TF = "geometry_msgs/TransformStamped[] transforms\n"


@dataclass
class Frames:
    """What is written: one entry per frame, and the cameras.

    Attributes:
        color: uint8 [H, W, 3] each.
        depth: float32 [H, W], m, each.
        color_lens: of the color images.
        depth_lens: of the depth images.
        color_from_depth: [4, 4].
        poses: [F, 4, 4] of the color camera, or None.
        seconds: [F], from `START_S` on.
        depth_delay_s: of depth behind color.
    """

    color: list[np.ndarray]
    depth: list[np.ndarray]
    color_lens: Lens
    depth_lens: Lens
    color_from_depth: np.ndarray = field(default_factory=lambda: np.eye(4))
    poses: np.ndarray | None = None
    seconds: np.ndarray | None = None
    depth_delay_s: float = 0.004

    def times(self) -> np.ndarray:
        return np.arange(len(self.color)) / 30 if self.seconds is None else self.seconds


class Messages:
    """Makes messages of one version of ROS."""

    def __init__(self, is_ros2: bool) -> None:
        self.is_ros2 = is_ros2
        self.store = get_typestore(Stores.ROS2_HUMBLE if is_ros2 else Stores.ROS1_NOETIC)
        if not is_ros2:
            self.store.register(get_types_from_msg(TF, "tf2_msgs/msg/TFMessage"))
            option = "float32 data\n"
            self.store.register(get_types_from_msg(option, "std_msgs/msg/Float32"))

    def make(self, kind: str, **values):
        return self.store.types[kind](**values)

    def stamp(self, seconds: float):
        whole = int(np.floor(seconds))
        return self.make(
            "builtin_interfaces/msg/Time", sec=START_S + whole, nanosec=round((seconds - whole) * 1e9) % 10**9
        )

    def header(self, seconds: float, frame: str):
        values = {"stamp": self.stamp(seconds), "frame_id": frame}
        return self.make("std_msgs/msg/Header", **values, **({} if self.is_ros2 else {"seq": 0}))

    def image(self, seconds: float, frame: str, encoding: str, pixels: np.ndarray, padding: int = 0):
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(seconds, frame),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=rows.shape[1],
            data=rows.reshape(-1),
        )

    def compressed(self, seconds: float, frame: str, kind: str, content: bytes):
        data = np.frombuffer(content, np.uint8)
        header = self.header(seconds, frame)
        return self.make("sensor_msgs/msg/CompressedImage", header=header, format=kind, data=data)

    def camera_info(self, seconds: float, frame: str, lens: Lens, model: str | None = None):
        names = {"pinhole": "plumb_bob", "brown": "plumb_bob", "fisheye": "equidistant"}
        camera = lens.camera
        keys = ("d", "k", "r", "p") if self.is_ros2 else ("D", "K", "R", "P")
        projection = np.zeros((3, 4))
        projection[:, :3] = camera.matrix()
        arrays = (
            np.array(lens.coefficients or [0.0] * 5),
            camera.matrix().ravel(),
            np.eye(3).ravel(),
            projection.ravel(),
        )
        region = self.make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(seconds, frame),
            height=camera.height,
            width=camera.width,
            distortion_model=model or names[lens.model],
            binning_x=0,
            binning_y=0,
            roi=region,
            **dict(zip(keys, arrays, strict=True)),
        )

    def transform(self, pose: np.ndarray):
        w, x, y, z = (float(value) for value in matrix_to_quaternion(pose[:3, :3]))
        position = dict(zip("xyz", map(float, pose[:3, 3]), strict=True))
        return self.make(
            "geometry_msgs/msg/Transform",
            translation=self.make("geometry_msgs/msg/Vector3", **position),
            rotation=self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        )

    def stamped(self, seconds: float, parent: str, child: str, pose: np.ndarray):
        return self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(seconds, parent),
            child_frame_id=child,
            transform=self.transform(pose),
        )

    def tf(self, *stamped):
        return self.make("tf2_msgs/msg/TFMessage", transforms=list(stamped))


BASE_FROM_COLOR = np.array([[0, 0, 1, 0.1], [-1, 0, 0, 0.02], [0, -1, 0, 0.3], [0, 0, 0, 1.0]])


def camera_messages(make: Messages, frames: Frames, style: str = "raw", transforms: bool = True):
    """(topic, time of recording in s, message) of a robot's recording, in order of time.

    Args:
        make: of a version of ROS.
        frames: what is recorded.
        style: `raw` images, or `compressed` ones (PNG, and `compressedDepth`).
        transforms: whether there are transforms: color and depth below `base_link`, which moves in `map`.
    """
    found = []
    inverse_base = np.linalg.inv(BASE_FROM_COLOR)
    if transforms:
        static = (
            make.stamped(0, BASE, COLOR_FRAME, BASE_FROM_COLOR),
            make.stamped(0, BASE, DEPTH_FRAME, BASE_FROM_COLOR @ frames.color_from_depth),
        )
        found.append(("/tf_static", 0.0, make.tf(*static)))
    for number, seconds in enumerate(frames.times()):
        late = seconds + frames.depth_delay_s
        depth = np.round(frames.depth[number] * 1000).astype(np.uint16)
        if style == "raw":
            color_image = make.image(seconds, COLOR_FRAME, "rgb8", frames.color[number], padding=5)
            depth_image = make.image(late, DEPTH_FRAME, "16UC1", depth)
            names = "/camera/color/image_raw", "/camera/depth/image_raw"
        else:
            png = cv2.imencode(".png", cv2.cvtColor(frames.color[number], cv2.COLOR_RGB2BGR))[1].tobytes()
            color_image = make.compressed(seconds, COLOR_FRAME, "rgb8; png compressed bgr8", png)
            packed = struct.pack("<iff", 0, 0, 0) + cv2.imencode(".png", depth)[1].tobytes()
            depth_image = make.compressed(late, DEPTH_FRAME, "16UC1; compressedDepth png", packed)
            names = "/camera/color/image_raw/compressed", "/camera/depth/image_raw/compressedDepth"
        found.append(("/camera/color/camera_info", seconds, make.camera_info(seconds, COLOR_FRAME, frames.color_lens)))
        found.append(("/camera/depth/camera_info", late, make.camera_info(late, DEPTH_FRAME, frames.depth_lens)))
        found.append((names[0], seconds + 0.05, color_image))
        found.append((names[1], late + 0.02, depth_image))
        if transforms and frames.poses is not None:
            for at in (seconds, late):  # the robot stands still between color and depth
                pose = frames.poses[number] @ inverse_base
                found.append(("/tf", at, make.tf(make.stamped(at, WORLD, BASE, pose))))
    return sorted(found, key=lambda entry: entry[1])


def realsense_messages(make: Messages, frames: Frames, unit_m: float = 0.001):
    """The same in librealsense's layout, whose reference stream is depth."""
    device = "/device_0"
    color, depth = f"{device}/sensor_1/Color_0", f"{device}/sensor_0/Depth_0"
    found = [
        (f"{depth}/info/camera_info", 0.0, make.camera_info(0, "0", frames.depth_lens, "Brown Conrady")),
        (f"{color}/info/camera_info", 0.0, make.camera_info(0, "0", frames.color_lens, "Inverse Brown Conrady")),
        (f"{depth}/tf/0", 0.0, make.transform(np.eye(4))),
        (f"{color}/tf/0", 0.0, make.transform(frames.color_from_depth)),
        (f"{device}/sensor_0/option/Depth_Units/value", 0.0, make.make("std_msgs/msg/Float32", data=unit_m)),
    ]
    for number, seconds in enumerate(frames.times()):
        units = np.round(frames.depth[number] / unit_m).astype(np.uint16)
        late = seconds + frames.depth_delay_s
        found.append((f"{depth}/image/data", late, make.image(late, "0", "mono16", units)))
        found.append((f"{color}/image/data", seconds, make.image(seconds, "0", "rgb8", frames.color[number])))
    return sorted(found, key=lambda entry: entry[1])


def write_ros1(path: Path, messages, make: Messages, compression=None) -> Path:
    """A ROS 1 bag."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = Writer1(path)
    if compression is not None:
        writer.set_compression(getattr(Writer1.CompressionFormat, compression))
    with writer:
        _write_messages(writer, messages, make, make.store.serialize_ros1)
    return path


def write_ros2(path: Path, messages, make: Messages, storage: str = "sqlite3") -> Path:
    """A ROS 2 folder with `metadata.yaml`."""
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        _write_messages(writer, messages, make, make.store.serialize_cdr)
    return path


def _write_messages(writer, messages, make: Messages, serialize):
    """Messages in order, a connection for each topic."""
    connections = {}
    for topic, seconds, message in messages:
        kind = message.__msgtype__
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, kind, typestore=make.store)
        writer.write(connections[topic], round((START_S + seconds) * 1e9), serialize(message, kind))


def write_mcap(path: Path, messages, make: Messages) -> Path:
    """A file by the `mcap` library's own writer and serializer."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "wb") as stream:
        writer = McapWriter(stream, chunk_size=200_000)
        schemas = {}
        for topic, seconds, message in messages:
            kind = message.__msgtype__
            if kind not in schemas:
                text, _ = make.store.generate_msgdef(kind, ros_version=2)
                schemas[kind] = writer.register_msgdef(kind, text)
            at = round((START_S + seconds) * 1e9)
            writer.write_message(topic, schemas[kind], _plain(message), log_time=at, publish_time=at)
        writer.finish()
    return path


def _plain(value):
    """A message as plain objects, which `mcap_ros2` serializes."""
    if hasattr(value, "__dataclass_fields__"):
        names = [name for name in value.__dataclass_fields__ if name != "__msgtype__"]
        return SimpleNamespace(**{name: _plain(getattr(value, name)) for name in names})
    if isinstance(value, np.ndarray):
        return value.tobytes() if value.dtype == np.uint8 else value.tolist()
    return [_plain(item) for item in value] if isinstance(value, list) else value
