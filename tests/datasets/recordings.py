"""Recordings of phones and of other programs, written from given frames by OpenCV, FFmpeg, LZFSE, LZ4 and zipfile."""

from __future__ import annotations

import json
import struct
import zipfile
import zlib
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spslam.geometry import inverse, matrix_to_quaternion
from tests.datasets.layouts import (
    CAMERA_MATRIX,
    HEIGHT,
    WIDTH,
    color_image,
    depth_meters,
    matrix_text,
    poses,
    write_color,
    write_depth,
    write_folder,
    write_tum,
)

# Color is so many times larger than depth, of the same view.
LARGER = 4
COLOR_MATRIX = np.array([[LARGER * 30.0, 0, 63.5], [0, LARGER * 31.0, 47.5], [0, 0, 1]])
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
START_S = 1000.5


def large_color(index: int) -> np.ndarray:
    """The color image of the other layouts, in the size of a phone's camera."""
    return color_image(index).repeat(LARGER, axis=0).repeat(LARGER, axis=1)


def confidence(index: int) -> np.ndarray:
    """2, and 1 in the upper rows, and 0 in the left columns."""
    image = np.full((HEIGHT, WIDTH), 2, np.uint8)
    image[:4], image[:, :3] = 1, 0
    return image


def write_video(path: Path, images, rate: float = 30, fourcc: str = "mp4v") -> Path:
    """A video by OpenCV's writer."""
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = images[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*fourcc), rate, (width, height))
    assert writer.isOpened()
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    writer.release()
    return path


def write_stray_scanner(folder: Path, count: int = 5) -> Path:
    write_video(folder / "rgb.mp4", [large_color(i) for i in range(count)])
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for i, pose in enumerate(poses(count)):
        write_depth(folder / "depth" / f"{i:06d}.png", depth_meters(i))
        (folder / "confidence").mkdir(exist_ok=True)
        cv2.imwrite(str(folder / "confidence" / f"{i:06d}.png"), confidence(i))
        w, x, y, z = matrix_to_quaternion(pose[:3, :3])
        numbers = [START_S + i / 60, *pose[:3, 3], x, y, z, w]
        rows.append(f"{numbers[0]:.6f}, {i:06d}, " + ", ".join(f"{value:.9f}" for value in numbers[1:]))
    (folder / "odometry.csv").write_text("\n".join(rows) + "\n")
    matrix = "\n".join(", ".join(f"{value:.6f}" for value in row) for row in COLOR_MATRIX)
    (folder / "camera_matrix.csv").write_text(matrix + "\n")
    return folder


def record3d_metadata(count: int) -> dict:
    rows = []
    for pose in poses(count) @ OPENGL:
        w, x, y, z = matrix_to_quaternion(pose[:3, :3])
        rows.append([float(value) for value in (x, y, z, w, *pose[:3, 3])])
    times = [START_S + i / 60 for i in range(count)]
    matrix = COLOR_MATRIX.T.ravel().tolist()
    size = {"w": LARGER * WIDTH, "h": LARGER * HEIGHT, "dw": WIDTH, "dh": HEIGHT, "fps": 60}
    return {**size, "K": matrix, "frameTimestamps": times, "poses": rows}


def write_record3d(folder: Path, count: int = 5) -> Path:
    """The `.r3d` archive."""
    lzfse = pytest.importorskip("lzfse")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "mine.r3d"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps(record3d_metadata(count)))
        for i in range(count):
            image = cv2.cvtColor(large_color(i), cv2.COLOR_RGB2BGR)
            archive.writestr(f"rgbd/{i}.jpg", cv2.imencode(".jpg", image)[1].tobytes())
            archive.writestr(f"rgbd/{i}.depth", lzfse.compress(depth_meters(i).astype("<f4").tobytes()))
            archive.writestr(f"rgbd/{i}.conf", lzfse.compress(confidence(i).tobytes()))
    return path


def write_record3d_folder(folder: Path, count: int = 5) -> Path:
    with zipfile.ZipFile(write_record3d(folder, count)) as archive:
        archive.extractall(folder / "mine")
    return folder / "mine"


