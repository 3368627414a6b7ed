"""A page in the browser of `tests/browser.py`: acts as mouse, finger and keyboard, asks, takes pictures."""

from __future__ import annotations

import base64
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

TIMEOUT_S = 240.0  # drawing in software, beside other work
_LOCAL = ("file:", "data:", "blob:", "about:")
# Reading pixels back is slow in software.
_EXPECTED_WARNING = "GPU stall due to ReadPixels"
_TWO_FRAMES = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))"
_A4_INCHES = {"paperWidth": 8.27, "paperHeight": 11.69}

Point = tuple[float, float]


class Protocol:
    """Calls over the DevTools protocol.

    Args:
        connection: a web socket to the browser, or to one of its tabs.
    """

    def __init__(self, connection: Any):
        self._connection, self._number = connection, 0

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Calls a method of the DevTools protocol and returns its result."""
        self._number += 1
        self._connection.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        deadline = time.monotonic() + TIMEOUT_S
        while True:
            message = json.loads(self._connection.recv(timeout=max(deadline - time.monotonic(), 0.01)))
            if message.get("id") == self._number:
                assert "error" not in message, message["error"]
                return message["result"]
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        """Called with events; does nothing."""


class Page(Protocol):
    """One tab.

    Attributes:
        errors: what the console got as an error, and exceptions that nothing caught.
        warnings: what it got as a warning.
        requests: addresses of everything that was requested; files, data and blobs left out.
    """

    def __init__(self, connection: Any):
        super().__init__(connection)
        self._pointer = 0.0, 0.0
        self.errors: list[str] = []
        self.warnings: list[str] = []
        self.requests: list[str] = []
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.send(f"{domain}.enable")

    def open(self, address: str | Path) -> None:
        """Opens an address or a file."""
        self.send("Page.navigate", url=address.absolute().as_uri() if isinstance(address, Path) else address)
        self.wait_for("document.readyState === 'complete'")

    def before_scripts(self, script: str) -> None:
        """Runs JavaScript in each page opened from now on, before its own."""
        self.send("Page.addScriptToEvaluateOnNewDocument", source=script)

    def save_downloads(self, folder: Path) -> None:
        """Saves what the page downloads there, without asking."""
        context = self.send("Target.getTargetInfo")["targetInfo"]["browserContextId"]
        where = {"browserContextId": context, "downloadPath": str(folder)}
        self.send("Browser.setDownloadBehavior", behavior="allow", **where)

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression; a promise is waited for."""
        result = self.send("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def wait_for(self, condition: str | Callable[[], Any], timeout_s: float = TIMEOUT_S) -> Any:
        """Waits until a JavaScript expression, or a function, gives something true; returns that."""
        deadline = time.monotonic() + timeout_s
        while True:
            value = condition() if callable(condition) else self.evaluate(condition)
            if value:
                return value
            assert time.monotonic() < deadline, f"not true after {timeout_s} s: {condition}; errors: {self.errors}"
            time.sleep(0.05)

    def draw(self) -> None:
        """Returns once two frames were drawn: the second one shows all that the first one was asked to."""
        self.evaluate(_TWO_FRAMES)

    def element(self, selector: str, number: int = 0) -> Element:
        """The element of a CSS selector, of several the one of that number."""
        return Element(self, f"document.querySelectorAll({json.dumps(selector)})[{number}]")

    def screenshot(self, path: Path | None = None, **options: Any) -> np.ndarray:
        """The window's pixels, uint8 [H, W, 3] RGB; also written to a PNG file where a path is given."""
        options = {"format": "png", "optimizeForSpeed": True, **options}
        content = base64.b64decode(self.send("Page.captureScreenshot", **options)["data"])
        if path is not None:
            path.write_bytes(content)
        return cv2.cvtColor(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)

    def pdf(self) -> bytes:
        """As it is printed on A4."""
        return base64.b64decode(self.send("Page.printToPDF", **_A4_INCHES)["data"])

    def emulate_medium(self, medium: str) -> None:
        """Shows it as on `screen`, or as in `print`."""
        self.send("Emulation.setEmulatedMedia", media=medium)

    def move(self, point: Point) -> None:
        """Moves the mouse to a point of the window, in pixels."""
        self._mouse("mouseMoved", point)

    def click(self, point: Point) -> None:
        """Clicks at a point of the window, in pixels."""
        self.move(point)
        self._mouse("mousePressed", point, button="left", buttons=1, clickCount=1)
        self._mouse("mouseReleased", point, button="left", clickCount=1)

    def drag(self, start: Point, end: Point) -> None:
        """Drags with the left button between two points of the window, in pixels."""
        self.move(start)
        self._mouse("mousePressed", start, button="left", buttons=1, clickCount=1)
        for share in np.linspace(0, 1, 10):
            self._mouse("mouseMoved", _between(start, end, share), button="left", buttons=1)
        self._mouse("mouseReleased", end, button="left", clickCount=1)

    def wheel(self, down: float) -> None:
        """Turns the wheel where the mouse is; `down` in pixels."""
        self._mouse("mouseWheel", self._pointer, deltaX=0, deltaY=down)

    def tap(self, point: Point) -> None:
        """Touches a point of the window, in pixels."""
        self._touch("touchStart", point)
        self._touch("touchEnd")

    def swipe(self, start: Point, end: Point) -> None:
        """Moves one finger between two points of the window, in pixels."""
        self._touch("touchStart", start)
        for share in (0.5, 1):
            self._touch("touchMove", _between(start, end, share))
        self._touch("touchEnd")

    def press(self, key: str) -> None:
        """Presses a key, such as `ArrowLeft`, where the focus is."""
        for kind in ("keyDown", "keyUp"):
            self.send("Input.dispatchKeyEvent", type=kind, key=key, code=key)

    def foreign_requests(self, host: str) -> list[str]:
        """Requests to any other host than `host` (with its port)."""
        return [url for url in self.requests if url.split("/")[2] != host]

    def _mouse(self, kind: str, point: Point, **more: Any) -> None:
        self._pointer = point
        self.send("Input.dispatchMouseEvent", type=kind, x=point[0], y=point[1], **more)

    def _touch(self, kind: str, *points: Point) -> None:
        self.send("Input.dispatchTouchEvent", type=kind, touchPoints=[{"x": x, "y": y} for x, y in points])

    def _note(self, message: dict[str, Any]) -> None:
        """Keeps what an event tells of errors and requests."""
        about = message.get("params", {})
        match message.get("method"):
            case "Runtime.exceptionThrown":
                details = about["exceptionDetails"]
                self.errors.append(details.get("exception", {}).get("description", details["text"]))
            case "Runtime.consoleAPICalled":
                self._note_line(about["type"], " ".join(str(value.get("value", value)) for value in about["args"]))
            case "Log.entryAdded":
                self._note_line(about["entry"]["level"], f"{about['entry']['text']} {about['entry'].get('url', '')}")
            case "Network.requestWillBeSent" if not about["request"]["url"].startswith(_LOCAL):
                self.requests.append(about["request"]["url"])
            case "Network.webSocketCreated":
                self.requests.append(about["url"])

    def _note_line(self, level: str, text: str) -> None:
        if level == "error":
            self.errors.append(text)
        elif level == "warning" and _EXPECTED_WARNING not in text:
            self.warnings.append(text)


@dataclass(frozen=True)
class Element:
    """An element of a page, looked up anew by each method.

    Attributes:
        page: that has it.
        found: JavaScript expression of it.
    """

    page: Page
    found: str

    def ask(self, expression: str) -> Any:
        """The value of a JavaScript expression about it, which it calls `it`."""
        return self.page.evaluate(f"(it => {expression})({self.found})")

    def point(self, across: float = 0.5, down: float = 0.5) -> Point:
        """A point of it in px of the window, scrolled into view; by default its center."""
        self.ask("it.scrollIntoViewIfNeeded()")
        x, y, width, height = self._box()
        return x + across * width, y + down * height

    def click(self) -> None:
        """Clicks its center with the mouse."""
        self.page.click(self.point())

    def fill(self, value: str) -> None:
        """Sets the value of an input, as its user would."""
        events = "['input', 'change'].forEach(name => it.dispatchEvent(new Event(name, {bubbles: true})))"
        self.ask(f"{{ it.value = {json.dumps(value)}; {events} }}")

    def focus(self) -> None:
        """Gives it the focus."""
        self.ask("it.focus()")

    def text(self) -> str:
        """Its text as it is shown."""
        return self.ask("it.innerText")

    def is_visible(self) -> bool:
        """Whether it takes up room and is not hidden."""
        shown = "it.checkVisibility({visibilityProperty: true})"
        return self.ask(f"{shown} && it.getBoundingClientRect().width * it.getBoundingClientRect().height > 0")

    def picture(self) -> np.ndarray:
        """Its pixels, uint8 [H, W, 3] RGB, once two frames were drawn."""
        self.ask("it.scrollIntoViewIfNeeded()")
        self.page.draw()
        x, y, width, height = self._box()
        left, top = self.page.evaluate("[visualViewport.pageLeft, visualViewport.pageTop]")
        # Chromium draws from whole pixels of the window on, rounded likewise.
        x, y = left + math.floor(x + 0.5), top + math.floor(y + 0.5)
        return self.page.screenshot(clip={"x": x, "y": y, "width": width, "height": height, "scale": 1})

    def _box(self) -> tuple[float, float, float, float]:
        """Left, top, width, height in px of the window."""
        x, y, width, height = self.ask("(({x, y, width, height}) => [x, y, width, height])(it.getBoundingClientRect())")
        return x, y, width, height


def _between(start: Point, end: Point, share: float) -> Point:
    return start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1])
