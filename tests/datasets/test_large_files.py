"""Small files that would take gigabytes or minutes: refused by what their headers say."""

import os
import struct
import time
import zlib

import numpy as np
import pytest

from spslam.datasets.images import read_color, read_depth
from spslam.datasets.registry import open_sequence
from spslam.datasets.replica import open_replica
from spslam.datasets.scannet import open_scannet
from spslam.datasets.seven_scenes import open_seven_scenes
from spslam.datasets.text import read_json, read_numbers, read_pose_table, read_rows
from spslam.datasets.tum import associate, open_tum
from spslam.errors import DatasetError
from spslam.options import DatasetOptions
from tests.datasets.layouts import (
    color_image,
    encoded,
    poses,
    sens_frame,
    sens_head,
    write_folder,
    write_replica,
    write_seven_scenes,
    write_tum,
    zipped_depth,
)

MOST_SECONDS = 10.0


@pytest.fixture(autouse=True)
def _in_time():
    began = time.process_time()
    yield
    assert time.process_time() - began < MOST_SECONDS


def png(width, height, bits=16, color_type=0):
    """A PNG of zeros: one byte in a thousand of what it decodes to."""
    row = bytes(1 + width * bits // 8)
    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()

    def chunk(name, content):
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    head = struct.pack(">IIBBBBB", width, height, bits, color_type, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


@pytest.fixture(scope="module")
def bomb():
    return png(9000, 9000)


def test_a_png_of_a_hundred_thousand_times_its_size(tmp_path, bomb):
    path = tmp_path / "bomb.png"
    path.write_bytes(bomb)
    for read in (read_color, lambda path: read_depth(path, 1000.0)):
        with pytest.raises(DatasetError, match="bomb.png: an image must have 1 to 16777216 pixels .* got 9000x9000"):
            read(path)


def test_such_a_frame_is_skipped(tmp_path, bomb):
    scene = write_seven_scenes(tmp_path)
    (scene / "seq-01" / "frame-000002.depth.png").write_bytes(bomb)
    dataset = open_seven_scenes(scene)
    with pytest.raises(DatasetError, match="must be as large as the sequence's first image, 32x24, got 9000x9000"):
        dataset[2]
    assert dataset[3].depth.shape == (24, 32)


def test_depth_that_inflates_to_gigabytes(tmp_path):
    packer = zlib.compressobj(9)
    bomb = b"".join(packer.compress(bytes(1 << 20)) for _ in range(256)) + packer.flush()
    color = encoded(color_image(0), ".png")
    frames = [sens_frame(pose, 1 + 33_000 * i, color, zipped_depth(i)) for i, pose in enumerate(poses(2))]
    frames.append(sens_frame(poses(3)[2], 100_000, color, zlib.compress(bytes(10_000))))
    frames.append(sens_frame(poses(4)[3], 200_000, color, bomb))
    path = tmp_path / "scan.sens"
    path.write_bytes(sens_head(4) + b"".join(frames))
    dataset = open_scannet(path)
    with pytest.raises(DatasetError, match="frame 2, depth: must be 1536 bytes, got over 1536"):
        dataset[2]
    with pytest.raises(DatasetError, match="frame 3, depth: must be at most 68608 bytes, got"):
        dataset[3]
    assert dataset[1].depth.shape == (24, 32)


def test_a_sens_file_that_announces_more_frames_than_anybody_records(tmp_path):
    path = tmp_path / "scan.sens"
    with path.open("wb") as file:
        file.write(sens_head(2**40))
        file.truncate(1 << 40)
    with pytest.raises(DatasetError, match="scan.sens: must have at most 524288 frames, got 1099511627776"):
        open_scannet(path)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((10**6, 10**6), "an image must have 1 to 16777216 pixels"),
        ((10**12,), r"depth must be uint16, float32 or float64 \[H, W\], got float32 \[1000000000000\]"),
        ((), r"depth must be uint16, float32 or float64 \[H, W\], got float32 \[\]"),
        ((0, 5), r"depth must be uint16, float32 or float64 \[H, W\], got float32 \[0, 5\]"),
        ((24, 32), "the array is truncated"),
    ],
)
def test_arrays_of_another_shape(tmp_path, shape, message):
    path = tmp_path / "depth.npy"
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": shape})
        file.write(bytes(40))
    with pytest.raises(DatasetError, match=f"depth.npy: {message}"):
        read_depth(path, 1.0)


