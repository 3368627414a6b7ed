"""The `places` dataset: determinism, random access, effects of the camera, options."""

import pickle
from types import SimpleNamespace
from typing import get_args

import cv2
import numpy as np
import pytest

from spslam.config import load_config
from spslam.datasets import export_folder, open_dataset
from spslam.datasets.places import MOTIONS, PLACES, SENSORS, Capture, PlacesDataset
from spslam.errors import ConfigError, DatasetError
from spslam.options import reading

SIZE = {"width": 64, "height": 48}
EVERYTHING = Capture(
    **SIZE,
    rate_hz=12,
    color_noise=3,
    exposure_ms=12,
    auto_exposure=True,
    rolling_shutter_ms=25,
    color_delay_ms=8,
)


def content(frame):
    return frame.color.tobytes(), frame.depth.tobytes(), frame.pose.tobytes(), frame.timestamp


@pytest.mark.parametrize("sensor", SENSORS)
def test_any_order_gives_the_same_bytes(sensor):
    arguments = ("room", "fast_turns", sensor, 50, 3, 1.0, EVERYTHING)
    in_order = PlacesDataset(*arguments)
    frames = [content(in_order[index]) for index in range(4)]
    alone = PlacesDataset(*arguments)
    assert content(alone[3]) == frames[3]
    assert content(alone[1]) == frames[1]
    assert content(pickle.loads(pickle.dumps(alone))[2]) == frames[2]


def test_seeds_and_frames_differ():
    def noise(seed, index):
        exact = PlacesDataset("desk", "stop_and_go", "exact", seed=seed, capture=Capture(**SIZE))
        noisy = PlacesDataset("desk", "stop_and_go", "structured_light", seed=seed, capture=Capture(**SIZE))
        return noisy[index].depth - exact.place.depth(noisy.camera, noisy[index].pose)

    assert not np.array_equal(noise(0, 0), noise(0, 1))
    assert not np.array_equal(noise(0, 0), noise(1, 0))


@pytest.mark.parametrize("rate_hz", [5, 30, 90])
def test_length_and_rate_do_not_change_the_path(rate_hz):
    short = PlacesDataset("room", frames=3, capture=Capture(**SIZE, rate_hz=rate_hz))
    long = PlacesDataset("room", frames=20_000, capture=Capture(**SIZE, rate_hz=rate_hz))
    np.testing.assert_array_equal(short.poses(), long.poses()[:3])
    np.testing.assert_allclose(np.diff(long.timestamps()), 1 / rate_hz)
    frame = long[19_999]
    np.testing.assert_array_equal(frame.pose, long.poses()[-1])
    np.testing.assert_array_equal(frame.pose, long.motion.pose(frame.timestamp))


@pytest.mark.parametrize(("width", "height"), [(16, 16), (256, 192), (640, 360), (None, None)])
@pytest.mark.parametrize("sensor", SENSORS)
def test_image_sizes(sensor, width, height):
    dataset = PlacesDataset("room", sensor=sensor, capture=Capture(width, height, color_noise=1))
    frame = dataset[0]
    assert frame.color.shape == (height or SENSORS[sensor].height, width or SENSORS[sensor].width, 3)
    assert frame.color.shape[:2] == frame.depth.shape
    assert (frame.color.dtype, frame.depth.dtype) == (np.uint8, np.float32)
    assert (frame.depth > 0).mean() > 0.5


def test_each_row_of_a_rolling_shutter_has_its_own_pose():
    dataset = PlacesDataset("room", "fast_turns", "exact", capture=Capture(**SIZE, rolling_shutter_ms=40))
    frame = dataset[25]
    for row in (0, 20, 47):
        time = frame.timestamp + 0.04 * ((row + 0.5) / 48 - 0.5)
        color, depth = dataset.place.render(dataset.camera, dataset.motion.pose(time))
        np.testing.assert_allclose(frame.depth[row], depth[row], rtol=1e-5)
        assert np.mean(np.abs(frame.color[row].astype(int) - color[row]) <= 2) > 0.95
    still = PlacesDataset("room", "fast_turns", "exact", capture=Capture(**SIZE))[25]
    assert np.abs(still.depth - frame.depth).max() > 0.01


