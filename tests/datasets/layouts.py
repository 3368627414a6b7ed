"""Small datasets in each layout, written by the tests themselves."""

from __future__ import annotations

import json
import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spslam.geometry import matrix_to_quaternion, pose_from

WIDTH, HEIGHT = 32, 24
CAMERA_MATRIX = np.array([[30.0, 0, 15.5], [0, 31.0, 11.5], [0, 0, 1]])


def color_image(index: int) -> np.ndarray:
    """RGB with a red left half, so that swapped channels show; smooth, so that JPEG keeps it."""
    image = np.full((HEIGHT, WIDTH, 3), (0, 40, 120), dtype=np.uint8)
    image[:, : WIDTH // 2] = (200, 30, index % 100)
    return image


def depth_meters(index: int) -> np.ndarray:
    rows = np.linspace(1, 2, HEIGHT)[:, None] + np.linspace(0, 0.5, WIDTH) + 0.01 * index
    return np.round(rows, 3)


def poses(count: int) -> np.ndarray:
    rotations = Rotation.from_rotvec(np.outer(np.arange(count), [0.01, 0.02, -0.01])).as_matrix()
    return pose_from(rotations, np.outer(np.arange(count), [0.1, 0, 0.05]))


def write_color(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))


def write_depth(path: Path, meters: np.ndarray, units_per_meter: float = 1000.0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.round(meters * units_per_meter).astype(np.uint16))


def matrix_text(matrix: np.ndarray) -> str:
    return "\n".join(" ".join(f"{value:.9e}" for value in row) for row in matrix) + "\n"


def write_seven_scenes(scene: Path, count: int = 4, sequences: tuple[str, ...] = ("seq-01",)) -> Path:
    for name in sequences:
        for i, pose in enumerate(poses(count)):
            stem = scene / name / f"frame-{i:06d}"
            write_color(Path(f"{stem}.color.png"), color_image(i))
            write_depth(Path(f"{stem}.depth.png"), depth_meters(i))
            Path(f"{stem}.pose.txt").write_text(matrix_text(pose))
    (scene / "camera-intrinsics.txt").write_text(matrix_text(CAMERA_MATRIX))
    return scene


def write_synthetic_rgbd(scene: Path, count: int = 12) -> Path:
    flip = np.diag([1, -1, -1, 1])
    for i in range(count):
        write_color(scene / "images" / f"img{i}.png", color_image(i))
        write_depth(scene / "depth" / f"depth{i}.png", depth_meters(i))
        write_depth(scene / "depth_filtered" / f"depth{i}.png", depth_meters(i) + 0.1)
    (scene / "poses.txt").write_text("".join(matrix_text(pose @ flip) for pose in poses(count)))
    (scene / "focal.txt").write_text("30.0\n")
    return scene


