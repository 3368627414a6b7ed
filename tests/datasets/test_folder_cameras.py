"""Folders whose cameras differ: distortion, sizes, places, confidence and times, against exact frames."""

import json
import shutil

import cv2
import numpy as np
import pytest

from spslam.camera import Camera
from spslam.datasets.folder import open_folder
from spslam.datasets.lens import Lens
from spslam.datasets.recording import Recording
from spslam.errors import DatasetError
from spslam.geometry import inverse
from tests.datasets.cameras import BROWN, FISHEYE, camera, extrinsics, path, render
from tests.datasets.layouts import matrix_text, write_color, write_depth, write_folder

COLOR, DEPTH = camera(256, 144, 0.72), camera(160, 120, 0.8)
POSES = path(60)[::20]


def described(lens, **more):
    """A camera as RealSense's `rs.intrinsics` names its parts."""
    names = {"pinhole": "distortion.none", "brown": "distortion.brown_conrady", "fisheye": "kannala_brandt4"}
    values = {"width": lens.camera.width, "height": lens.camera.height, "fx": lens.camera.fx, "fy": lens.camera.fy}
    values |= {"ppx": lens.camera.cx, "ppy": lens.camera.cy, "model": names[lens.model]}
    return values | {"coeffs": list(lens.coefficients or [0] * 5)} | more


def write_recording(folder, color_lens, depth_lens, color_from_depth):
    """Frames of two cameras, with the color camera's poses."""
    for i, pose in enumerate(POSES):
        write_color(folder / "color" / f"{i}.png", render(color_lens, pose)[0])
        write_depth(folder / "depth" / f"{i}.png", render(depth_lens, pose @ color_from_depth)[1], 5000)
    (folder / "poses.txt").write_text("".join(matrix_text(pose) for pose in POSES))
    return folder


@pytest.mark.parametrize("view", ["depth", "color"])
def test_two_cameras_become_one(tmp_path, view):
    """RealSense's sides: a wide, larger color image with Brown's distortion, and a depth camera beside it."""
    color_lens, color_from_depth = Lens(COLOR, "brown", BROWN), extrinsics()
    folder = write_recording(tmp_path / "mine", color_lens, Lens(DEPTH), color_from_depth)
    both = {"color": described(color_lens), "depth": described(Lens(DEPTH)), "depth_scale": 5000}
    place = color_from_depth.tolist()
    (folder / "intrinsics.json").write_text(json.dumps(both | {"depth_to_color": place}))
    dataset = open_folder(folder, view=view)
    camera_pose = POSES[1] @ color_from_depth if view == "depth" else POSES[1]
    frame = dataset[1]
    np.testing.assert_allclose(frame.pose, camera_pose, atol=1e-6)
    assert dataset.camera == (DEPTH if view == "depth" else COLOR)
    truth = render(Lens(dataset.camera), camera_pose)
    known = frame.depth > 0
    assert np.median(np.abs(frame.depth - truth[1])[known]) < 1e-3
    assert np.median(np.abs(frame.color.astype(int) - truth[0])[known]) <= 4
    assert known.mean() > 0.5


def test_files_of_their_own_say_the_same_as_one(tmp_path):
    folder = write_recording(tmp_path, Lens(COLOR), Lens(DEPTH), extrinsics())
    both = {"color": described(Lens(COLOR)), "depth": described(Lens(DEPTH), depth_scale=5000)}
    (folder / "intrinsics.json").write_text(json.dumps(both | {"depth_to_color": extrinsics().ravel().tolist()}))
    one = open_folder(folder)[1]
    (folder / "intrinsics.json").unlink()
    (folder / "intrinsics.txt").write_text(matrix_text(COLOR.matrix()))
    (folder / "depth_intrinsics.json").write_text(json.dumps(described(Lens(DEPTH), depth_scale=5000)))
    with pytest.raises(DatasetError, match="must have its place: depth_to_color.txt"):
        open_folder(folder)
    (folder / "depth_to_color.txt").write_text(matrix_text(extrinsics()))
    other = open_folder(folder)[1]
    np.testing.assert_array_equal(one.color, other.color)
    np.testing.assert_array_equal(one.depth, other.depth)


