"""Writes the picture of docs/viewer.md from a finished run: ``python docs/generate_viewer_picture.py runs/demo``."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import cv2

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from spslam.viewer.options import ViewerOptions  # noqa: E402
from spslam.viewer.replay import open_replay  # noqa: E402
from tests.browser import open_browser  # noqa: E402

WIDTH, HEIGHT = 1280, 800
SETTLING_S = 15.0  # the page fades in, slowly where a processor draws it
_CLOSE_NOTES = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(button => button.click())"


def main(output: Path, path: Path, width: int) -> None:
    """Write a picture of the page that `spslam view OUTPUT` opens."""
    with (
        open_replay(output, ViewerOptions(port=0)) as replay,
        open_browser() as browser,
        browser.page(width, HEIGHT) as page,
    ):
        page.open(replay.url)
        page.wait_for("document.body.textContent.includes('tracked')")
        time.sleep(SETTLING_S)
        page.evaluate(_CLOSE_NOTES)
        time.sleep(1.0)
        path.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path), page.screenshot()[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3, 4):
        raise SystemExit("usage: python docs/generate_viewer_picture.py OUTPUT [PICTURE.jpg [WIDTH]]")
    target = Path(sys.argv[2]) if len(sys.argv) > 2 else ROOT / "docs" / "images" / "viewer.jpg"
    main(Path(sys.argv[1]), target, int(sys.argv[3]) if len(sys.argv) > 3 else WIDTH)