def write_replica(scene: Path, count: int = 3) -> Path:
    for i in range(count):
        write_color(scene / "results" / f"frame{i:06d}.jpg", color_image(i))
        write_depth(scene / "results" / f"depth{i:06d}.png", depth_meters(i), 6553.5)
    lines = (" ".join(f"{value:.9e}" for value in pose.ravel()) for pose in poses(count))
    (scene / "traj.txt").write_text("\n".join(lines) + "\n")
    camera = {"w": WIDTH, "h": HEIGHT, "fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.5, "scale": 6553.5}
    (scene / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return scene


def write_tum(folder: Path, count: int = 5, depth_delay: float = 0.004) -> Path:
    start = 1000.0
    rgb, depth = ["# color images"], ["# depth maps"]
    for i in range(count):
        time, depth_time = start + i / 30, start + i / 30 + depth_delay
        write_color(folder / "rgb" / f"{time:.6f}.png", color_image(i))
        write_depth(folder / "depth" / f"{depth_time:.6f}.png", depth_meters(i), 5000.0)
        rgb.append(f"{time:.6f} rgb/{time:.6f}.png")
        depth.append(f"{depth_time:.6f} depth/{depth_time:.6f}.png")
    (folder / "rgb.txt").write_text("\n".join(rgb) + "\n")
    (folder / "depth.txt").write_text("\n".join(depth) + "\n")
    ground_truth = ["# timestamp tx ty tz qx qy qz qw"]
    for i, pose in enumerate(poses(40)):
        w, x, y, z = matrix_to_quaternion(pose[:3, :3])
        numbers = [*pose[:3, 3], x, y, z, w]
        ground_truth.append(f"{start - 0.05 + 0.01 * i:.4f} " + " ".join(f"{value:.9f}" for value in numbers))
    (folder / "groundtruth.txt").write_text("\n".join(ground_truth) + "\n")
    return folder


def encoded(image: np.ndarray, suffix: str) -> bytes:
    done, content = cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    assert done
    return content.tobytes()


def sens_head(frames: int, color: int = 1, depth: int = 1, color_size=(WIDTH, HEIGHT), version: int = 4) -> bytes:
    """The head of a .sens file with frames of the size of the others here."""
    intrinsics = np.eye(4, dtype="<f4")
    intrinsics[:3, :3] = CAMERA_MATRIX
    name = b"StructureSensor"
    return b"".join(
        [
            struct.pack("<IQ", version, len(name)),
            name,
            *(matrix.astype("<f4").tobytes() for matrix in (2 * intrinsics, np.eye(4), intrinsics, np.eye(4))),
            struct.pack("<2i4If", color, depth, *color_size, WIDTH, HEIGHT, 1000.0),
            struct.pack("<Q", frames),
        ]
    )


def sens_frame(pose: np.ndarray, time_us: int, color: bytes, depth: bytes) -> bytes:
    head = np.asarray(pose, dtype="<f4").tobytes() + struct.pack("<4Q", time_us, time_us + 5, len(color), len(depth))
    return head + color + depth


def zipped_depth(index: int) -> bytes:
    return zlib.compress(np.round(1000 * depth_meters(index)).astype("<u2").tobytes())


def write_sens(path: Path, count: int = 4) -> Path:
    """A .sens file as its format is published; IMU readings follow the frames."""
    path.parent.mkdir(parents=True, exist_ok=True)
    frames = [
        sens_frame(pose, 7_000_000 + 33_333 * i, encoded(color_image(i), ".png"), zipped_depth(i))
        for i, pose in enumerate(poses(count))
    ]
    path.write_bytes(sens_head(count) + b"".join(frames) + struct.pack("<Q", 1) + bytes(128))
    return path


def write_scannet(scan: Path, count: int = 4) -> Path:
    """The folders that ScanNet's exporter makes; color is twice as large as depth."""
    for i, pose in enumerate(poses(count)):
        write_color(scan / "color" / f"{i}.jpg", color_image(i).repeat(2, axis=0).repeat(2, axis=1))
        write_depth(scan / "depth" / f"{i}.png", depth_meters(i))
        (scan / "pose").mkdir(exist_ok=True)
        (scan / "pose" / f"{i}.txt").write_text(matrix_text(pose))
    (scan / "intrinsic").mkdir()
    padded = np.eye(4)
    padded[:3, :3] = CAMERA_MATRIX
    (scan / "intrinsic" / "intrinsic_depth.txt").write_text(matrix_text(padded))
    padded[:2] *= 2
    (scan / "intrinsic" / "intrinsic_color.txt").write_text(matrix_text(padded))
    return scan


def write_folder(folder: Path, count: int = 3, units_per_meter: float = 1000.0) -> Path:
    for i in range(count):
        write_color(folder / "color" / f"{i}.jpg", color_image(i))
        write_depth(folder / "depth" / f"{i}.png", depth_meters(i), units_per_meter)
    (folder / "intrinsics.txt").write_text(matrix_text(CAMERA_MATRIX))
    return folder


def truncate(path: Path, keep: float = 0.5) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * keep)])


def shared_data(name: str) -> Path:
    """A folder of the recordings in the folder that SPSLAM_TEST_DATA names; skips the test where it is absent."""
    root = os.environ.get("SPSLAM_TEST_DATA")
    if not root:
        pytest.skip("SPSLAM_TEST_DATA doesn't name the folder of the test recordings")
    if not (Path(root) / name).is_dir():
        pytest.skip(f"{Path(root) / name} is absent")
    return Path(root) / name
