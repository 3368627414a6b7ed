"""A live run that is watched: what the observer is told, when, and that the run does without its viewer."""

import time

from spslam.evaluation.run_output import RunOutput
from spslam.live import ReplaySource
from spslam.live.session import run_live
from spslam.run.observer import RunObserver
from spslam.viewer.options import ViewerOptions
from spslam.viewer.protocol import RunBegins, Update
from spslam.viewer.run_viewer import open_viewer
from tests.live.sources import RoomCamera
from tests.live.test_live_run import request
from tests.system.sequences import Recorded
from tests.viewer.stub_viewer import received
from tests.viewer.test_run_viewer import PATIENCE_S, use_stub, wait_for


class Recording(RunObserver):
    """Keeps what it is told; asks for a pause that a live run does not make."""

    def __init__(self):
        self.told = []

    def begin(self, run, state):
        self.run, self.state = run, state

    def observe(self, report, frame=None):
        assert len(self.state.frames) == report.frame + 1
        self.told.append((report.frame, frame.index, frame.depth.shape, report.encode_ms > 0))

    def is_paused(self):
        return True

    def wait(self, is_interrupted):
        raise AssertionError("a live run can't wait")

    def finish(self):
        self.told.append("end")


def test_observer_is_told_of_every_frame_with_its_images(tmp_path):
    observer, source = Recording(), ReplaySource(Recorded(7), 100)
    run_live(request(tmp_path, "mapping.every=5"), source, observer=observer)
    run = observer.run
    assert (run.total, run.can_read, run.can_pause, run.camera) == (None, False, False, source.camera)
    assert run.ground_truth.shape == (7, 4, 4)
    shape = source.camera.height, source.camera.width
    assert observer.told == [*((n, n, shape, n % 5 == 0) for n in range(7)), "end"]


def test_observing_is_not_part_of_the_latency(tmp_path):
    class Slow(RunObserver):
        def observe(self, report, frame=None):
            time.sleep(1.5)

    metrics = run_live(request(tmp_path), RoomCamera(3, pause_s=2.0), observer=Slow())
    assert metrics["latency_p50_ms"] < 1500


def test_viewer_is_sent_frames_and_images(tmp_path, monkeypatch):
    use_stub(monkeypatch, tmp_path)
    with open_viewer(ViewerOptions(port=0)) as viewer:

        def progress(status):
            if status.frames == 1:
                wait_for(lambda: viewer._wants_update)

        run_live(request(tmp_path), RoomCamera(6), progress, observer=viewer)
    messages = received(tmp_path)
    (begin,) = (message for message in messages if isinstance(message, RunBegins))
    assert not begin.can_pause
    updates = [message for message in messages if isinstance(message, Update)]
    assert [row.source_index for update in updates for row in update.rows] == list(range(6))
    assert updates[0].color.shape == (*updates[0].depth.shape, 3)


def test_live_run_goes_on_without_its_viewer(tmp_path, monkeypatch):
    use_stub(monkeypatch, tmp_path, fails=1)
    failures = []
    with open_viewer(ViewerOptions(port=0), "test", failures.append) as viewer:

        def progress(status):
            if status.frames == 2:
                assert viewer._gone.wait(PATIENCE_S)

        metrics = run_live(request(tmp_path), RoomCamera(6), progress, observer=viewer)
    assert metrics["frames"] == len(RunOutput.read(tmp_path / "out").trajectory) == 6
    (text,) = failures
    assert "ValueError: of the stub; the run goes on without it" in text