def write_record3d_export(folder: Path, count: int = 5) -> Path:
    """The export as EXR, by FFmpeg's encoder."""
    av = pytest.importorskip("av")
    pytest.importorskip("OpenEXR")
    root = folder / "EXR_RGBD"
    (root / "depth").mkdir(parents=True)
    (root / "metadata.json").write_text(json.dumps(record3d_metadata(count)))
    for i in range(count):
        write_color(root / "rgb" / f"{i}.jpg", large_color(i))
        with av.open(str(root / "depth" / f"{i}.exr"), "w", format="image2") as container:
            stream = container.add_stream("exr", rate=1)
            stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "grayf32le"
            frame = av.VideoFrame.from_ndarray(depth_meters(i).astype(np.float32), format="grayf32le")
            for packet in (*stream.encode(frame), *stream.encode()):
                container.mux(packet)
    return folder


def write_scannetpp_poses(folder: Path, count: int) -> None:
    entries = {}
    for i, pose in enumerate(poses(count)):
        values = {"timestamp": START_S + i / 60, "intrinsic": COLOR_MATRIX.tolist(), "pose": np.eye(4).tolist()}
        entries[f"frame_{i:06d}"] = values | {"aligned_pose": pose.tolist(), "imu": []}
    (folder / "pose_intrinsic_imu.json").write_text(json.dumps(entries))


def write_scannetpp(scene: Path, count: int = 5) -> Path:
    """What the authors' toolkit unpacks."""
    for i in range(count):
        write_color(scene / "iphone" / "rgb" / f"frame_{i:06d}.jpg", large_color(i))
        write_depth(scene / "iphone" / "depth" / f"frame_{i:06d}.png", depth_meters(i))
    write_scannetpp_poses(scene / "iphone", count)
    return scene


def packed_depth(index: int, compression: str) -> bytes:
    """A frame of `depth.bin`: 256x192."""
    depth = cv2.resize(depth_meters(index), (256, 192), interpolation=cv2.INTER_NEAREST)
    if compression == "zlib":
        packer = zlib.compressobj(wbits=-zlib.MAX_WBITS)
        return packer.compress(depth.astype("<f4").tobytes()) + packer.flush()
    block = pytest.importorskip("lz4.block")
    return block.compress(np.round(1000 * depth).astype("<u2").tobytes(), store_size=False)


def write_scannetpp_packed(scene: Path, count: int = 5, compression: str = "lz4") -> Path:
    """What is downloaded."""
    write_video(scene / "iphone" / "rgb.mkv", [large_color(i) for i in range(count)], 60)
    frames = (packed_depth(i, compression) for i in range(count))
    (scene / "iphone" / "depth.bin").write_bytes(b"".join(struct.pack("<I", len(one)) + one for one in frames))
    write_scannetpp_poses(scene / "iphone", count)
    return scene


def write_arkitscenes(folder: Path, count: int = 5) -> Path:
    name, rows = folder.name, []
    for i, pose in enumerate(poses(count)):
        stem = f"{name}_{START_S + 0.1 * i:.3f}"
        write_color(folder / "vga_wide" / f"{stem}.png", large_color(i))
        write_depth(folder / "lowres_depth" / f"{stem}.png", depth_meters(i))
        (folder / "confidence").mkdir(exist_ok=True)
        cv2.imwrite(str(folder / "confidence" / f"{stem}.png"), confidence(i))
        (folder / "vga_wide_intrinsics").mkdir(exist_ok=True)
        pincam = f"{LARGER * WIDTH} {LARGER * HEIGHT} {COLOR_MATRIX[0, 0]} {COLOR_MATRIX[1, 1]} 63.5 47.5\n"
        (folder / "vga_wide_intrinsics" / f"{stem}.pincam").write_text(pincam)
        seen = inverse(pose)
        turn = Rotation.from_matrix(seen[:3, :3]).as_rotvec()
        rows.append(" ".join(f"{value:.9f}" for value in (START_S + 0.1 * i, *turn, *seen[:3, 3])))
    (folder / "lowres_wide.traj").write_text("\n".join(rows) + "\n")
    return folder


def write_open3d(folder: Path, count: int = 5) -> Path:
    for i in range(count):
        write_color(folder / "color" / f"{i:06d}.jpg", color_image(i))
        write_depth(folder / "depth" / f"{i:06d}.png", depth_meters(i), 5000)
    values = {"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": CAMERA_MATRIX.T.ravel().tolist()}
    (folder / "intrinsic.json").write_text(json.dumps(values | {"depth_scale": 5000.0, "serial_number": "7"}))
    blocks = (f"{i} {i} {i + 1}\n{matrix_text(pose)}" for i, pose in enumerate(poses(count)))
    (folder / "trajectory.log").write_text("".join(blocks))
    return folder


def write_bonn(folder: Path, count: int = 5) -> Path:
    write_tum(folder, count)
    (folder / "calibration.txt").write_text("30 31 15.5 11.5")
    return folder


