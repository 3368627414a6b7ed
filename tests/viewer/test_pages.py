"""The viewer's page in a real browser: it draws, its controls act, and it asks nobody else for anything."""

import time

import numpy as np
import pytest

from spslam.run.observer import ObservedRun
from spslam.run.sequence import RunRequest, run_sequence
from spslam.slam.system import SlamSystem
from spslam.viewer.options import ViewerOptions
from spslam.viewer.run_viewer import open_viewer
from tests.browser import open_browser
from tests.system.sequences import Recorded, settings
from tests.viewer.test_run_viewer import wait_for
from tests.viewer.worlds import FRAMES, SIZES, finished_run, replay

transforms = pytest.importorskip("viser.transforms", reason="viser is not installed: pip install 'spslam[viewer]'")

# A small window, which software draws fast; of the 3-D view, what lies beside the panel.
WINDOW = {"width": 800, "height": 480, "scale": 0.5}
VIEW = np.s_[60:200, 0:200]
# viser warns of rendering in software, in front of the view.
CLOSE_NOTICE = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(button => button.click())"
# Software rendering on a busy machine.
PATIENCE_S = 240.0
LONGEST_STOP_S = 20.0  # of a run that waits for a page


def view(page):
    return page.screenshot()[VIEW].astype(int)


def is_drawn(page):
    """Whether a part of the view is not white, and nothing moves any more: pages fade in, turned views run out."""
    page.evaluate(CLOSE_NOTICE)
    image = view(page)
    if (image.min(axis=2) < 200).mean() < 0.02:
        return False
    time.sleep(0.5)
    page.draw()
    return np.abs(view(page) - image).mean() < 0.2


def stand_behind_the_camera(opened):
    """Looks at the frustum from behind, in the part of the window that the panel leaves free."""
    frustum = opened._sink._layers._frustum
    axes = transforms.SO3(np.array(frustum.wxyz)).as_matrix()
    right, forward, center = axes[:, 0], axes[:, 2], np.array(frustum.position)
    for client in opened._sink.server.get_clients().values():
        client.camera.position = center - 1.2 * forward + 0.3 * right
        client.camera.look_at = center + 0.3 * right


def difference(page, before):
    """Share of the view's pixels that are another color."""
    return (np.abs(view(page) - before).max(axis=2) > 24).mean()


def switch(page, label):
    """Clicks the checkbox of that label."""
    found = (
        "[...document.querySelectorAll('label')].filter(label => label.textContent.trim() === NAME)"
        ".map(label => { let box = null; for (let at = label; at && !box; at = at.parentElement)"
        " box = at.querySelector('input[type=checkbox]'); box.click(); return true })[0]"
    )
    assert page.evaluate(found.replace("NAME", repr(label))), label


@pytest.fixture(scope="module")
def browser():
    with open_browser() as running:
        yield running


@pytest.fixture
def page(browser):
    with browser.page(**WINDOW) as opened_page:
        yield opened_page


