import numpy as np
import pytest

from spslam.camera import Camera
from spslam.datasets.base import RgbdFrame
from spslam.datasets.clock import AT_ONCE, WINDOW, CaptureOffsets, capture_offsets, capture_times
from spslam.datasets.lens import Lens
from spslam.datasets.recording import Calibration, ImageStream, Recording

SIZE = 8, 6


def late(count, most_s, seed=0):
    """What the transport of images takes, s."""
    return np.random.default_rng(seed).uniform(0, most_s, count)


def test_an_even_camera_keeps_its_stamps():
    stamps = 1_305_031_229.5 + np.arange(100) / 30
    np.testing.assert_allclose(capture_times(stamps), stamps, atol=1e-6)


@pytest.mark.parametrize("count", [12, WINDOW, 400])
def test_what_the_transport_took_is_averaged(count):
    true = np.arange(count) * 0.0333
    found = capture_times(true + late(count, 0.012)) - true
    assert found.std() < 0.5 * late(count, 0.012).std()
    assert abs(found.mean() - 0.006) < 0.002


def test_missing_images_are_gaps_in_an_even_row():
    kept = np.delete(np.arange(200), [3, 50, 51, 52, 120])
    true = kept / 30
    found = capture_times(true + late(len(kept), 0.01)) - true
    assert np.abs(found - found.mean()).max() < 0.004


def test_a_clock_that_drifts_is_followed():
    true = np.arange(3000) / 30 + 5e-3 * np.sin(np.arange(3000) / 400)
    found = capture_times(true + late(3000, 0.01)) - true
    assert np.abs(found - found.mean()).max() < 0.004


def test_uneven_images_are_taken_as_they_come():
    stamps = np.cumsum(np.random.default_rng(1).choice([0.03, 0.045, 0.062], 80))
    np.testing.assert_array_equal(capture_times(stamps), stamps)
    for few in ([], [1.0], [0.0, 0.03, 0.07], [2.0] * 20):
        np.testing.assert_array_equal(capture_times(np.array(few)), few)


def test_many_stamps_are_done_in_parts(monkeypatch):
    stamps = np.arange(300) / 30 + late(300, 0.01)
    whole = capture_times(stamps)
    monkeypatch.setattr("spslam.datasets.clock._MOST_AT_ONCE", 7)
    np.testing.assert_array_equal(capture_times(stamps), whole)


class Images(ImageStream):
    """Black images at given times."""

    def __init__(self, times, is_depth):
        self._times, self._is_depth = times, is_depth

    def __len__(self):
        return len(self._times)

    def times(self):
        return self._times

    def read(self, number):
        width, height = SIZE
        return np.ones((height, width), np.float32) if self._is_depth else np.zeros((height, width, 3), np.uint8)

    def describe(self, number):
        return "an image"


def test_a_recording_hands_its_stamps_on():
    depth = np.arange(40) / 30
    color = np.arange(39) / 29.5 + 0.002  # a camera that runs on its own
    pairs = np.array([(int(np.abs(color - time).argmin()), i) for i, time in enumerate(depth[:38])])
    lens = Lens(Camera(*SIZE, 10, 10, 3.5, 2.5))
    recording = Recording("one", Images(color, False), Images(depth, True), pairs, Calibration(lens, lens))
    for i in (0, 9, 20, 37):
        frame = recording[i]
        assert frame.timestamp == depth[i]
        assert frame.offsets.depth == pytest.approx(0, abs=1e-9)
        assert frame.offsets.color == pytest.approx(color[pairs[i, 0]] - depth[i], abs=1e-9)


def test_offsets_of_frames():
    assert capture_offsets(np.array([1.0]), np.array([1.5]), np.array([1.25])) == [CaptureOffsets(0.25, 0.25)]


def test_a_frame_of_arrays_with_its_color_offset():
    images = np.zeros((6, 8, 3), np.uint8), np.ones((6, 8))
    assert RgbdFrame.from_arrays(*images, 2.0).offsets == AT_ONCE
    assert RgbdFrame.from_arrays(*images, 2.0, color_offset=-0.011).offsets == CaptureOffsets(color=-0.011)
    for wrong in (float("nan"), 16.0):
        with pytest.raises(ValueError, match="color_offset must be within 1 s of the depth image, got"):
            RgbdFrame.from_arrays(*images, 2.0, color_offset=wrong)
    with pytest.raises(TypeError, match="color_offset must be a number of seconds, got str"):
        RgbdFrame.from_arrays(*images, 2.0, color_offset="0.01")