@pytest.mark.parametrize("delay_ms", [15.0, -20.0])
def test_color_comes_later_than_depth_by_the_delay(delay_ms):
    dataset = PlacesDataset("room", "fast_turns", "exact", capture=Capture(**SIZE, color_delay_ms=delay_ms))
    frame = dataset[30]
    color, _ = dataset.place.render(dataset.camera, dataset.motion.pose(frame.timestamp + delay_ms / 1000))
    _, depth = dataset.place.render(dataset.camera, frame.pose)
    np.testing.assert_array_equal(frame.color, color)
    np.testing.assert_array_equal(frame.depth, depth)


def test_a_color_camera_that_runs_on_its_own():
    capture = Capture(**SIZE, color_rate_hz=28, color_delay_ms=10)
    dataset = PlacesDataset("room", "fast_turns", "exact", 60, capture=capture)
    for index in (0, 7, 31):
        frame = dataset[index]
        color_time = np.round(frame.timestamp * 28) / 28
        assert frame.offsets.depth == pytest.approx(0, abs=1e-9)
        assert frame.offsets.color == pytest.approx(color_time - frame.timestamp, abs=1e-9)  # not the delay
        color, _ = dataset.place.render(dataset.camera, dataset.motion.pose(color_time + 0.01))
        np.testing.assert_array_equal(frame.color, color)


def test_stamps_that_are_late_change_no_image():
    plain = PlacesDataset("room", "fast_turns", "exact", 60, capture=Capture(**SIZE))
    late = PlacesDataset("room", "fast_turns", "exact", 60, capture=Capture(**SIZE, stamp_jitter_ms=8))
    np.testing.assert_array_equal(late.poses(), plain.poses())
    off = late.timestamps() - plain.timestamps()
    assert off.min() >= 0 and 0.005 < off.max() <= 0.008
    for index in (3, 40):
        np.testing.assert_array_equal(late[index].color, plain[index].color)
        assert late[index].timestamp == late.timestamps()[index]
        # The frames' clock is found again, but for what is late on average.
        depth_time = late[index].timestamp + late[index].offsets.depth
        assert abs(depth_time - plain[index].timestamp - 0.004) < 0.002
        assert abs(late[index].offsets.color) < 0.002
        assert plain[index].offsets.color == plain[index].offsets.depth == 0


def test_exposure_blurs_as_the_mean_of_sharp_images_does():
    options = ("room", "fast_turns", "exact", 100)
    size = {"width": 160, "height": 120}
    sharp = PlacesDataset(*options, capture=Capture(**size))
    speed = np.linalg.norm(np.diff(sharp.poses()[:, :3, 2], axis=0), axis=1)
    index = int(speed.argmax())
    blurred = PlacesDataset(*options, capture=Capture(**size, exposure_ms=20))[index]
    times = blurred.timestamp + 0.02 * ((np.arange(12) + 0.5) / 12 - 0.5)
    images = [sharp.place.render(sharp.camera, pose)[0] for pose in sharp.motion.poses(times)]
    expected = (np.mean([(image / 255) ** 2.2 for image in images], axis=0) ** (1 / 2.2) * 255)[:, 12:-12]

    def difference(image):
        return np.abs(image[:, 12:-12] - expected).mean()

    assert difference(blurred.color.astype(float)) < 0.4 * difference(sharp[index].color.astype(float))


def test_automatic_exposure_settles_at_middle_brightness():
    plain = PlacesDataset("stairwell", "walking", capture=Capture(**SIZE))
    adapted = PlacesDataset("stairwell", "walking", capture=Capture(**SIZE, auto_exposure=True))
    indices = range(0, 300, 30)
    before = np.array([plain[index].color.mean() for index in indices])
    after = np.array([adapted[index].color.mean() for index in indices])
    assert np.abs(after - 118).mean() < 20
    assert np.std(after) < np.std(before) + 5


