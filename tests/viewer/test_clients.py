"""Clients that send garbage, come in crowds or stop reading: the others are served, and the run goes on."""

import contextlib
import os
import random
import socket
import threading
import time
from pathlib import Path

import pytest

from spslam.viewer.options import ViewerOptions
from spslam.viewer.run_viewer import open_viewer
from tests.system.sequences import results
from tests.viewer.test_gate import fetch
from tests.viewer.test_run_viewer import run
from tests.viewer.worlds import connected, finished_run, replay

msgspec = pytest.importorskip("msgspec", reason="viser is not installed: pip install 'spslam[viewer]'")


def garbage(seed):
    """Text, bytes, and messages that viser knows, with fields that it does not expect."""
    generator = random.Random(seed)
    value = generator.choice([None, 1e400, -1, "x" * 1000, [1, 2, 3], {"a": 1}, b"\0" * 10, True])
    kinds = ["GuiUpdateMessage", "ViewerCameraMessage", "ScenePointerMessage", "ShareUrlRequest", "no-such-message"]
    message = {"type": generator.choice(kinds), "uuid": value, "updates": {"value": value}, "wxyz": value}
    return [
        generator.randbytes(generator.randrange(200)),
        "text",
        msgspec.msgpack.encode(message),
        msgspec.msgpack.encode(value),
        b"",
    ]


def throw_garbage(url, seed, contents):
    """One connection per content, as the server closes those that it does not understand."""
    for content in contents:
        with contextlib.suppress(Exception), connected(url) as connection:
            connection.send(content)
            connection.recv(timeout=1)


def throw_bytes(url, seed):
    """What is not even HTTP."""
    host, port = url.split("/")[2].rsplit(":", 1)
    generator = random.Random(seed)
    for head in (b"", b"GET / HTTP/1.1\r\n", b"GET /%ff%00 HTTP/1.1\r\nHost: \xff\r\n\r\n", b"\x16\x03\x01"):
        with contextlib.suppress(OSError), socket.create_connection((host, int(port)), timeout=1) as connection:
            connection.sendall(head + generator.randbytes(100))


def test_garbage_harms_no_other_client():
    with replay() as opened, connected(opened.url) as witness:
        assert len(witness.recv(timeout=30)) > 0
        for seed in range(3):
            throw_garbage(opened.url, seed, garbage(seed))
            throw_bytes(opened.url, seed)
        opened.show(3)
        assert len(witness.recv(timeout=30)) > 0
        assert fetch(opened.url)[0] == 200


def move(client, slider):
    """Has a client move the slider to frame 2; returns once that was taken, and so was what the client sent before."""
    message = {"type": "GuiUpdateMessage", "uuid": slider._impl.uuid, "updates": {"value": 2}}
    client.send(msgspec.msgpack.encode(message))
    until = time.monotonic() + 10
    while slider.value != 2:
        assert time.monotonic() < until
        time.sleep(0.01)


@pytest.mark.parametrize(
    "updates", [{"removed": True}, {"props": None}, {"update_cb": None}, {"gui_api": None}, {"value": 1, "removed": 1}]
)
@pytest.mark.parametrize("control", ["_slider", "_play"])
def test_a_client_can_set_the_value_of_a_control_alone(control, updates):
    with replay() as opened, connected(opened.url) as witness, connected(opened.url) as client:
        panel = opened._sink._panel
        message = {"type": "GuiUpdateMessage", "uuid": getattr(panel, control)._impl.uuid, "updates": updates}
        client.send(msgspec.msgpack.encode(message))
        move(client, panel._slider)
        for frame in (3, 1):
            opened.show(frame)
            assert opened._frames.wait_until_idle(20)
        assert not opened._ended.is_set(), opened._failure
        assert panel._slider.value == 1
        assert len(witness.recv(timeout=30)) > 0


def test_files_that_nothing_asks_for_are_not_kept():
    with replay() as opened, connected(opened.url) as client:
        slider, gui = opened._sink._panel._slider, opened._sink.server.gui
        start = {"type": "FileTransferStartUpload", "source_component_uuid": slider._impl.uuid, "transfer_uuid": "t"}
        start |= {"filename": "f", "mime_type": "", "part_count": 9, "size_bytes": 9}
        client.send(msgspec.msgpack.encode(start))
        move(client, slider)
        assert not gui._current_file_upload_states


def test_values_that_no_slider_has_are_ignored():
    with replay() as opened:
        slider = opened._sink._panel._slider
        for value in ("x", None, 1e308, -5, True, [1]):
            with contextlib.suppress(Exception), connected(opened.url) as connection:
                message = {"type": "GuiUpdateMessage", "uuid": slider._impl.uuid, "updates": {"value": value}}
                connection.send(msgspec.msgpack.encode(message))
                connection.recv(timeout=0.3)
        assert not opened._ended.is_set()
        assert fetch(opened.url)[0] == 200


@pytest.mark.slow
def test_run_goes_on_under_fire(tmp_path):
    """Garbage, half-open connections, a client that never reads, and 1,000 connections per second."""
    failures, stop = [], threading.Event()

    def flood(url):
        host, port = url.split("/")[2].rsplit(":", 1)
        held, due_s = [], time.monotonic()
        while not stop.is_set():
            with contextlib.suppress(OSError):
                held.append(socket.create_connection((host, int(port)), timeout=0.2))
            if len(held) > 300:
                held.pop(0).close()
            due_s += 1e-3
            time.sleep(max(due_s - time.monotonic(), 0.0))

    def fuzz(url):
        seed = 0
        while not stop.is_set():
            throw_garbage(url, seed, garbage(seed))
            throw_bytes(url, seed)
            seed += 1

    with open_viewer(ViewerOptions(port=0), "test", failures.append) as viewer, connected(viewer.url):
        threads = [threading.Thread(target=target, args=(viewer.url,)) for target in (flood, fuzz)]
        for thread in threads:
            thread.start()
        began = time.monotonic()
        run(tmp_path / "run", viewer, lambda *_: time.sleep(max(0.0, min(1.0, began + 10 - time.monotonic()))))
        stop.set()
        for thread in threads:
            thread.join()
        assert viewer._process.poll() is None
        pages = int(Path(f"/proc/{viewer._process.pid}/statm").read_text().split()[1])
        memory_mb = pages * os.sysconf("SC_PAGE_SIZE") / 2**20
        assert memory_mb < 600
    assert failures == []
    assert results(tmp_path / "run") == results(finished_run())
