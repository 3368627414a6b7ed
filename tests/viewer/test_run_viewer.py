"""A run with a viewer is the run without, whatever becomes of the viewer; with the run, the viewer ends."""

import contextlib
import importlib
import os
import signal
import time
import urllib.error
import urllib.request

import pytest

from spslam.run.sequence import RunRequest, run_sequence
from spslam.viewer import run_viewer as module
from spslam.viewer.options import ViewerOptions
from spslam.viewer.protocol import MapSnapshot, Update, unfinished
from spslam.viewer.run_viewer import SERVICE_FUNCTION, SERVICE_MODULE, open_viewer
from tests.system.sequences import results, settings
from tests.viewer.stub_viewer import received
from tests.viewer.worlds import FRAMES, SIZES, finished_run

# A machine under load gives the viewer, which gives way, little time.
PATIENCE_S = 90.0


def run(folder, observer=None, progress=None):
    request = RunRequest(settings(*SIZES, "run.previews=0"), None, folder, slice(0, FRAMES, 1), mesh=False)
    return run_sequence(request, progress, observer)


def fetch(url):
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(url, timeout=PATIENCE_S) as answer:
        return answer.read()


def use_stub(monkeypatch, folder, **orders):
    """Runs the process of `tests.viewer.stub_viewer` in place of the viewer's."""
    monkeypatch.setattr(module, "SERVICE_MODULE", "tests.viewer.stub_viewer")
    monkeypatch.setattr(module, "_EXIT_TIMEOUT_S", 0.3 if "stalls" in orders else PATIENCE_S)
    monkeypatch.setitem(module._ENVIRONMENT, "STUB_FOLDER", str(folder))
    for name, value in orders.items():
        monkeypatch.setitem(module._ENVIRONMENT, f"STUB_{name.upper()}", str(value))


def wait_for(condition):
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_process_to_start_exists():
    assert callable(getattr(importlib.import_module(SERVICE_MODULE), SERVICE_FUNCTION))


def test_viewed_run_gives_the_same_results_and_ends_its_viewer(tmp_path):
    failures = []
    with open_viewer(ViewerOptions(port=0), "test", failures.append) as viewer:
        assert b"<html" in fetch(viewer.url)
        run(tmp_path / "viewed", viewer)
        process = viewer._process
    assert results(tmp_path / "viewed") == results(finished_run())
    assert failures == []
    assert process.poll() is not None
    with pytest.raises(urllib.error.URLError):
        fetch(viewer.url)


def test_frames_and_maps_reach_the_viewer(tmp_path, monkeypatch):
    use_stub(monkeypatch, tmp_path)
    with open_viewer(ViewerOptions(port=0)) as viewer:
        run(tmp_path / "run", viewer, lambda done, *_: wait_for(lambda: viewer._wants_update or done > 1))
    messages = received(tmp_path)
    updates = [message for message in messages if isinstance(message, Update)]
    assert [row.source_index for update in updates for row in update.rows] == list(range(FRAMES))
    assert all(len(update.rows) == len(update.poses) for update in updates)
    maps = [message for message in messages if isinstance(message, MapSnapshot)]
    assert len(maps[-1].poses) == FRAMES


def test_viewer_that_asks_for_nothing_is_sent_the_end(tmp_path, monkeypatch):
    use_stub(monkeypatch, tmp_path, asks=0)
    with open_viewer(ViewerOptions(port=0)) as viewer:
        run(tmp_path / "run", viewer)
    kinds = [type(message).__name__ for message in received(tmp_path)]
    assert kinds == ["Begin", "RunBegins", "Update", "MapSnapshot", "RunEnds"]


def test_stalled_viewer_holds_up_nothing(tmp_path, monkeypatch):
    """One that reads nothing, not even the end."""
    use_stub(monkeypatch, tmp_path, stalls=1)
    failures = []
    with open_viewer(ViewerOptions(port=0), "test", failures.append) as viewer:
        run(tmp_path / "run", viewer)
    assert results(tmp_path / "run") == results(finished_run())
    assert viewer._process.returncode == -signal.SIGKILL
    assert failures == []


