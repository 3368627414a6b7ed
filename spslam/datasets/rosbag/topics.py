"""Which topics of a bag are the color and the depth images, and which describe their cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from spslam.datasets.rosbag.bag import Bag
from spslam.datasets.rosbag.messages import CAMERA_INFO, COMPRESSED, IMAGE, is_colorful, is_depth, is_readable
from spslam.errors import DatasetError, brief

_TRANSPORTS = ("compressed", "compressedDepth", "image")
# Images that a camera sees in infrared, or that are made of others.
_NO_COLOR = ("infra", "/ir", "mask", "segment", "debug", "aligned_color")


@dataclass(frozen=True)
class ImageTopic:
    """A topic with images.

    Attributes:
        name: of the topic.
        is_depth: what its images are.
        first: its first message.
    """

    name: str
    is_depth: bool
    first: Any

    @property
    def is_compressed(self) -> bool:
        """Whether the messages are `CompressedImage`."""
        return not hasattr(self.first, "encoding")

    @property
    def is_rectified(self) -> bool:
        """Whether the images are free of distortion by ROS's convention of names (`image_rect`, `image_rect_raw`)."""
        return "rect" in _stem(self.name).rpartition("/")[2].split("_")

    @property
    def is_registered(self) -> bool:
        """Whether depth is in the color camera's view by the common names of such topics."""
        return any(word in self.name for word in ("aligned", "registered", "depth_to_rgb", "depth_to_color"))


def choose_images(bag: Bag, color: str | None, depth: str | None) -> tuple[ImageTopic, ImageTopic]:
    """The topics of color and depth.

    Args:
        bag: to choose from.
        color: topic of color images; None finds the one that looks most like it.
        depth: topic of depth images; None finds one, registered ones first.

    Raises:
        DatasetError: no such topic, a topic of something else, or none to be found, with the topics that there are.
    """
    return _choose(bag, color, False), _choose(bag, depth, True)


def camera_info_topic(bag: Bag, image: ImageTopic) -> str | None:
    """The topic that describes the camera of an image topic: the one beside it, else one of the same frame."""
    folder = _stem(image.name).rpartition("/")[0]
    infos = [name for name, kind in bag.topics.items() if kind == CAMERA_INFO and bag.counts[name]]
    beside = f"{folder}/camera_info"
    if beside in infos:
        return beside
    frame = image.first.header.frame_id
    same = [name for name in infos if frame and bag.first(name).header.frame_id == frame]
    return same[0] if same else None


def _choose(bag: Bag, named: str | None, wants_depth: bool) -> ImageTopic:
    kind = "depth" if wants_depth else "color"
    names = [name for name, type_ in bag.topics.items() if type_ in (IMAGE, COMPRESSED) and bag.counts[name]]
    if named is not None:
        if named not in names:
            raise DatasetError(
                f"{bag.path}: dataset.{kind}_topic must name a topic with images, got {named}; {_listed(names)}"
            )
        return ImageTopic(named, wants_depth, bag.first(named))
    topics = [ImageTopic(name, is_depth(first, name), first) for name in names for first in [bag.first(name)]]
    fitting = [topic for topic in topics if topic.is_depth == wants_depth and is_readable(topic.first)]
    if not fitting:
        raise DatasetError(
            f"{bag.path}: must contain a topic of {kind} images, got none; dataset.{kind}_topic names one; "
            f"{_listed(names)}"
        )
    return max(fitting, key=lambda topic: _rank(bag, topic))


def _rank(bag: Bag, topic: ImageTopic) -> tuple:
    name = topic.name.lower()
    count = bag.counts[topic.name]
    if topic.is_depth:
        return topic.is_registered, "depth" in name, not topic.is_compressed, count, -len(name)
    is_plain = not any(word in name for word in _NO_COLOR)
    is_named = any(word in name for word in ("color", "rgb"))
    return is_colorful(topic.first), is_plain, is_named, not topic.is_compressed, count, -len(name)


def _stem(name: str) -> str:
    """The topic without its transport: `/camera/color/image_raw` of `/camera/color/image_raw/compressed`."""
    head, _, last = name.rpartition("/")
    return head if last in _TRANSPORTS[:2] else name


def _listed(names: list[str]) -> str:
    return f"topics with images: {brief(', '.join(sorted(names)), 400)}" if names else "no topic has images"
