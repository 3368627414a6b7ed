"""ROS bags of every kind give the frames that were written into them."""

import pickle
import re
import threading

import numpy as np
import pytest

from spslam.datasets.lens import Lens
from spslam.datasets.prefetch import prefetch
from spslam.datasets.rosbag import RosOptions, open_realsense, open_rosbag
from spslam.errors import DatasetError
from tests.datasets.cameras import BROWN, REALSENSE, camera, extrinsics, path, render
from tests.datasets.ros_bags import (
    START_S,
    Frames,
    Messages,
    camera_messages,
    realsense_messages,
    write_mcap,
    write_ros1,
    write_ros2,
)

SMALL = camera(64, 48, 0.8)
COUNT = 40
POSES = path(COUNT)


def same_view(count=COUNT):
    """Frames of one camera: random images, each of its own brightness and distance."""
    generator = np.random.default_rng(0)
    color = [generator.integers(0, 255, (48, 64, 3), dtype=np.uint8) for _ in range(count)]
    depth = [np.full((48, 64), 1 + 0.01 * number, np.float32) for number in range(count)]
    return Frames(color, depth, Lens(SMALL), Lens(SMALL), poses=POSES[:count])


WRITERS = {
    "ros1": lambda folder, frames, style: write_ros1(
        folder / "r.bag", camera_messages(ros := Messages(False), frames, style), ros
    ),
    "ros1 lz4": lambda folder, frames, style: write_ros1(
        folder / "r.bag", camera_messages(ros := Messages(False), frames, style), ros, "LZ4"
    ),
    "ros1 bz2": lambda folder, frames, style: write_ros1(
        folder / "r.bag", camera_messages(ros := Messages(False), frames, style), ros, "BZ2"
    ),
    "ros2 sqlite": lambda folder, frames, style: write_ros2(
        folder / "r", camera_messages(ros := Messages(True), frames, style), ros
    ),
    "ros2 mcap": lambda folder, frames, style: write_ros2(
        folder / "r", camera_messages(ros := Messages(True), frames, style), ros, "mcap"
    ),
    "mcap": lambda folder, frames, style: write_mcap(
        folder / "r.mcap", camera_messages(ros := Messages(True), frames, style), ros
    ),
}


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("style", ["raw", "compressed"])
def test_every_kind_of_bag_gives_the_same_frames(tmp_path, kind, style):
    frames = same_view()
    dataset = open_rosbag(WRITERS[kind](tmp_path, frames, style))
    assert len(dataset) == COUNT
    assert dataset.camera == SMALL
    np.testing.assert_allclose(dataset.timestamps(), START_S + frames.times() + 0.004, atol=1e-6)
    np.testing.assert_allclose(dataset.poses(), POSES, atol=1e-6)
    with prefetch(dataset, workers=3) as found:
        for number, frame in enumerate(found):
            np.testing.assert_array_equal(frame.color, frames.color[number])
            np.testing.assert_allclose(frame.depth, frames.depth[number], atol=1e-6)
            np.testing.assert_allclose(frame.pose, POSES[number], atol=1e-6)