def test_color_noise_has_the_stated_deviation():
    clean = PlacesDataset("hall", "walking", capture=Capture(width=160, height=120))[0].color
    noisy = PlacesDataset("hall", "walking", capture=Capture(width=160, height=120, color_noise=6))[0].color
    middle = np.abs(clean.astype(int) - 118) < 10
    assert np.std(noisy[middle].astype(int) - clean[middle]) == pytest.approx(6, rel=0.1)
    dark, bright = clean < 70, (clean > 160) & (clean < 230)
    assert np.std(noisy[dark].astype(int) - clean[dark]) < np.std(noisy[bright].astype(int) - clean[bright])


def test_opened_by_a_configuration():
    config = load_config("places", overrides=["dataset.place=arcade", "dataset.width=48", "dataset.height=32"])
    dataset = open_dataset(config.dataset)
    assert dataset.name == "arcade-handheld-structured_light-0"
    assert dataset[0].depth.shape == (32, 48)
    assert dataset.surface is dataset.place
    assert open_dataset(SimpleNamespace(type="places", stride=3, width=32, height=32)).surface is not None


def test_options_name_what_there_is():
    assert get_args(reading.PlaceName) == PLACES
    assert get_args(reading.MotionName) == MOTIONS
    assert get_args(reading.SensorName) == tuple(SENSORS)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("dataset.place=attic", "dataset.place must be room, apartment, stairwell, arcade, desk or hall, got 'attic'"),
        ("dataset.texture=2", "dataset.texture must be at most 1, got 2"),
        ("dataset.rate_hz=0.1", "dataset.rate_hz must be at least 1, got 0.1"),
        (
            "dataset.noise=1",
            "dataset.noise is not used with dataset.type=places; remove it or set dataset.type=generated",
        ),
    ],
)
def test_bad_options_are_one_clear_line(override, message):
    with pytest.raises(ConfigError) as caught:
        load_config("places", overrides=[override])
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"place": "attic"}, "dataset.place must be one of room, .*, got attic"),
        ({"motion": "flying"}, "dataset.motion must be one of handheld, .*, got flying"),
        ({"sensor": "sonar"}, "dataset.sensor must be one of exact, .*, got sonar"),
        ({"frames": 0}, "dataset.frames must be from 1 to .*, got 0"),
        ({"seed": -1}, "dataset.seed must be from 0 to .*, got -1"),
        ({"texture": float("nan")}, "dataset.texture must be from 0 to 1, got nan"),
        ({"capture": Capture(width=8)}, "dataset.width must be from 16 to .*, got 8"),
        ({"capture": Capture(rate_hz=0)}, "dataset.rate_hz must be from 1 to 120, got 0"),
        ({"capture": Capture(sensor_noise=-1)}, "dataset.sensor_noise must be from 0 to 100, got -1"),
        ({"capture": Capture(exposure_ms=-1)}, "dataset.exposure_ms must be from 0 to 1000, got -1"),
    ],
)
def test_errors(options, message):
    with pytest.raises(DatasetError, match=message):
        PlacesDataset(**options)


def test_exported_folder_is_read_back(tmp_path):
    dataset = PlacesDataset("desk", sensor="structured_light", frames=3, capture=Capture(**SIZE))
    export_folder(dataset, tmp_path / "desk")
    again = open_dataset(SimpleNamespace(type="folder"), tmp_path / "desk")
    assert again.camera == dataset.camera
    for index in range(3):
        np.testing.assert_array_equal(again[index].color, dataset[index].color)
        np.testing.assert_allclose(again[index].depth, dataset[index].depth, atol=1.1e-4)
    np.testing.assert_allclose(again.poses(), dataset.poses(), atol=1e-9)
    assert (tmp_path / "desk" / "gt_mesh.ply").stat().st_size > 1000
    assert len((tmp_path / "desk" / "times.txt").read_text().split()) == 3
    assert cv2.imread(str(tmp_path / "desk/depth/000000.png"), cv2.IMREAD_UNCHANGED).dtype == np.uint16
