"""Opening a ROS bag as a recording: topics, cameras, transforms between them, and reference poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spslam.datasets.findings import Finding
from spslam.datasets.lens import Lens
from spslam.datasets.pairing import pair_by_time
from spslam.datasets.recording import Calibration, Recording, View
from spslam.datasets.reference_poses import ReferencePoses, interpolated_poses
from spslam.datasets.rosbag.bag import Bag, explained, topic_index
from spslam.datasets.rosbag.messages import camera_of, decode_color_message, decode_depth_message
from spslam.datasets.rosbag.stream import TopicStream
from spslam.datasets.rosbag.topics import ImageTopic, camera_info_topic, choose_images
from spslam.datasets.rosbag.transforms import MAX_GAP_S, TransformTree, read_pose_topic, read_transforms
from spslam.errors import DatasetError


@dataclass(frozen=True)
class RosOptions:
    """What a user may know about a bag; None finds out.

    Attributes:
        color_topic: of color images.
        depth_topic: of depth images.
        pose_topic: whose poses are the reference ones, in place of the transforms.
        world_frame: in which the transforms give the reference poses; the root of the tree if None.
        registered: whether depth is in the color camera's view.
        depth_scale: depth units per meter.
        pair_tolerance_s: images that are less apart are one frame.
        view: whose view frames are registered to.
    """

    color_topic: str | None = None
    depth_topic: str | None = None
    pose_topic: str | None = None
    world_frame: str | None = None
    registered: bool | None = None
    depth_scale: float | None = None
    pair_tolerance_s: float = 0.02
    view: View = "depth"


def open_rosbag(path: Path, options: RosOptions | None = None) -> Recording:
    """Opens a ROS 1 bag, a ROS 2 folder, an mcap or a db3 file.

    Images are `Image` or `CompressedImage` (with `compressedDepth`), cameras `CameraInfo`. Where color and depth have
    frames of their own, the transforms of the bag say how they are to each other. If they also say how the camera
    moves, that is the reference trajectory.

    Args:
        path: see `bag_files`.
        options: what is named rather than found.

    Raises:
        DatasetError: a bag that can't be read, without images or cameras, or with cameras that nothing connects.
    """
    options = options or RosOptions()
    with explained(path), Bag(path) as bag:
        color, depth = choose_images(bag, options.color_topic, options.depth_topic)
        color_lens = _lens(bag, color, None)
        is_registered = depth.is_registered if options.registered is None else options.registered
        depth_lens = _lens(bag, depth, color_lens if is_registered or _frame(depth) == _frame(color) else None)
        color_index, depth_index = topic_index(path, color.name), topic_index(path, depth.name)
        tree = read_transforms(bag)
        place = np.eye(4) if is_registered else _place(bag, color, depth, tree, float(color_index.seconds[0]))
        pairs = pair_by_time(color_index.seconds, depth_index.seconds, options.pair_tolerance_s, str(path))
        reference = _reference(bag, tree, _frame(color) or "", depth_index.seconds[pairs[:, 1]], options)
    calibration = Calibration(color_lens, depth_lens, place)
    name = f"rosbag/{path.stem if path.is_file() else path.name}"
    color_stream = TopicStream(path, color.name, color_index, False)
    depth_stream = TopicStream(path, depth.name, depth_index, True, options.depth_scale)
    dataset = Recording(name, color_stream, depth_stream, pairs, calibration, reference.poses, view=options.view)
    dataset.doubts, dataset.is_timed, dataset.is_seekable = reference.doubts, True, True
    return dataset


def image_size(topic: ImageTopic) -> tuple[int, int]:
    """(width, height) of a topic's first image; raises DatasetError where it can't be decoded."""
    if not topic.is_compressed:
        return int(topic.first.width), int(topic.first.height)
    name = f"{topic.name}, the first message"
    if topic.is_depth:
        return decode_depth_message(topic.first, name, None).shape[1::-1]
    return decode_color_message(topic.first, name).shape[1::-1]


def _lens(bag: Bag, topic: ImageTopic, instead: Lens | None) -> Lens:
    """The lens of a topic's camera; without a description the one `instead`, brought to the size of the images."""
    info, size = camera_info_topic(bag, topic), image_size(topic)
    if info is not None:
        return camera_of(bag.first(info), size, topic.is_rectified, f"{bag.path}, {info}")
    if instead is not None:
        return Lens(instead.camera.resized(*size), instead.model, instead.coefficients)
    raise DatasetError(
        f"{bag.path}: the camera of {topic.name} must be described by a CameraInfo topic beside it or of the same "
        f"frame ({_frame(topic) or 'none'}), got none"
    )


def _frame(topic: ImageTopic) -> str | None:
    return topic.first.header.frame_id.lstrip("/") or None


def _place(bag: Bag, color: ImageTopic, depth: ImageTopic, tree: TransformTree, time: float) -> np.ndarray:
    """`color_from_depth` by the frames of the images."""
    frames = _frame(color), _frame(depth)
    if frames[0] == frames[1]:
        return np.eye(4)
    found = None if None in frames else tree.between(str(frames[0]), str(frames[1]), time)
    if found is None:
        raise DatasetError(
            f"{bag.path}: a transform must connect the frames of {color.name} ({frames[0]}) and {depth.name} "
            f"({frames[1]}), got none in /tf_static or /tf; if depth is registered to color, say "
            "--set dataset.registered=true"
        )
    return found


def _reference(bag: Bag, tree: TransformTree, frame: str, times: np.ndarray, options: RosOptions) -> ReferencePoses:
    """Poses of the color camera at the frames' times."""
    if options.pose_topic is not None:
        trajectory, child = read_pose_topic(bag, options.pose_topic)
        reference = interpolated_poses(trajectory, times, MAX_GAP_S, f"{bag.path}, {options.pose_topic},")
        child_from_color = tree.between(child, frame, float(times[0])) if child else None
        if reference.poses is None or child_from_color is None:
            return reference
        return ReferencePoses(reference.poses @ child_from_color)
    chain = tree.ancestors(frame)
    world = (options.world_frame or chain[-1]).lstrip("/")
    if world not in chain:
        raise DatasetError(
            f"{bag.path}: dataset.world_frame must be one that {frame} is in: {', '.join(chain)}, got "
            f"{options.world_frame}"
        )
    if not tree.moves(frame, world):
        return ReferencePoses()
    poses = tree.poses(frame, world, times)
    if np.isfinite(poses).any():
        return ReferencePoses(poses)
    text = (
        f"no frame has a ground-truth pose: the transforms of {bag.path} from {frame} to {world} are known for no time "
        f"of a frame, and none is interpolated over more than {MAX_GAP_S:g} s"
    )
    return ReferencePoses(
        None, (Finding("reference poses", text, "bring both to one clock, or set dataset.pose_topic"),)
    )