@pytest.mark.parametrize(
    ("lens", "keys"),
    [
        (Lens(DEPTH, "brown", BROWN), {"coeffs": list(BROWN)}),
        (Lens(DEPTH, "brown", BROWN), dict(zip(("k1", "k2", "p1", "p2", "k3"), BROWN, strict=True))),
        (Lens(DEPTH, "fisheye", FISHEYE), {"distortion_model": "equidistant", "D": list(FISHEYE)}),
    ],
)
def test_distortion_of_registered_images_is_undone_in_both(tmp_path, lens, keys):
    folder = write_recording(tmp_path, lens, lens, np.eye(4))
    values = {name: getattr(DEPTH, name) for name in ("fx", "fy", "cx", "cy")}
    (folder / "intrinsics.json").write_text(json.dumps(values | {"depth_scale": 5000} | keys))
    frame = open_folder(folder)[2]
    color, depth = render(Lens(DEPTH), POSES[2])
    known = frame.depth > 0
    assert known.mean() > 0.9
    assert np.median(np.abs(frame.depth - depth)[known]) < 2e-4
    assert np.median(np.abs(frame.color.astype(int) - color)[known]) <= 4
    (folder / "intrinsics.json").write_text(json.dumps(values | {"depth_scale": 5000}))
    assert np.median(np.abs(open_folder(folder)[2].depth - depth)[known]) > 1e-3


def test_open3ds_intrinsics(tmp_path):
    folder = write_folder(tmp_path)
    (folder / "intrinsics.txt").unlink()
    values = {"width": 32, "height": 24, "intrinsic_matrix": [30, 0, 0, 0, 31, 0, 15.5, 11.5, 1], "fps": 30}
    kinect = {"color_mode": "MJPG_720P", "depth_mode": "NFOV_UNBINNED", "serial_number_": "8", "enable_imu": False}
    for name, remarks in (
        ("camera_intrinsic.json", {"device_name": "RealSense D435", "serial_number": "8"}),
        ("intrinsic.json", kinect | {"stream_length_usec": 1000}),
    ):
        (folder / name).write_text(json.dumps(values | remarks))
        assert open_folder(folder).camera == Camera(32, 24, 30, 31, 15.5, 11.5)
        (folder / name).unlink()


def test_depth_of_a_phone_is_small(tmp_path):
    """Larger color of the same view needs no intrinsics of depth."""
    folder = write_folder(tmp_path)
    for image in (folder / "color").iterdir():
        cv2.imwrite(str(image), cv2.resize(cv2.imread(str(image)), (128, 96)))
    (folder / "intrinsics.txt").write_text("120 124 63.5 47.5")
    dataset = open_folder(folder)
    assert isinstance(dataset, Recording)
    assert dataset.camera == Camera(128, 96, 120, 124, 63.5, 47.5).resized(32, 24)
    assert dataset[1].color.shape == (24, 32, 3)
    assert open_folder(folder, view="color")[1].depth.shape == (96, 128)


def test_confidence_is_heeded(tmp_path):
    folder = write_folder(tmp_path)
    for i in range(2):
        confidence = np.full((24, 32), 2, np.uint8)
        confidence[:, :10], confidence[:5] = 1, 0
        (folder / "confidence").mkdir(exist_ok=True)
        cv2.imwrite(str(folder / "confidence" / f"{i}.png"), confidence)
    shares = [[(open_folder(folder, None, least)[i].depth > 0).mean() for i in range(3)] for least in range(3)]
    assert shares == [[1, 1, 1], [19 / 24, 19 / 24, 1], [19 * 22 / 768, 19 * 22 / 768, 1]]
    shutil.copytree(folder / "confidence", tmp_path / "maps")
    for confidence in (folder / "confidence").iterdir():
        confidence.rename(confidence.with_stem(f"conf_{confidence.stem}"))
    with pytest.raises(
        DatasetError, match=r"confidence: maps must have the names .*, got conf_0.png beside 0.png; ren"
    ):
        open_folder(folder, min_confidence=1)
    assert open_folder(folder)[0].depth.any()
    shutil.rmtree(folder / "confidence")
    shutil.move(tmp_path / "maps", folder / "confidence")
    cv2.imwrite(str(folder / "confidence" / "1.png"), np.zeros((12, 16), np.uint8))
    dataset = open_folder(folder, None, 1)
    with pytest.raises(DatasetError, match="confidence/1.png: must be as large as the sequence's first image, 32x24"):
        dataset[1]
    assert dataset[0].depth.any()


