"""A headless Chromium for tests of pages: opens tabs that share nothing.

The system's Chromium is driven over the DevTools protocol, by means of the `websockets` package. Tests that use it are
skipped, with the reason, where either is missing:

    def test_page(tmp_path):
        with open_browser() as browser, browser.page() as page:
            page.open("http://127.0.0.1:8080/")
            page.wait_for("document.title")
            assert page.errors == []
"""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.browser_page import TIMEOUT_S, Page, Protocol

# WebGL without multisampling, which takes software most of a second for a frame.
_ONE_SAMPLE = """(() => {
    const original = HTMLCanvasElement.prototype.getContext
    HTMLCanvasElement.prototype.getContext = function (kind, options) {
        return original.call(this, kind, kind.startsWith('webgl') ? {...options, antialias: false} : options)
    }
})()"""
# Names that distributions give it; SPSLAM_CHROMIUM names another one.
NAMES = ("chromium", "chromium-browser", "google-chrome")
_FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--remote-debugging-port=0",
    # WebGL without a GPU.
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-extensions",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--no-first-run",
    "--mute-audio",
)


class Browser:
    """A running Chromium; `page` opens tabs that share nothing.

    Args:
        address: of its DevTools, as they tell it.
        connect: opens a web socket.
    """

    def __init__(self, address: str, connect: Callable[[str], Any]):
        self._address, self._connect = address, connect

    @contextlib.contextmanager
    def page(
        self, width: int = 1280, height: int = 800, *, phone: bool = False, scripts: bool = True, scale: float = 1.0
    ) -> Iterator[Page]:
        """An empty tab.

        Args:
            width, height: of the window, px.
            phone: with a touchscreen, two pixels of the screen per px.
            scripts: whether pages may run JavaScript.
            scale: pixels of the screen per px, of a page that is no phone's: with fewer, drawing in software is fast.
        """
        with self._connect(self._address) as connection:
            browser = Protocol(connection)
            context = browser.send("Target.createBrowserContext")["browserContextId"]
            target = browser.send("Target.createTarget", url="about:blank", browserContextId=context)["targetId"]
            try:
                with self._connect(f"{self._address.split('/browser/')[0]}/page/{target}") as tab:
                    page = Page(tab)
                    size = {"width": width, "height": height, "deviceScaleFactor": 2 if phone else scale}
                    page.send("Emulation.setDeviceMetricsOverride", mobile=phone, **size)
                    page.send("Emulation.setTouchEmulationEnabled", enabled=phone)
                    page.send("Emulation.setFocusEmulationEnabled", enabled=True)
                    page.send("Emulation.setScriptExecutionDisabled", value=not scripts)
                    page.before_scripts(_ONE_SAMPLE)
                    yield page
            finally:
                browser.send("Target.disposeBrowserContext", browserContextId=context)


@contextlib.contextmanager
def open_browser() -> Iterator[Browser]:
    """Starts the system's Chromium; skips the test where there is none, or no `websockets`."""
    program = os.environ.get("SPSLAM_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip("needs Chromium: apt-get install chromium")
    client = pytest.importorskip("websockets.sync.client", reason="needs websockets: pip install 'spslam[dev]'")
    connect = functools.partial(client.connect, max_size=None, compression=None, proxy=None, open_timeout=TIMEOUT_S)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [program, *_FLAGS, f"--user-data-dir={profile}", "about:blank"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "HOME": profile},
        )
        try:
            yield Browser(_address(Path(profile) / "DevToolsActivePort", process), connect)
        finally:
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _address(port_file: Path, process: subprocess.Popen) -> str:
    """Waits for the file in which Chromium tells where it listens."""
    deadline = time.monotonic() + TIMEOUT_S
    while time.monotonic() < deadline:
        if process.poll() is not None:
            pytest.skip(f"Chromium does not start here: it ended with code {process.returncode}")
        with contextlib.suppress(OSError, ValueError):
            port, path = port_file.read_text().split()
            return f"ws://127.0.0.1:{port}{path}"
        time.sleep(0.05)
    raise AssertionError("Chromium did not open its port")
