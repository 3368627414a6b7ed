"""What a recording for rerun is given, by a stand-in for rerun's library."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from spslam.viewer.images import WIDTH_PX, reduced
from spslam.viewer.rerun_sink import RerunSink
from tests.viewer.worlds import CAMERA, model


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


def test_images_fill_the_frustum(opened):
    """Its pinhole is of the images' size, to which they are reduced."""
    made = model(3)
    opened.begin(made)
    for row, width in enumerate((2 * WIDTH_PX, 2 * WIDTH_PX, 120)):
        opened.show_images(reduced(row, np.zeros((width * 3 // 4, width, 3), np.uint8), None))
    pinholes = [pinhole for _, pinhole in logged(opened, "Pinhole")]
    assert [(pinhole.width, pinhole.height) for pinhole in pinholes] == [(160, 120), (WIDTH_PX, 240), (120, 90)]
    np.testing.assert_array_equal(pinholes[1].image_from_camera, CAMERA.resized(WIDTH_PX, 240).matrix())