def test_times_are_kept(tmp_path):
    folder = write_folder(tmp_path)
    (folder / "times.txt").write_text("1700000000.25\n1700000000.5\n1700000001.0\n")
    assert open_folder(folder).timestamps().tolist() == [1700000000.25, 1700000000.5, 1700000001.0]
    (folder / "times.txt").write_text("1\n2\n")
    with pytest.raises(DatasetError, match=r"times.txt: must have one time \(s\) for each of 3 frames, got 2"):
        open_folder(folder)
    for text in ("1\n1\n2\n", "3 2 1", "1 2 nan"):
        (folder / "times.txt").write_text(text)
        with pytest.raises(DatasetError, match="times.txt: times must be finite and ascend"):
            open_folder(folder)


CAMERA = {"fx": 30, "fy": 31, "cx": 15.5, "cy": 11.5}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (CAMERA | {"distorsion": [0.1]}, "nothing here reads distorsion; remove it, or use what is read: fx, fy"),
        (CAMERA | {"coeffs": [0.1, "x"]}, "the distortion must be a list of numbers, got"),
        (CAMERA | {"model": "thin_prism_fisheye"}, "the lens model must be one of none, .*, got thin_prism_fisheye"),
        (CAMERA | {"model": "fisheye"}, r"a fisheye lens must have coefficients \(coeffs\), got none"),
        (CAMERA | {"model": "fisheye", "coeffs": [0.1] * 6}, "a fisheye lens must have 4 coefficients, got 6"),
        (CAMERA | {"coeffs": [30, 2, 0, 0]}, r"the distortion of the color lens must leave most of the image, but"),
        ({"color": CAMERA, "depth": 3}, "must contain an object 'depth' with the camera, got 3"),
        ({"depth": CAMERA}, "must contain an object 'color' with the camera, got None"),
        ({"color": CAMERA, "fx": 3}, "nothing here reads fx; remove it"),
        ({"color": CAMERA, "depth": CAMERA, "depth_to_color": [1, 2]}, "depth_to_color must be a 4x4 matrix row by"),
        (
            {"color": CAMERA, "depth": CAMERA, "depth_to_color": [2] * 16},
            "depth_to_color: must be a rotation and a translation",
        ),
        ({"color": CAMERA, "depth": CAMERA | {"fx": 40}}, "a depth camera of its own must have its place"),
        (CAMERA | {"depth_to_color": np.eye(4).tolist()}, "the depth camera must have intrinsics of its own"),
        ({"intrinsic_matrix": [1, 2, 3]}, "intrinsic_matrix must be nine numbers column by column"),
        ({"fx": 30, "fy": 31, "cx": 15.5}, "must contain numbers fx, fy, cx, cy, got cy: None"),
    ],
)
def test_cameras_that_are_not_understood_are_refused(tmp_path, values, message):
    folder = write_folder(tmp_path)
    (folder / "intrinsics.txt").unlink()
    (folder / "intrinsics.json").write_text(json.dumps(values))
    with pytest.raises(DatasetError, match=message) as error:
        open_folder(folder)
    assert "\n" not in str(error.value)


def test_depth_of_other_sides_needs_intrinsics(tmp_path):
    folder = write_recording(tmp_path, Lens(COLOR), Lens(DEPTH), np.eye(4))
    (folder / "intrinsics.txt").write_text(matrix_text(COLOR.matrix()))
    message = (
        "depth images of 160x120 beside color images of 256x144 must have intrinsics of their own: depth_intrinsics"
    )
    with pytest.raises(DatasetError, match=message):
        open_folder(folder)


def test_poses_belong_to_the_color_camera(tmp_path):
    color_from_depth = extrinsics()
    folder = write_recording(tmp_path, Lens(COLOR), Lens(DEPTH), color_from_depth)
    both = {"color": described(Lens(COLOR)), "depth": described(Lens(DEPTH)), "depth_scale": 5000}
    (folder / "intrinsics.json").write_text(json.dumps(both | {"depth_to_color": color_from_depth.tolist()}))
    by_depth, by_color = (open_folder(folder, view=view).poses() for view in ("depth", "color"))
    np.testing.assert_allclose(by_depth @ inverse(color_from_depth), by_color, atol=1e-9)
    np.testing.assert_allclose(by_color, POSES, atol=1e-8)