def test_any_frame_in_any_order_and_in_another_process(tmp_path):
    frames = same_view()
    dataset = open_rosbag(WRITERS["ros1 lz4"](tmp_path, frames, "raw"))
    order = np.random.default_rng(1).permutation(COUNT)
    for copy in (dataset, pickle.loads(pickle.dumps(dataset))):
        for number in order:
            np.testing.assert_array_equal(copy[int(number)].color, frames.color[number])
    threads = [threading.Thread(target=lambda: [dataset[int(n)] for n in order]) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def two_cameras(distorted=True):
    """A color camera and, beside it, a smaller depth camera in the generated room."""
    color_lens = Lens(camera(256, 144, 0.72), "brown", BROWN) if distorted else Lens(camera(256, 144, 0.72))
    depth_lens, color_from_depth = Lens(camera(160, 120, 0.8)), extrinsics()
    poses = path(60)[::15]
    color = [render(color_lens, pose)[0] for pose in poses]
    depth = [render(depth_lens, pose @ color_from_depth)[1] for pose in poses]
    return Frames(color, depth, color_lens, depth_lens, color_from_depth, poses)


def check_registered(dataset, frames, number=2):
    """A frame is that of the depth camera, rendered."""
    pose = frames.poses[number] @ frames.color_from_depth
    color, depth = render(frames.depth_lens, pose)
    frame = dataset[number]
    known = frame.depth > 0
    assert known.mean() > 0.5
    assert np.median(np.abs(frame.depth - depth)[known]) < 6e-4
    assert np.median(np.abs(frame.color.astype(int) - color)[known]) <= 4
    return frame, pose


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_transforms_connect_the_cameras_and_are_the_reference(tmp_path, kind):
    frames = two_cameras()
    dataset = open_rosbag(WRITERS[kind](tmp_path, frames, "raw"))
    frame, pose = check_registered(dataset, frames)
    np.testing.assert_allclose(frame.pose, pose, atol=1e-9)
    assert dataset.camera == frames.depth_lens.camera
    color_view = open_rosbag(dataset._color._path, RosOptions(view="color"))
    np.testing.assert_allclose(color_view[2].pose, frames.poses[2], atol=1e-9)
    assert color_view[2].depth.shape == (144, 256)


@pytest.mark.parametrize("unit_m", [0.001, 0.00025])
def test_realsense_bag(tmp_path, unit_m):
    frames = two_cameras(distorted=False)
    color_lens = Lens(frames.color_lens.camera, "brown", REALSENSE)
    frames.color_lens, frames.color = color_lens, [render(color_lens, pose)[0] for pose in frames.poses]
    make = Messages(False)
    dataset = open_realsense(write_ros1(tmp_path / "d435.bag", realsense_messages(make, frames, unit_m), make))
    assert dataset.name == "realsense/d435"
    assert dataset.poses() is None
    check_registered(dataset, frames)


def test_topics_are_found_among_others_or_named(tmp_path):
    frames, make = same_view(8), Messages(True)
    messages = camera_messages(make, frames)
    infrared = [np.full((48, 64), 9, np.uint8)] * 8
    for number, seconds in enumerate(frames.times()):
        messages.append(("/camera/infra1/image_rect_raw", seconds, make.image(seconds, "ir", "mono8", infrared[0])))
        aligned = np.full((48, 64), 3000 + number, np.uint16)
        image = make.image(seconds, "color_optical", "16UC1", aligned)
        messages.append(("/camera/aligned_depth_to_color/image_raw", seconds, image))
    bag = write_ros2(tmp_path / "r", messages, make)
    dataset = open_rosbag(bag)
    np.testing.assert_array_equal(dataset[3].color, frames.color[3])
    assert dataset[3].depth[0, 0] == pytest.approx(3.003)
    named = open_rosbag(bag, RosOptions(depth_topic="/camera/depth/image_raw"))
    np.testing.assert_allclose(named[3].depth, frames.depth[3], atol=1e-6)
    assert open_rosbag(bag, RosOptions(depth_scale=500.0))[3].depth[0, 0] == pytest.approx(6.006)
    for options, message in (
        (RosOptions(color_topic="/rgb"), "dataset.color_topic must name a topic with images, got /rgb; topics with"),
        (
            RosOptions(pose_topic="/odom"),
            "dataset.pose_topic must name a topic of Odometry, .* got /odom; there is none",
        ),
        (RosOptions(world_frame="earth"), "dataset.world_frame must be one that color_optical is in: .*map, got earth"),
    ):
        with pytest.raises(DatasetError, match=message):
            open_rosbag(bag, options)


@pytest.mark.parametrize("kind", ["Odometry", "PoseStamped", "TransformStamped"])
def test_poses_of_a_topic(tmp_path, kind):
    frames, make = same_view(8), Messages(True)
    messages = camera_messages(make, frames, transforms=False)
    for message in messages:
        message[2].header.frame_id = "cam"
    for number, seconds in enumerate(frames.times()):
        for at in (seconds, seconds + 0.004):
            transform = make.transform(POSES[number])
            point = make.make("geometry_msgs/msg/Point", **vars(transform.translation) | {})
            pose = make.make("geometry_msgs/msg/Pose", position=point, orientation=transform.rotation)
            header = make.header(at, "world")
            if kind == "PoseStamped":
                message = make.make("geometry_msgs/msg/PoseStamped", header=header, pose=pose)
            elif kind == "TransformStamped":
                message = make.stamped(at, "world", "cam", POSES[number])
            else:
                covariance = np.zeros(36)
                still = make.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
                twist = make.make("geometry_msgs/msg/Twist", linear=still, angular=still)
                message = make.make(
                    "nav_msgs/msg/Odometry",
                    header=header,
                    child_frame_id="cam",
                    pose=make.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance),
                    twist=make.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=covariance),
                )
            messages.append(("/truth", at, message))
    bag = write_ros2(tmp_path / "r", messages, make)
    assert open_rosbag(bag).poses() is None
    np.testing.assert_allclose(open_rosbag(bag, RosOptions(pose_topic="/truth")).poses(), POSES[:8], atol=1e-6)


def test_transforms_of_another_clock_are_a_doubt(tmp_path):
    frames, make = same_view(8), Messages(True)
    messages = camera_messages(make, frames)
    for topic, seconds, message in messages:
        if topic == "/tf":
            for transform in message.transforms:
                transform.header.stamp = make.header(seconds + 500, "map").stamp
    dataset = open_rosbag(write_ros2(tmp_path / "r", messages, make))
    assert dataset.poses() is None
    (doubt,) = dataset.doubts
    assert "from color_optical to map are known for no time of a frame" in str(doubt)


def test_a_topic_of_another_clock_is_a_doubt(tmp_path):
    frames, make = same_view(8), Messages(True)
    messages = camera_messages(make, frames, transforms=False)
    for message in messages:
        message[2].header.frame_id = "cam"
    for number, seconds in enumerate(frames.times()):
        messages.append(("/truth", seconds, make.stamped(seconds - 100, "world", "cam", POSES[number])))
    dataset = open_rosbag(write_ros2(tmp_path / "r", messages, make), RosOptions(pose_topic="/truth"))
    assert dataset.poses() is None
    (doubt,) = dataset.doubts
    assert re.search(r"no frame has a ground-truth pose: .*r, /truth, covers .* s, the frames .* s", str(doubt)), doubt