@pytest.mark.parametrize("when", ["killed", "failing"])
def test_run_goes_on_without_its_viewer(tmp_path, monkeypatch, when):
    failures = []
    if when == "failing":
        use_stub(monkeypatch, tmp_path, fails=1)
    with open_viewer(ViewerOptions(port=0), "test", failures.append) as viewer:

        def kill(done, total, report):
            if done == 2:
                if when == "killed":
                    os.kill(viewer._process.pid, signal.SIGKILL)
                assert viewer._gone.wait(PATIENCE_S)

        run(tmp_path / "run", viewer, kill)
    assert results(tmp_path / "run") == results(finished_run())
    (text,) = failures
    assert "the viewer ended with code" in text
    assert ("ValueError: of the stub" in text) == (when == "failing")


def test_paused_run_waits_steps_and_goes_on(tmp_path, monkeypatch):
    """The stub pauses at the first update, asks for two steps, and continues a second later."""
    use_stub(monkeypatch, tmp_path, pauses=1)
    times = []

    def progress(done, total, report):
        times.append(time.monotonic())
        wait_for(lambda: (done != 1 or viewer._wants_update) and (done != 2 or viewer.is_paused()))

    with open_viewer(ViewerOptions(port=0)) as viewer:
        run(tmp_path / "run", viewer, progress)
    assert max(b - a for a, b in zip(times, times[1:], strict=False)) > 0.3
    assert results(tmp_path / "run") == results(finished_run())


def test_run_that_was_paused_by_a_viewer_now_gone_goes_on(tmp_path, monkeypatch):
    use_stub(monkeypatch, tmp_path, pauses=1, dies=1)
    failures = []

    def progress(done, total, report):
        wait_for(lambda: (done != 1 or viewer._wants_update) and (done != 2 or viewer.is_paused()))

    with open_viewer(ViewerOptions(port=0), "test", failures.append) as viewer:
        run(tmp_path / "run", viewer, progress)
    assert results(tmp_path / "run") == results(finished_run())
    assert len(failures) == 1


def test_viewer_ends_with_a_run_that_fails():
    with contextlib.suppress(RuntimeError), open_viewer(ViewerOptions(port=0)) as viewer:
        raise RuntimeError
    assert viewer._process.poll() is not None


def test_recording_of_a_killed_viewer_leaves_nothing(tmp_path, monkeypatch):
    use_stub(monkeypatch, tmp_path, stalls=1)
    monkeypatch.setattr(module, "require_rerun", lambda: None)
    monkeypatch.setattr(module, "_RECORDING_TIMEOUT_S", 0.3)
    path, failures = tmp_path / "run.rrd", []
    with open_viewer(ViewerOptions(browser=False, recording=path), "test", failures.append) as viewer:
        begun = unfinished(path, viewer._process.pid)
        begun.touch()
    assert viewer._process.returncode == -signal.SIGKILL
    assert failures == ["the recording was not completed within 0 s"]
    assert not begun.exists()


def test_viewer_that_ends_is_told_of_once_and_what_waits_for_it_is_kept_from_its_threads():
    failures = []
    with open_viewer(ViewerOptions(port=0), "test", failures.append) as viewer:
        viewer._pending.append(("report", 0.0))
        os.kill(viewer._process.pid, signal.SIGKILL)
        wait_for(lambda: failures)
        viewer._fail()
        assert len(viewer._pending) == 1  # the loop may be counting them
        viewer.observe(None)
        assert not viewer._pending
    assert len(failures) == 1


def test_recording_is_there_at_the_end(tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install 'spslam[rerun]'")
    path = tmp_path / "run.rrd"
    failures = []
    with open_viewer(ViewerOptions(browser=False, recording=path), "test", failures.append) as viewer:
        assert viewer.url is None
        run(tmp_path / "run", viewer)
    assert failures == []
    assert path.read_bytes()[:3] == b"RRF"
    assert [file.name for file in tmp_path.iterdir() if "tmp" in file.name] == []
