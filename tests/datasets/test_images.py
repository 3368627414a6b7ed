import cv2
import numpy as np
import pytest

from spslam.datasets.images import first_size, read_color, read_depth
from spslam.errors import DatasetError
from tests.datasets.layouts import color_image, truncate, write_color, write_depth


def test_color_is_rgb(tmp_path):
    write_color(tmp_path / "a.png", color_image(3))
    np.testing.assert_array_equal(read_color(tmp_path / "a.png"), color_image(3))
    write_color(tmp_path / "a.jpg", color_image(3))
    difference = read_color(tmp_path / "a.jpg").astype(int) - color_image(3)
    assert np.abs(difference[:, :8]).max() < 10  # JPEG's own error, away from the edge


def test_gray_color_images_are_repeated(tmp_path):
    cv2.imwrite(str(tmp_path / "g.png"), np.full((4, 5), 7, np.uint8))
    np.testing.assert_array_equal(read_color(tmp_path / "g.png"), np.full((4, 5, 3), 7))


def test_depth_units_and_invalid_values(tmp_path):
    cv2.imwrite(str(tmp_path / "d.png"), np.array([[0, 1000, 2500], [65535, 65534, 1]], np.uint16))
    depth = read_depth(tmp_path / "d.png", 1000.0, invalid=(65535,))
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, [[0, 1, 2.5], [0, 65.534, 0.001]], rtol=1e-6)
    assert read_depth(tmp_path / "d.png", 5000.0)[1, 0] == pytest.approx(13.107)


def test_floating_point_depth(tmp_path):
    stored = np.array([[1.5, np.nan, -1], [np.inf, 0, 2]], np.float32)
    cv2.imwrite(str(tmp_path / "d.tiff"), stored)
    np.save(tmp_path / "d.npy", stored.astype(np.float64))
    np.save(tmp_path / "transposed.npy", np.asfortranarray(stored))
    for name in ("d.tiff", "d.npy", "transposed.npy"):
        depth = read_depth(tmp_path / name, None)
        np.testing.assert_array_equal(depth, [[1.5, 0, 0], [0, 0, 2]])
        assert depth.flags.c_contiguous  # as OpenCV asks for


def test_sixteen_bits_are_millimeters_unless_told(tmp_path):
    cv2.imwrite(str(tmp_path / "d.png"), np.array([[1500]], np.uint16))
    assert read_depth(tmp_path / "d.png", None)[0, 0] == 1.5


@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.parametrize("keep", [0.2, 0.9, 0.999])
def test_truncated_images(tmp_path, suffix, keep):
    noise = np.random.default_rng(0).integers(0, 255, (40, 50, 3), dtype=np.uint8)
    write_color(tmp_path / f"a.{suffix}", noise)
    truncate(tmp_path / f"a.{suffix}", keep)
    with pytest.raises(DatasetError, match=rf"a\.{suffix}: the image is truncated"):
        read_color(tmp_path / f"a.{suffix}")


def test_padding_after_the_end_is_no_truncation(tmp_path):
    write_color(tmp_path / "a.png", color_image(0))
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes() + b"\0" * 64)
    np.testing.assert_array_equal(read_color(tmp_path / "a.png"), color_image(0))


def test_broken_files(tmp_path):
    (tmp_path / "empty.png").touch()
    (tmp_path / "text.png").write_text("not an image, though it says IEND")
    (tmp_path / "text.npy").write_text("not an array")
    (tmp_path / "folder.png").mkdir()
    cv2.imwrite(str(tmp_path / "eight.png"), np.ones((3, 3), np.uint8))
    write_color(tmp_path / "rgb.png", color_image(0))
    for name, message in {
        "missing.png": "missing.png: no such file",
        "empty.png": "empty.png: the file is empty",
        "text.png": "text.png: can't be decoded as an image",
        "text.npy": "text.npy: can't be read as an array",
        "folder.png": "folder.png: can't be read: Is a directory",
        "eight.png": "eight.png: depth must be uint16, float32 or float64 with one channel, got uint8 with 1",
        "rgb.png": "rgb.png: depth must be uint16, float32 or float64 with one channel, got uint8 with 3",
    }.items():
        with pytest.raises(DatasetError, match=message) as error:
            read_depth(tmp_path / name, 1000.0)
        assert "\n" not in str(error.value)


def test_first_size_skips_what_cannot_be_read(tmp_path):
    write_color(tmp_path / "b.png", color_image(0))
    assert first_size([tmp_path / "a.png", tmp_path / "b.png"]) == (32, 24)
    with pytest.raises(DatasetError, match="a.png: no such file"):
        first_size([tmp_path / "a.png", tmp_path / "c.png"])


def test_depth_round_trip_at_every_scale(tmp_path):
    meters = np.random.default_rng(1).uniform(0.3, 6, (10, 12))
    for scale in (1000.0, 5000.0, 6553.5):
        write_depth(tmp_path / "d.png", meters, scale)
        np.testing.assert_allclose(read_depth(tmp_path / "d.png", scale), meters, atol=0.51 / scale)