ENCODINGS = {
    "rgb8": lambda rgb: rgb,
    "bgr8": lambda rgb: rgb[..., ::-1],
    "rgba8": lambda rgb: np.dstack((rgb, rgb[..., 0])),
    "bgra8": lambda rgb: np.dstack((rgb[..., ::-1], rgb[..., 0])),
}


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_encodings_of_color(tmp_path, encoding):
    frames, make = same_view(2), Messages(False)
    messages = camera_messages(make, frames)
    for topic, seconds, message in messages:
        if topic == "/camera/color/image_raw":
            number = round(float(frames.times().searchsorted(seconds - 0.051)))
            pixels = np.ascontiguousarray(ENCODINGS[encoding](frames.color[number]))
            changed = make.image(0, "", encoding, pixels)
            message.encoding, message.step, message.data = encoding, changed.step, changed.data
    dataset = open_rosbag(write_ros1(tmp_path / "r.bag", messages, make))
    np.testing.assert_array_equal(dataset[1].color, frames.color[1])


def drop(*topics):
    return lambda messages: [entry for entry in messages if entry[0] not in topics]


def without_frames(messages):
    return [entry for entry in messages if not entry[0].startswith("/tf")]


def with_encoding(topic, encoding):
    def change(messages):
        for name, _, message in messages:
            if name == topic:
                message.encoding = encoding
        return messages

    return change


def uncalibrated(messages):
    for name, _, message in messages:
        if name == "/camera/color/camera_info":
            message.k[:] = 0
    return messages


def late(messages):
    for name, _, message in messages:
        if name == "/camera/depth/image_raw":
            message.header.stamp.sec += 100
    return messages


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (drop("/camera/depth/image_raw"), "must contain a topic of depth images, got none; dataset.depth_topic names"),
        (drop("/camera/color/image_raw"), "must contain a topic of color images, got none; dataset.color_topic names"),
        (drop("/camera/color/camera_info"), "the camera of /camera/color/image_raw must be described by a CameraInfo"),
        (without_frames, "a transform must connect the frames of .*color_optical.* say --set dataset.registered=true"),
        (with_encoding("/camera/depth/image_raw", "8UC1"), "must contain a topic of depth images, got none"),
        (with_encoding("/camera/color/image_raw", "rgb16"), "must contain a topic of color images, got none"),
        (uncalibrated, "/camera/color/camera_info: the camera must be calibrated, got a focal length of 0"),
        (
            late,
            "must have color and depth images within 0.02 s of each other, got none: 4 and 4 images, the nearest two",
        ),
    ],
)
def test_what_a_bag_lacks_is_one_line(tmp_path, spoil, message):
    make = Messages(True)
    messages = spoil(camera_messages(make, same_view(4)))
    with pytest.raises(DatasetError, match=message) as error:
        open_rosbag(write_ros2(tmp_path / "r", messages, make))
    assert "\n" not in str(error.value)


def test_depth_that_is_registered_needs_no_transform(tmp_path):
    make = Messages(True)
    bag = write_ros2(tmp_path / "r", without_frames(camera_messages(make, same_view(4))), make)
    assert open_rosbag(bag, RosOptions(registered=True))[1].depth.any()


@pytest.mark.parametrize("kind", ["ros1", "ros2 mcap", "ros2 sqlite"])
def test_a_truncated_bag_is_one_line(tmp_path, kind):
    bag = WRITERS[kind](tmp_path, same_view(8), "raw")
    file = bag if bag.is_file() else next(file for file in bag.iterdir() if file.suffix in (".mcap", ".db3"))
    for keep in (0, 10, 0.5, 0.9):
        content = file.read_bytes()
        file.write_bytes(content[: int(keep if keep > 1 else keep * len(content))])
        with pytest.raises(DatasetError) as error:
            open_rosbag(bag)[0]
        assert str(error.value).startswith(str(bag))
        assert "\n" not in str(error.value)
        assert keep != 0.5 or "mends a" in str(error.value)
        file.write_bytes(content)


def test_what_is_no_bag(tmp_path):
    for name, message in (("absent.bag", "no such file"), ("x.txt", "a ROS bag must end in .bag, .mcap, .db3")):
        (tmp_path / "x.txt").touch()
        with pytest.raises(DatasetError, match=message):
            open_rosbag(tmp_path / name)
    with pytest.raises(DatasetError, match=r"must contain a ROS bag \(.bag, .mcap, .db3\), got none"):
        open_rosbag(tmp_path)


def test_rosbags_absent_is_one_line(tmp_path, monkeypatch):
    bag = WRITERS["ros1"](tmp_path, same_view(2), "raw")
    monkeypatch.setitem(__import__("sys").modules, "rosbags.highlevel", None)
    with pytest.raises(DatasetError, match=r"ROS bags need rosbags: pip install 'spslam\[ros\]'"):
        open_rosbag(bag)
