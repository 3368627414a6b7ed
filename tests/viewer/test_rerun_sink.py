"""What a recording for rerun is given, by a stand-in for rerun's library."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from spslam.viewer import rerun_sink as module
from spslam.viewer import segments
from spslam.viewer.images import WIDTH_PX, reduced
from spslam.viewer.protocol import Update
from spslam.viewer.rerun_sink import RerunSink
from tests.viewer.worlds import CAMERA, model, row, straight


class Shape(SimpleNamespace):
    """Anything that can be logged."""

    def compress(self, quality):
        return self


class Stream:
    """Keeps what is logged: name, content, and whether for all times."""

    def __init__(self, title):
        self.logged = []

    def save(self, path):
        path.touch()

    def set_time(self, timeline, **time):
        pass

    def log(self, name, what, static=False):
        self.logged.append((name, what, static))

    def flush(self):
        pass

    def disconnect(self):
        pass


class StandIn(SimpleNamespace):
    """In place of the module."""

    RecordingStream = Stream
    ViewCoordinates = SimpleNamespace(RDF=None)

    def __getattr__(self, kind):
        return lambda *content, **fields: Shape(kind=kind, content=content, **fields)


@pytest.fixture
def opened(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", StandIn())
    return RerunSink(tmp_path / "run.rrd", "test")


def logged(sink, kind):
    return [(name, what) for name, what, _ in sink._recording.logged if getattr(what, "kind", "") == kind]


def lines(sink, name):
    """Of each block of a line as it was logged last, in order, the segments; and how many were logged in all."""
    shapes = [
        (int(at.split("/")[2]), what.content[0]) for at, what in logged(sink, "LineStrips3D") if f"/{name}/" in at
    ]
    last = dict(shapes)
    return np.concatenate([last[block] for block in sorted(last)]), sum(len(points) for _, points in shapes)


def test_a_recording_grows_with_the_run(opened, monkeypatch):
    """Not with its square: with each frame at most a block of each line is logged again."""
    looked = []
    monkeypatch.setattr(module, "_BLOCK", 16)
    monkeypatch.setattr(module, "known_curves", lambda model: looked.append(model) or [])
    made, frames, per_update = model(1), 400, 4
    opened.begin(made)
    for first in range(1, frames, per_update):
        loops = [(first, 0)] if first > 1 else []
        rows = [row(first + i, lost=i == 2) for i in range(per_update)]
        made.update(Update(first, rows, straight(first, per_update), loops=loops))
        opened.show_frames()
        opened.show_frames()  # as after a map: with other poses, without another frame
    updates = 2 * (frames // per_update)
    assert len(looked) == updates
    for name in ("path", "keyframes", "loops", "lost"):
        assert lines(opened, name)[1] <= updates // 2 * (16 + 8 * per_update), name


def test_lines_show_corrected_poses_at_the_end(opened, tmp_path):
    made = model(300)
    opened.begin(made)
    opened.show_frames()
    made.set_poses(straight(5, 300))
    opened.close()
    np.testing.assert_array_equal(lines(opened, "path")[0], segments.path(made, 300).points)
    np.testing.assert_array_equal(lines(opened, "keyframes")[0], segments.keyframes(made).points)
    assert (tmp_path / "run.rrd").exists()


def test_images_fill_the_frustum(opened):
    """Its pinhole is of the images' size, to which they are reduced."""
    made = model(3)
    opened.begin(made)
    for number, width in enumerate((2 * WIDTH_PX, 2 * WIDTH_PX, 120)):
        opened.show_images(reduced(number, np.zeros((width * 3 // 4, width, 3), np.uint8), None))
    pinholes = [pinhole for _, pinhole in logged(opened, "Pinhole")]
    assert [(pinhole.width, pinhole.height) for pinhole in pinholes] == [(160, 120), (WIDTH_PX, 240), (120, 90)]
    np.testing.assert_array_equal(pinholes[1].image_from_camera, CAMERA.resized(WIDTH_PX, 240).matrix())