def write_icl_nuim(folder: Path, count: int = 5) -> Path:
    lines, rows = [], []
    mirror = np.diag([1.0, -1, 1, 1])
    for i, pose in enumerate(mirror @ poses(count) @ mirror):
        write_color(folder / "rgb" / f"{i}.png", color_image(i))
        write_depth(folder / "depth" / f"{i}.png", depth_meters(i), 5000)
        lines.append(f"{i} depth/{i}.png {i} rgb/{i}.png")
        w, x, y, z = matrix_to_quaternion(pose[:3, :3])
        rows.append(f"{i} " + " ".join(f"{value:.9f}" for value in (*pose[:3, 3], x, y, z, w)))
    (folder / "associations.txt").write_text("\n".join(lines) + "\n")
    (folder / "livingRoom0.gt.freiburg").write_text("\n".join(rows) + "\n")
    return folder


def write_video_recording(folder: Path, count: int = 5) -> Path:
    write_folder(folder, count)
    for image in (folder / "color").iterdir():
        image.unlink()
    (folder / "color").rmdir()
    write_video(folder / "color.avi", [color_image(i) for i in range(count)], fourcc="MJPG")
    (folder / "poses.txt").write_text("".join(matrix_text(pose) for pose in poses(count)))
    return folder


def azure_kinect_calibration(color_from_depth: np.ndarray, focal: float = 0.55) -> dict:
    """The attachment of a recording, whose lenses are all but ideal."""

    def entry(location: str, place: np.ndarray, coefficients) -> dict:
        k1, k2, p1, p2, k3 = coefficients
        numbers = [0.5, 0.51, focal, 1.35 * focal, k1, k2, k3, 0, 0, 0, 0, 0, p2, p1]
        model = "CALIBRATION_LensDistortionModelBrownConrady"
        return {
            "Location": f"CALIBRATION_CameraLocation{location}",
            "Intrinsics": {"ModelParameterCount": 14, "ModelParameters": numbers, "ModelType": model},
            "Rt": {"Rotation": place[:3, :3].ravel().tolist(), "Translation": place[:3, 3].tolist()},
        }

    lenses = [entry("D0", np.eye(4), (0.02, -0.01, 0, 0, 0)), entry("PV0", color_from_depth, (0.05, -0.03, 0, 0, 0))]
    return {"CalibrationInformation": {"Cameras": lenses}}


def write_azure_kinect(path: Path, color, depth, calibration: dict | None) -> Path:
    """A Matroska file of MJPEG, raw 16-bit depth and an attachment, by FFmpeg's muxer."""
    av = pytest.importorskip("av")
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", format="matroska", container_options={"allow_raw_vfw": "1"}) as container:
        tracks = []
        for title, codec, form, images in (
            ("COLOR", "mjpeg", "yuvj444p", color),
            ("DEPTH", "rawvideo", "gray16be", depth),
        ):
            stream = container.add_stream(codec, rate=30, options={"qmin": "1", "q": "1"} if codec == "mjpeg" else {})
            stream.height, stream.width = images[0].shape[:2]
            stream.pix_fmt, stream.metadata["title"] = form, title
            stream.time_base = Fraction(1, 30)
            tracks.append(stream)
        if calibration is not None:
            container.add_attachment("calibration.json", "application/octet-stream", json.dumps(calibration).encode())
        for number in range(len(color)):
            units = np.round(1000 * depth[number]).astype("<u2")
            frames = (
                av.VideoFrame.from_ndarray(color[number], format="rgb24"),
                av.VideoFrame.from_ndarray(units, format="gray16le").reformat(format="gray16be"),
            )
            for stream, frame in zip(tracks, frames, strict=True):
                frame.pts, frame.time_base = number, Fraction(1, 30)
                for packet in stream.encode(frame):
                    container.mux(packet)
        for stream in tracks:
            for packet in stream.encode():
                container.mux(packet)
    _mark_as_16_bit_gray(path, *depth[0].shape)
    return path


def _mark_as_16_bit_gray(path: Path, height: int, width: int) -> None:
    """Names the raw track's pixels in its BITMAPINFOHEADER as k4arecorder does; FFmpeg's muxer leaves that open."""
    content = path.read_bytes()
    for signed in (height, -height):
        head = struct.pack("<IiiH", 40, width, signed, 1)
        place = content.find(head)
        if place >= 0:
            content = content[: place + 16] + b"b16g" + content[place + 20 :]
            path.write_bytes(content)
            return
    raise AssertionError("no BITMAPINFOHEADER")