@pytest.mark.parametrize("dtype", ["<u2", ">u2", "<f4", ">f8"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays(tmp_path, dtype, order):
    stored = np.asarray([[1, 2, 3], [4, 0, 6]], dtype, order)
    np.save(tmp_path / "depth.npy", stored)
    np.testing.assert_array_equal(read_depth(tmp_path / "depth.npy", 2.0), [[0.5, 1, 1.5], [2, 0, 3]])


BAD_ARRAYS = {
    "npz": lambda path: np.savez(path.open("wb"), a=np.ones((24, 32))),
    "no shape": lambda path: np.save(path, np.float32(1)),
    "objects": lambda path: np.save(path, np.array([[{}]]), allow_pickle=True),
    "nested": lambda path: path.write_bytes(b"\x93NUMPY\1\0" + struct.pack("<H", 9000) + b"(" * 9000),
    "digits": lambda path: path.write_bytes(
        b"\x93NUMPY\1\0"
        + struct.pack("<H", 5060)
        + b"{'descr': '<f4', 'fortran_order': False, 'shape': (1, %b)}" % (b"9" * 5000)
    ),
    "truth": lambda path: path.write_bytes(
        b"\x93NUMPY\1\0"
        + struct.pack("<H", 60)
        + b"{'descr': '<f4', 'fortran_order': False, 'shape': (True, 1)}".ljust(60)
        + bytes(4)
    ),
    "version": lambda path: path.write_bytes(b"\x93NUMPY\7\0" + bytes(100)),
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("not an array"),
}


@pytest.mark.parametrize("bad", BAD_ARRAYS)
def test_one_bad_array_is_one_frame(tmp_path, bad):
    folder = write_folder(tmp_path, units_per_meter=1.0)
    for path in sorted((folder / "depth").iterdir()):
        np.save(path.with_suffix(".npy"), np.full((24, 32), 1.5, np.float32))
        path.unlink()
    BAD_ARRAYS[bad](folder / "depth" / "1.npy")
    dataset = open_sequence(DatasetOptions.model_construct(type="folder", path=str(folder)))
    with pytest.raises(DatasetError, match="1.npy: ") as error:
        dataset[1]
    assert "\n" not in str(error.value)
    assert (dataset[2].depth == 1.5).all()


def test_texts_of_gigabytes(tmp_path):
    path = tmp_path / "long.txt"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    for read in (read_numbers, read_pose_table, read_json, lambda path: list(read_rows(path, 2))):
        with pytest.raises(DatasetError, match="long.txt: must have at most .* bytes, got 1099511627776"):
            read(path)


def test_a_text_without_line_ends(tmp_path):
    (tmp_path / "long.txt").write_text("1 " * (1 << 20))
    with pytest.raises(DatasetError, match="long.txt, line 1: must have at most 1048576 characters"):
        read_numbers(tmp_path / "long.txt")


@pytest.mark.parametrize("content", ["[" * 10**5, '{"camera": ' * 10**5, '{"camera": ' + "9" * 5000 + "}"])
def test_json_that_is_nested_or_long(tmp_path, content):
    scene = write_replica(tmp_path)
    (scene / "cam_params.json").write_text(content)
    with pytest.raises(DatasetError, match="cam_params.json: isn't valid JSON: ") as error:
        open_replica(scene)
    assert len(str(error.value)) < 300


def test_a_list_may_name_a_device_or_a_pipe(tmp_path):
    folder = write_tum(tmp_path)
    os.mkfifo(folder / "rgb" / "pipe.png")
    lines = (folder / "rgb.txt").read_text().splitlines()
    for row, name in ((1, "/dev/zero"), (2, "rgb/pipe.png"), (3, "rgb/a\0b.png")):
        lines[row] = f"{lines[row].split()[0]} {name}"
    (folder / "rgb.txt").write_text("\n".join(lines))
    dataset = open_tum(folder)
    for row, message in enumerate(["it must be a regular file", "it must be a regular file", "embedded null byte"]):
        with pytest.raises(DatasetError, match=message):
            dataset[row]
    assert dataset[3].color.shape == (24, 32, 3)


def test_lists_of_times_that_are_all_alike(tmp_path):
    times = 1e-9 * np.arange(20_000)
    with pytest.raises(ValueError, match="must have at most 16 images within 0.02 s of each, got 400000000"):
        associate(times, times, 0.02)
    folder = write_tum(tmp_path)
    lines = "\n".join(f"{1000 + time:.9f} rgb/a.png" for time in times)
    for name in ("rgb.txt", "depth.txt"):
        (folder / name).write_text(lines)
    with pytest.raises(DatasetError, match="rgb.txt: must have at most 16 images within 0.02 s of each"):
        open_tum(folder)


def test_a_name_with_digits_that_are_none(tmp_path):
    folder = write_folder(tmp_path)
    for kind, suffix in (("color", "jpg"), ("depth", "png")):
        (folder / kind / f"1.{suffix}").rename(folder / kind / f"\u00b2.{suffix}")
    assert len(open_sequence(DatasetOptions.model_construct(type="folder", path=str(folder)))) == 3


def test_a_number_of_frames_that_no_integer_holds(tmp_path):
    scene = write_replica(tmp_path)
    (scene / "results" / "frame000001.jpg").rename(scene / "results" / f"frame{10**30}.jpg")
    with pytest.raises(DatasetError, match="the number in the name must be at most 9223372036854775807"):
        open_replica(scene)
