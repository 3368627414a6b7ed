"""The ways that data breaks, in every layout: the message names the file, and the other frames stay usable."""

import struct
from types import SimpleNamespace

import numpy as np
import pytest

from spslam.datasets import open_dataset
from spslam.datasets.base import Subset
from spslam.datasets.prefetch import prefetch
from spslam.errors import DatasetError
from tests.datasets.layouts import (
    color_image,
    encoded,
    poses,
    sens_frame,
    sens_head,
    truncate,
    write_folder,
    write_replica,
    write_scannet,
    write_seven_scenes,
    write_synthetic_rgbd,
    write_tum,
    zipped_depth,
)

COUNT, BROKEN = 5, 2


class Layout:
    """Where a layout keeps the color and depth image of the frame to break, and the poses."""

    def __init__(self, folder, kind):
        self.kind, self.folder = kind, WRITERS[kind](folder / "data", count=COUNT)
        color, depth = COLOR_AND_DEPTH[kind]
        self.color, self.depth = (sorted(self.folder.glob(name))[BROKEN] for name in (color, depth))

    def open(self):
        return open_dataset(SimpleNamespace(type=self.kind, path=self.folder, depth_variant="exact"))


WRITERS = {
    "7scenes": write_seven_scenes,
    "tum": write_tum,
    "replica": write_replica,
    "synthetic_rgbd": write_synthetic_rgbd,
    "scannet": write_scannet,
    "folder": write_folder,
}
COLOR_AND_DEPTH = {
    "7scenes": ("seq-01/*.color.png", "seq-01/*.depth.png"),
    "tum": ("rgb/*.png", "depth/*.png"),
    "replica": ("results/frame*.jpg", "results/depth*.png"),
    "synthetic_rgbd": ("images/*.png", "depth/*.png"),
    "scannet": ("color/*.jpg", "depth/*.png"),
    "folder": ("color/*.jpg", "depth/*.png"),
}


@pytest.fixture(params=WRITERS)
def layout(tmp_path, request):
    return Layout(tmp_path, request.param)


def check_one_broken_frame(dataset, *words):
    """All frames come through the prefetcher, one of them as an error that holds the words."""
    with prefetch(dataset, workers=2) as frames:
        found = list(frames)
    assert len(found) == COUNT
    faults = [item for item in found if isinstance(item, DatasetError)]
    assert len(faults) == 1
    assert found.index(faults[0]) == BROKEN
    message = str(faults[0])
    assert "\n" not in message
    assert all(str(word) in message for word in words), message
    for index, frame in enumerate(found):
        assert isinstance(frame, DatasetError) or frame.index == index


@pytest.mark.parametrize("image", ["color", "depth"])
@pytest.mark.parametrize(
    ("corrupt", "words"),
    [
        (truncate, "truncated"),
        (lambda path: path.write_bytes(b""), "the file is empty"),
        (lambda path: path.write_bytes(b"IEND \xff\xd9 nothing like an image"), "can't be decoded"),
    ],
    ids=["truncated", "zero bytes", "no image"],
)
def test_a_broken_image(layout, image, corrupt, words):
    path = getattr(layout, image)
    corrupt(path)
    check_one_broken_frame(layout.open(), path.name, words)


@pytest.mark.parametrize("image", ["color", "depth"])
def test_a_missing_image(layout, image):
    path = getattr(layout, image)
    path.unlink()
    if layout.kind == "tum":
        check_one_broken_frame(layout.open(), path.name, "no such file")
    else:
        other = layout.depth if image == "color" else layout.color
        check_one_broken_frame(layout.open(), other.name, f"the {image} image of this frame is missing")


def corrupt_pose(layout, text):
    """Writes ``text``, 16 words, in place of the pose of the frame to break; False where poses are in another form."""
    if layout.kind in ("7scenes", "scannet"):
        name = f"seq-01/frame-{BROKEN:06d}.pose.txt" if layout.kind == "7scenes" else f"pose/{BROKEN}.txt"
        (layout.folder / name).write_text(text)
        return True
    if layout.kind == "tum":
        return False
    path = layout.folder / {"replica": "traj.txt"}.get(layout.kind, "poses.txt")
    rows = [" ".join(f"{value:.9f}" for value in pose.ravel()) for pose in poses(COUNT)]
    rows[BROKEN] = text
    path.write_text("\n".join(rows) + "\n")
    return True


