"""Videos by OpenCV's writer and by FFmpeg's encoders give their frames, in any order, from threads and copies."""

import contextlib
import multiprocessing
import pickle
from fractions import Fraction

import cv2
import numpy as np
import pytest

from spslam.datasets.prefetch import prefetch
from spslam.datasets.video import VideoStream
from spslam.errors import DatasetError

av = pytest.importorskip("av")
WIDTH, HEIGHT, COUNT = 64, 48, 30
PATIENCE_S = 60


def picture(number):
    """A plain picture whose red says which frame it is."""
    image = np.full((HEIGHT, WIDTH, 3), (0, 90, 160), np.uint8)
    image[..., 0] = 8 * number
    return image


def write_opencv(path, count=COUNT, fourcc="mp4v", size=(WIDTH, HEIGHT), draw=picture):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*fourcc), 30, size)
    assert writer.isOpened()
    for number in range(count):
        writer.write(cv2.cvtColor(draw(number), cv2.COLOR_RGB2BGR))
    writer.release()
    return path


def write_h264(path, seconds, b_frames=3, rate=1000):
    """With B-frames and uneven times."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=rate, options={"bf": str(b_frames), "g": "20", "crf": "5"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.time_base = Fraction(1, rate)
        for number, time in enumerate(seconds):
            frame = av.VideoFrame.from_ndarray(picture(number), format="rgb24")
            frame.pts = round(rate * time)
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


def reds(stream, numbers):
    return [float(stream.read(int(number))[..., 0].mean()) / 8 for number in numbers]


@pytest.mark.parametrize(("suffix", "fourcc"), [(".mp4", "mp4v"), (".avi", "MJPG")])
def test_frames_by_number_in_any_order(tmp_path, suffix, fourcc):
    stream = VideoStream(write_opencv(tmp_path / f"a{suffix}", fourcc=fourcc))
    assert len(stream) == COUNT
    np.testing.assert_allclose(np.diff(stream.times()), 1 / 30, atol=1e-3)
    for order in (range(COUNT), np.random.default_rng(0).permutation(COUNT)):
        np.testing.assert_allclose(reds(stream, order), list(order), atol=0.5)
    np.testing.assert_allclose(reds(pickle.loads(pickle.dumps(stream)), [25, 3, 4]), [25, 3, 4], atol=0.5)
    assert stream.read(3).dtype == np.uint8
    assert stream.read(3).shape == (HEIGHT, WIDTH, 3)


def test_frames_that_are_stored_out_of_order_and_at_uneven_times(tmp_path):
    seconds = np.cumsum(np.random.default_rng(0).integers(10, 60, COUNT)) / 1000
    stream = VideoStream(write_h264(tmp_path / "a.mp4", seconds - seconds[0]))
    np.testing.assert_allclose(stream.times() - stream.times()[0], seconds - seconds[0], atol=1.1e-3)
    np.testing.assert_allclose(reds(stream, range(COUNT)), range(COUNT), atol=0.5)
    np.testing.assert_allclose(reds(stream, [28, 27, 2]), [28, 27, 2], atol=0.5)


def rewritten(path, source):
    """Decoded as FFmpeg's command does it, frames in order, and encoded without losses."""
    with av.open(str(source)) as found, av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for number, frame in enumerate(found.decode(video=0)):
            frame.pts, frame.time_base = number, Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def test_b_frames_need_a_container_with_times(tmp_path):
    seconds = [number / 30 for number in range(COUNT)]
    path = write_h264(tmp_path / "a.avi", seconds, rate=30)
    with pytest.raises(DatasetError, match="B-frames lacks .* place: ffmpeg -i a.avi -c:v ffv1 a.mkv") as error:
        VideoStream(path)
    assert "\n" not in str(error.value)
    plain = VideoStream(write_h264(tmp_path / "b.avi", seconds, 0, 30))
    np.testing.assert_allclose(reds(plain, range(COUNT)), range(COUNT), atol=0.5)
    mended = VideoStream(rewritten(tmp_path / "a.mkv", path))
    np.testing.assert_allclose(reds(mended, range(COUNT)), range(COUNT), atol=0.5)


def test_from_threads(tmp_path):
    class Frames:
        def __init__(self, stream):
            self.stream = stream

        def __len__(self):
            return COUNT

        def __getitem__(self, number):
            return self.stream.read(number)

    with prefetch(Frames(VideoStream(write_opencv(tmp_path / "a.mp4"))), workers=4, ahead=12) as frames:
        np.testing.assert_allclose([frame[..., 0].mean() / 8 for frame in frames], range(COUNT), atol=0.5)


def test_broken_videos_are_one_line(tmp_path):
    path = write_opencv(tmp_path / "a.mp4")
    content = path.read_bytes()
    for spoiled, message in (
        (b"", "can't be read as a video"),
        (content[:200], "can't be read as a video"),
        (content[: len(content) // 2], "can't be read as a video"),
        (b"no video at all" * 50, "can't be read as a video"),
    ):
        path.write_bytes(spoiled)
        with pytest.raises(DatasetError, match=message) as error:
            VideoStream(path)
        assert "\n" not in str(error.value)
    with pytest.raises(DatasetError, match="no such file"):
        VideoStream(tmp_path / "absent.mp4")
    path.write_bytes(content)
    with pytest.raises(DatasetError, match="must have a video track 1, got 1 of them"):
        VideoStream(path, 1)


def read_damaged(path):
    """Reads a frame of videos with bytes of their frames changed, and closes them while others are being decoded."""
    content, random = path.read_bytes(), np.random.default_rng(0)
    for number in range(60):
        spoiled = np.frombuffer(content, np.uint8).copy()
        spoiled[random.integers(40, len(content) - 1500, 200)] = random.integers(0, 256, 200)
        path.with_suffix(f".{number}.mp4").write_bytes(spoiled.tobytes())
        with contextlib.suppress(DatasetError):
            VideoStream(path.with_suffix(f".{number}.mp4")).read(number % 5)


def test_damaged_videos_are_closed(tmp_path):
    """FFmpeg's threads complain about them meanwhile: closing waited for them, and they for Python's lock."""
    path = write_h264(tmp_path / "a.mp4", [number / 30 for number in range(COUNT)])
    process = multiprocessing.get_context("spawn").Process(target=read_damaged, args=(path,))
    process.start()
    process.join(PATIENCE_S)
    process.kill()
    assert process.exitcode == 0


def test_pyav_absent_is_one_line(tmp_path, monkeypatch):
    path = write_opencv(tmp_path / "a.mp4", 2)
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    with pytest.raises(DatasetError, match=r"videos need PyAV: pip install 'spslam\[video\]'"):
        VideoStream(path)
