"""RealSense's recordings: ROS 1 bags in librealsense's own layout.

Topics are `/device_0/sensor_N/Depth_0/image/data` (16-bit) and `.../Color_0/image/data`, their cameras
`.../info/camera_info`, their places `.../tf/0`, which maps points of a reference stream to this one's, and the depth
unit (m) `/device_0/sensor_N/option/Depth_Units/value`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from spslam.datasets.images import DEPTH_SCALE_RULE, is_depth_scale
from spslam.datasets.lens import Lens
from spslam.datasets.pairing import pair_by_time
from spslam.datasets.recording import Calibration, Recording
from spslam.datasets.rosbag.bag import Bag, explained, topic_index
from spslam.datasets.rosbag.messages import camera_of
from spslam.datasets.rosbag.recording import RosOptions, image_size
from spslam.datasets.rosbag.stream import TopicStream
from spslam.datasets.rosbag.topics import ImageTopic
from spslam.datasets.rosbag.transforms import transform_matrix
from spslam.errors import DatasetError
from spslam.geometry import inverse

_IMAGES = re.compile(r"(/device_\d+/sensor_\d+)/(Depth|Color)_\d+/image/data")
_MILLIMETER = 0.001


def is_realsense(topics: Iterable[str]) -> bool:
    """Whether topics are those of librealsense's recorder."""
    return any(_IMAGES.fullmatch(topic) for topic in topics)


def open_realsense(path: Path, options: RosOptions | None = None) -> Recording:
    """Opens a recording of librealsense's recorder (realsense-viewer, rs-record, `rs.config.enable_record_to_file`).

    Args:
        path: the `.bag` file.
        options: what is named rather than found; the topics, the poses and the frame have no effect.

    Raises:
        DatasetError: a bag that can't be read, of another layout, or without color or depth.
    """
    options = options or RosOptions()
    with explained(path), Bag(path) as bag:
        topics = {}
        for kind in ("Color", "Depth"):
            names = [name for name in sorted(bag.topics) if (found := _IMAGES.fullmatch(name)) and found[2] == kind]
            names = [name for name in names if bag.counts[name]]
            if not names:
                raise DatasetError(
                    f"{path}: must contain {kind.lower()} images in librealsense's layout "
                    f"(/device_0/sensor_0/{kind}_0/image/data), got none"
                )
            topics[kind] = ImageTopic(names[0], kind == "Depth", bag.first(names[0]))
        color, depth = topics["Color"], topics["Depth"]
        place = np.eye(4) if options.registered else _place(bag, color) @ inverse(_place(bag, depth))
        color_index, depth_index = topic_index(path, color.name), topic_index(path, depth.name)
        calibration = Calibration(_lens(bag, color), _lens(bag, depth), place)
        scale = _depth_scale(bag, depth) if options.depth_scale is None else options.depth_scale
    color_stream = TopicStream(path, color.name, color_index, False)
    depth_stream = TopicStream(path, depth.name, depth_index, True, scale)
    pairs = pair_by_time(color_index.seconds, depth_index.seconds, options.pair_tolerance_s, str(path))
    dataset = Recording(f"realsense/{path.stem}", color_stream, depth_stream, pairs, calibration, view=options.view)
    dataset.is_timed = dataset.is_seekable = True
    return dataset


def _lens(bag: Bag, topic: ImageTopic) -> Lens:
    info = topic.name.replace("/image/data", "/info/camera_info")
    if not bag.counts.get(info):
        raise DatasetError(f"{bag.path}: the camera of {topic.name} must be described by {info}, got none")
    return camera_of(bag.first(info), image_size(topic), False, f"{bag.path}, {info}")


def _place(bag: Bag, topic: ImageTopic) -> np.ndarray:
    """Points of the reference stream to points of this one, [4, 4]."""
    prefix = topic.name.replace("/image/data", "/tf")
    names = [name for name in sorted(bag.topics) if name.startswith(prefix) and bag.counts[name]]
    if not names:
        raise DatasetError(
            f"{bag.path}: the place of {topic.name} must be in {prefix}/0, got none; if depth is registered to color, "
            "say --set dataset.registered=true"
        )
    return transform_matrix(bag.first(names[0]), f"{bag.path}, {names[0]}")


def _depth_scale(bag: Bag, topic: ImageTopic) -> float:
    found = _IMAGES.fullmatch(topic.name)
    prefix = found[1] if found else ""
    for name in (f"{prefix}/option/Depth_Units/value", f"{prefix}/option/Depth Units/value"):
        if bag.counts.get(name):
            unit = float(bag.first(name).data)
            scale = 1 / unit if unit > 0 else 0.0
            if not is_depth_scale(scale):
                raise DatasetError(f"{bag.path}, {name}: its inverse must be {DEPTH_SCALE_RULE}, got {scale:g}")
            # A millimeter comes as 0.001 in float32, whose inverse is no whole number.
            return float(round(scale)) if abs(scale - round(scale)) < 1e-3 * scale else scale
    return 1 / _MILLIMETER
