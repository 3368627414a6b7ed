"""`spslam view`, and the options by which `spslam run` opens a viewer."""

import os
import signal
import socket
import subprocess
import sys
import time

import pytest

from tests.cli.command import ROOT, assert_refused, spslam
from tests.viewer.worlds import finished_run

pytest.importorskip("viser", reason="viser is not installed: pip install 'spslam[viewer]'")


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["run", "demo", "--port", "0"], "need --view"),
        (["run", "demo", "--host", "0.0.0.0"], "need --view"),
        (["live", "replay", "demo", "--port", "0"], "need --view"),
        (["live", "replay", "demo", "--output", "out", "--view", "--host", "192.0.2.1"], "192.0.2.1"),
        (["run", "demo", "--view", "--port", "99999"], "must be a port from 0 to 65535"),
        (["run", "demo", "--view", "--host", "192.0.2.1"], "192.0.2.1"),
        (["run", "demo", "--rerun", "run.txt"], "must end with .rrd"),
        (["run", "demo", "--rerun", "no/such/folder/run.rrd"], "is no folder"),
        (["view", "nowhere"], "no such folder"),
        (["view", "."], "finished run"),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path, arguments, message):
    assert_refused(spslam(*arguments, cwd=tmp_path), message)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["run", "view"])
def test_taken_port_is_named(tmp_path, command):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        what = ["run", "demo", "--output", "out", "--view"] if command == "run" else ["view", finished_run()]
        assert_refused(spslam(*what, "--port", port, cwd=tmp_path), f"port {port} of 127.0.0.1")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGKILL], ids=["interrupted", "killed"])
def test_viewer_ends_with_its_command(tmp_path, ending):
    """By Ctrl-C, or killed: nothing listens any more."""
    command = [sys.executable, "-m", "spslam", "run", "demo", "--output", "out", "--view", "--port", "0"]
    process = subprocess.Popen(
        command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stderr is not None
        line = process.stderr.readline()
        assert line.startswith("viewer: http://127.0.0.1:"), line
        port = int(line.strip().strip("/").rsplit(":", 1)[1])
        socket.create_connection(("127.0.0.1", port), timeout=30).close()
        time.sleep(1)
        process.send_signal(ending)
        process.wait(60)
        deadline = time.monotonic() + 60
        while True:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)):
                    break
            assert time.monotonic() < deadline, "the viewer still listens"
            time.sleep(0.1)
    finally:
        process.kill()
        process.communicate()