@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
def test_a_pose_that_is_not_finite_is_an_unknown_one(layout, value):
    if not corrupt_pose(layout, " ".join([value] * 16)):
        path = layout.folder / "groundtruth.txt"
        path.write_text(path.read_text() + f"1000.0 {' '.join([value] * 7)}\n")
        assert all(frame.pose is not None for frame in layout.open())
        return
    assert [frame.pose is None for frame in layout.open()] == [index == BROKEN for index in range(COUNT)]


def test_a_pose_that_is_no_motion_costs_no_image(layout):
    if not corrupt_pose(layout, " ".join(map(str, range(16)))):
        return
    dataset = layout.open()
    assert [frame.pose is None for frame in dataset] == [index == BROKEN for index in range(COUNT)]
    (doubt,) = dataset.doubts
    assert "must be a rotation and a translation" in str(doubt)
    assert "these frames count as without a known pose; correct them, or write NaN" in str(doubt)
    assert Subset(dataset, 1).doubts == dataset.doubts


def test_frames_beyond_the_poses_have_none(layout):
    if layout.kind in ("7scenes", "scannet", "tum"):
        return
    path = layout.folder / {"replica": "traj.txt"}.get(layout.kind, "poses.txt")
    path.write_text("\n".join(" ".join(map(str, np.eye(4).ravel())) for _ in range(2)))
    if layout.kind == "folder":  # whose rows have no numbers: with one left out, the others would be of other frames
        with pytest.raises(DatasetError, match=r"poses.txt: must have one pose for each of 5 frames, got 2; 16 times"):
            layout.open()
    else:
        assert [frame.pose is None for frame in layout.open()] == [False, False, True, True, True]
    path.write_text("1 0 0")
    with pytest.raises(DatasetError, match=f"{path.name}: must have 16 numbers per pose .*, got 3 numbers in line 1"):
        layout.open()


@pytest.mark.parametrize("text", ["nan", None])
def test_reference_files_that_hold_no_pose_are_said(layout, text):
    if layout.kind == "tum":
        return
    for index in range(COUNT):
        if layout.kind in ("7scenes", "scannet"):
            name = f"seq-01/frame-{index:06d}.pose.txt" if layout.kind == "7scenes" else f"pose/{index}.txt"
            (layout.folder / name).write_text(f"{text} " * 16) if text else (layout.folder / name).unlink()
        else:
            path = layout.folder / {"replica": "traj.txt"}.get(layout.kind, "poses.txt")
            path.write_text((f"{text} " * 16 + "\n") * COUNT) if text else path.unlink(missing_ok=True)
    dataset = layout.open()
    assert dataset.poses() is None
    assert len(dataset.doubts) == (0 if text is None else 1)
    assert all("no frame has a known pose: " in str(doubt) for doubt in dataset.doubts)


MISSING_INTRINSICS = {
    "replica": ("cam_params.json", "cam_params.json: no such file"),
    "synthetic_rgbd": ("focal.txt", "focal.txt: no such file"),
    "scannet": ("intrinsic/intrinsic_*.txt", "intrinsic_depth.txt: no such file"),
    "folder": ("intrinsics.txt", "must contain the intrinsics in one of intrinsics.txt"),
}


def test_missing_intrinsics(layout):
    if layout.kind not in MISSING_INTRINSICS:  # the datasets' own defaults hold
        assert layout.open().camera.width > 0
        return
    pattern, message = MISSING_INTRINSICS[layout.kind]
    for path in layout.folder.glob(pattern):
        path.unlink()
    with pytest.raises(DatasetError, match=message):
        layout.open()


def test_a_sens_file_with_a_broken_frame(tmp_path):
    frames = [
        sens_frame(pose, 1 + 33_000 * i, encoded(color_image(i), ".png"), zipped_depth(i))
        for i, pose in enumerate(poses(COUNT))
    ]
    frames[BROKEN] = sens_frame(poses(COUNT)[BROKEN], 1 + 33_000 * BROKEN, b"\x89PNG cut", zipped_depth(0))
    path = tmp_path / "scan.sens"
    path.write_bytes(sens_head(COUNT) + b"".join(frames) + struct.pack("<Q", 0))
    dataset = open_dataset(SimpleNamespace(type="scannet", path=path))
    check_one_broken_frame(dataset, f"scan.sens, frame {BROKEN}", "truncated")