def test_page_of_a_finished_run(page):
    with replay() as opened:
        host = opened.url.split("/")[2]
        page.open(opened.url)
        page.wait_for(lambda: is_drawn(page), PATIENCE_S)

        first = view(page)
        page.drag((150, 300), (270, 340))
        page.wait_for(lambda: difference(page, first) > 0.02, PATIENCE_S)

        stand_behind_the_camera(opened)
        page.wait_for(lambda: is_drawn(page), PATIENCE_S)
        with_mesh = view(page)
        switch(page, "Mesh")
        page.wait_for(lambda: difference(page, with_mesh) > 0.02, PATIENCE_S)
        assert not opened._sink._layers._roots["mesh"].visible
        before = view(page)
        frustum = opened._sink._layers._frustum
        place = np.array(frustum.position)
        page.evaluate("document.querySelector('[role=slider]').focus()")
        for _ in range(FRAMES // 2):
            page.press("ArrowLeft")
        page.wait_for(lambda: np.abs(np.array(frustum.position) - place).max() > 1e-3, PATIENCE_S)
        page.wait_for(lambda: difference(page, before) > 0.005, PATIENCE_S)
        switch(page, "Mesh")
        page.wait_for(lambda: difference(page, before) > 0.02, PATIENCE_S)
        assert opened._sink._layers._roots["mesh"].visible
        page.wait_for(f"document.body.textContent.includes('of {FRAMES}')", PATIENCE_S)

        assert page.errors == []
        assert page.foreign_requests(host) == []


@pytest.mark.parametrize("width", [1280, 400])
def test_page_fits_its_window(browser, width):
    with replay() as opened, browser.page(width, phone=width < 600) as page:
        page.open(opened.url)
        page.wait_for("document.body.textContent.includes('tracked')", PATIENCE_S)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.evaluate("[...document.querySelectorAll('button')].some(b => b.textContent.includes('Play'))")


def test_page_of_a_camera_shows_its_images_and_has_nothing_to_pause(page):
    recorded = Recorded(2)
    config = settings("device=cpu")
    system = SlamSystem(config, recorded.camera)
    with open_viewer(ViewerOptions(port=0)) as viewer:
        viewer.begin(ObservedRun("camera", config, recorded.camera, can_pause=False), system.state)
        page.open(viewer.url)
        for frame in (recorded[0], recorded[1]):
            wait_for(lambda: viewer._wants_update)
            viewer.observe(system.process(frame), frame)
        page.wait_for("document.body.textContent.includes('tracked')", PATIENCE_S)
        page.wait_for("document.querySelectorAll('img').length >= 2", PATIENCE_S)
        labels = page.evaluate("[...document.querySelectorAll('button')].map(button => button.textContent)")
        assert "Screenshot" in labels
        assert not {"Pause", "Continue", "Step"} & set(labels)
        assert page.errors == []


@pytest.mark.sweep  # two pages that draw in software at once can take minutes
def test_view_follows_the_camera_in_one_browser_only(browser, page):
    with replay() as opened, browser.page(**WINDOW) as other:
        for each in (page, other):
            each.open(opened.url)
            each.wait_for(lambda each=each: is_drawn(each), PATIENCE_S)
        before = view(page), view(other)
        switch(page, "Follow camera")
        page.wait_for(lambda: difference(page, before[0]) > 0.05, PATIENCE_S)
        assert difference(other, before[1]) < 0.02
        assert other.errors == []


@pytest.mark.sweep  # more than a minute of drawing in software
def test_screenshot_is_saved(page, tmp_path):
    with replay() as opened:
        page.save_downloads(tmp_path)
        page.open(opened.url)
        page.wait_for(lambda: is_drawn(page), PATIENCE_S)
        page.evaluate(
            "[...document.querySelectorAll('button')].find(b => b.textContent.includes('Screenshot')).click()"
        )
        saved = page.wait_for(lambda: list(tmp_path.glob("*.png")), PATIENCE_S)
        assert saved[0].read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_page_of_a_running_run(page, tmp_path):
    """The mesh grows on the page of a run, which its button pauses and steps."""
    with open_viewer(ViewerOptions(port=0)) as viewer:
        page.open(viewer.url)
        clicked = []

        def click(label):
            """Clicks a button once it is there: the panel is drawn after the 3-D view, and labels change later."""
            found = f"[...document.querySelectorAll('button')].filter(button => button.textContent === {label!r})"
            page.wait_for(f"{found}.map(button => button.click() === undefined)[0]", PATIENCE_S)

        def progress(done, total, report):
            # The run waits for the page, which is slower here than any user's; its next frame brings the next update.
            deadline = time.monotonic() + LONGEST_STOP_S
            while not clicked and time.monotonic() < deadline:
                if is_drawn(page):
                    click("Pause")
                    page.wait_for(viewer.is_paused, PATIENCE_S)
                    clicked.append(done)
                    click("Continue")
                    page.wait_for(lambda: not viewer.is_paused(), PATIENCE_S)

        request = RunRequest(settings(*SIZES), None, tmp_path / "run", slice(0, FRAMES, 1), mesh=False)
        run_sequence(request, progress, viewer)
    assert clicked
    trajectory = "trajectory.txt"
    assert (tmp_path / "run" / trajectory).read_bytes() == (finished_run() / trajectory).read_bytes()
