"""What `spslam run` loads and does before its first frame: everything else would only delay it."""

from __future__ import annotations

import gc
import importlib
import json
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from spslam.datasets import registry
from spslam.errors import DatasetError
from spslam.loading import collector_paused
from spslam.run import data_check
from spslam.run.data_check import OpenedData
from spslam.run.sequence import RunRequest
from tests.system.sequences import Recorded, settings, write_room

ROOT = Path(__file__).parents[2]
# Of no use before the first frame: for reports, meshes of other origin, figures, other kinds of data, other commands.
NOT_NEEDED = (
    "matplotlib",
    "skimage",
    "spslam.benchmark",
    "spslam.datasets.identify",
    "spslam.datasets.places",
    "spslam.datasets.rosbag",
    "spslam.evaluation.html_report",
    "spslam.live",
    "spslam.viewer",
    "torch._dynamo",
    "torch._inductor",
    "trimesh",
)
# Runs the command up to the frame loop, then prints which modules are loaded.
SCRIPT = """
import json, os, sys
from spslam.cli.main import main

def loop_begins(frame, event, argument):
    if frame.f_code.co_name == "run" and frame.f_code.co_filename.endswith("spslam/run/loop.py"):
        print(json.dumps(sorted(sys.modules)), flush=True)
        os._exit(0)

sys.setprofile(loop_begins)
main(sys.argv[1:])
"""


def test_a_run_loads_only_what_its_frames_need(tmp_path):
    folder = write_room(tmp_path / "room", 3)
    arguments = ["run", "7scenes", "--data", str(folder), "--device", "cpu", "--output", str(tmp_path / "out")]
    ended = subprocess.run([sys.executable, "-c", SCRIPT, *arguments], cwd=ROOT, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    loaded = json.loads(ended.stdout.splitlines()[-1])
    assert "torch" in loaded and "spslam.datasets.seven_scenes" in loaded
    assert [name for name in loaded if any(name == each or name.startswith(f"{each}.") for each in NOT_NEEDED)] == []


def test_looking_at_the_data_needs_no_torch():
    """The thread that looks does it while torch is loaded."""
    code = "import sys, spslam.run.data_check; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


@pytest.mark.parametrize("name", NOT_NEEDED)
def test_what_is_not_needed_still_exists(name):
    """A module that is renamed must not fall off the list in silence."""
    if name.startswith("spslam."):
        importlib.import_module(name)


def test_the_first_frames_are_looked_at_beside(monkeypatch, tmp_path):
    monkeypatch.setattr(registry, "open_dataset", lambda *_: Recorded(3))
    begun, asked = threading.Event(), threading.Event()

    def check(dataset):
        begun.set()
        assert asked.wait(60)
        raise DatasetError("the check's own")

    monkeypatch.setattr(data_check, "check_first_frames", check)
    opened = OpenedData(RunRequest(settings("run.data_check=stop"), None, tmp_path / "out"))
    assert len(opened.dataset) == 3
    assert begun.wait(60)  # and the constructor has returned: the check is not over
    asked.set()
    with pytest.raises(DatasetError, match="the check's own"):
        opened.doubts()


def test_data_that_is_not_to_be_checked_is_not(monkeypatch, tmp_path):
    monkeypatch.setattr(registry, "open_dataset", lambda *_: Recorded(3))
    monkeypatch.setattr(data_check, "check_first_frames", lambda dataset: pytest.fail("looked at"))
    assert OpenedData(RunRequest(settings("run.data_check=skip"), None, tmp_path / "out")).doubts() == []


def test_the_collector_is_paused_while_modules_are_loaded():
    assert gc.isenabled()
    frozen = gc.get_freeze_count()
    try:
        with collector_paused():
            assert not gc.isenabled()
            with collector_paused():
                assert not gc.isenabled()
            assert not gc.isenabled()
        assert gc.isenabled()
        assert gc.get_freeze_count() > frozen
    finally:
        gc.unfreeze()
