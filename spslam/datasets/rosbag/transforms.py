"""The transforms of a bag: a tree of coordinate frames, some of which move."""

from __future__ import annotations

from typing import Any

import numpy as np

from spslam.datasets.pairing import interpolate_trajectory, sorted_trajectory
from spslam.datasets.rosbag.bag import Bag
from spslam.errors import DatasetError
from spslam.geometry import inverse, pose7_to_matrix
from spslam.trajectory import MAX_POSES, Trajectory

TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage", "tf/msg/TFMessage")
POSE_TYPES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)
# Between two transforms further apart nothing is made up.
MAX_GAP_S = 0.5


class TransformTree:
    """Where each frame is in its parent, over time.

    Args:
        edges: for each child frame its parent and the poses of the child in the parent.
    """

    def __init__(self, edges: dict[str, tuple[str, Trajectory]]) -> None:
        self._edges = edges

    def ancestors(self, frame: str) -> list[str]:
        """The frame, its parent, and so on up to the root."""
        found = [frame]
        while found[-1] in self._edges and self._edges[found[-1]][0] not in found:
            found.append(self._edges[found[-1]][0])
        return found

    def moves(self, frame: str, ancestor: str) -> bool:
        """Whether the pose of a frame in one of its ancestors changes."""
        chain = self.ancestors(frame)
        edges = [self._edges[name][1] for name in chain[: chain.index(ancestor)]]
        return any(len(edge) > 1 and np.ptp(edge.poses, axis=0).max() > 0 for edge in edges)

    def poses(self, frame: str, ancestor: str, times: np.ndarray) -> np.ndarray:
        """Poses of a frame in one of its ancestors.

        Args:
            frame: of the tree.
            ancestor: one of `ancestors(frame)`.
            times: [F], s.

        Returns:
            float64 [F, 4, 4], NaN where a transform is not known within 0.5 s around.
        """
        chain = self.ancestors(frame)
        poses = np.broadcast_to(np.eye(4), (len(times), 4, 4))
        for name in chain[: chain.index(ancestor)]:
            edge = self._edges[name][1]
            still = len(edge) == 1 or not np.ptp(edge.poses, axis=0).any()
            poses = (edge.poses[0] if still else interpolate_trajectory(edge, times, MAX_GAP_S)) @ poses
        return poses.copy()

    def between(self, target: str, source: str, time: float) -> np.ndarray | None:
        """Points of `source` to points of `target` at a time, [4, 4]; None where nothing known connects them."""
        common = next((name for name in self.ancestors(target) if name in self.ancestors(source)), None)
        if common is None:
            return None
        at = np.array([time])
        found = inverse(self.poses(target, common, at)[0]) @ self.poses(source, common, at)[0]
        return found if np.isfinite(found).all() else None


def read_transforms(bag: Bag) -> TransformTree:
    """All transforms of a bag, static ones and moving ones.

    Raises:
        DatasetError: a damaged message.
    """
    times: dict[tuple[str, str], list[float]] = {}
    rows: dict[tuple[str, str], list[list[float]]] = {}
    count = 0
    for topic in [name for name, kind in bag.topics.items() if kind in TRANSFORMS]:
        for message in bag.messages(topic):
            for stamped in message.transforms:
                key = _name(stamped.child_frame_id), _name(stamped.header.frame_id)
                times.setdefault(key, []).append(_seconds(stamped.header.stamp))
                rows.setdefault(key, []).append(_pose7(stamped.transform.translation, stamped.transform.rotation))
                count += 1
                if count > MAX_POSES:
                    raise DatasetError(f"{bag.path}: must have at most {MAX_POSES} transforms")
    edges: dict[str, tuple[str, Trajectory]] = {}
    for (child, parent), stamps in times.items():
        poses = _motions(np.array(rows[child, parent]), f"{bag.path}, transform of {child}")
        edges.setdefault(child, (parent, sorted_trajectory(np.array(stamps), poses)))
    return TransformTree(edges)


def read_pose_topic(bag: Bag, topic: str) -> tuple[Trajectory, str]:
    """The poses of a topic, and the frame whose poses they are; an empty name where the messages don't say.

    Raises:
        DatasetError: no such topic, one of another type, or a damaged message.
    """
    kind = bag.topics.get(topic)
    if kind not in POSE_TYPES:
        found = ", ".join(name for name, other in bag.topics.items() if other in POSE_TYPES) or "none"
        raise DatasetError(
            f"{bag.path}: dataset.pose_topic must name a topic of Odometry, PoseStamped, PoseWithCovarianceStamped or "
            f"TransformStamped, got {topic}; there is {found}"
        )
    times, rows, frame = [], [], ""
    for message in bag.messages(topic):
        frame = frame or _name(getattr(message, "child_frame_id", ""))
        if hasattr(message, "transform"):
            row = _pose7(message.transform.translation, message.transform.rotation)
        else:
            pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
            row = _pose7(pose.position, pose.orientation)
        times.append(_seconds(message.header.stamp))
        rows.append(row)
        if len(rows) > MAX_POSES:
            raise DatasetError(f"{bag.path}: topic {topic} must have at most {MAX_POSES} poses")
    if not rows:
        raise DatasetError(f"{bag.path}: topic {topic} must have messages, got none")
    poses = _motions(np.array(rows), f"{bag.path}, {topic}")
    return sorted_trajectory(np.array(times), poses), frame


def transform_matrix(message: Any, name: str) -> np.ndarray:
    """The matrix [4, 4] of a `geometry_msgs/Transform`; raises DatasetError where it is none."""
    return _motions(np.array([_pose7(message.translation, message.rotation)]), name)[0]


def _pose7(position: Any, rotation: Any) -> list[float]:
    return [rotation.w, rotation.x, rotation.y, rotation.z, position.x, position.y, position.z]


def _motions(rows: np.ndarray, name: str) -> np.ndarray:
    lengths = np.linalg.norm(rows[:, :4], axis=1)
    wrong = np.flatnonzero(~(np.isfinite(rows).all(axis=1) & (lengths > 1e-6)))
    if len(wrong):
        raise DatasetError(f"{name}: must be a rotation and a translation, got {rows[wrong[0]].tolist()}")
    return pose7_to_matrix(rows)


def _seconds(stamp: Any) -> float:
    # As the index of a topic has it: in whole nanoseconds first, or the same time would come as two.
    return (stamp.sec * 1_000_000_000 + stamp.nanosec) / 1e9


def _name(frame: str) -> str:
    return frame.lstrip("/")
