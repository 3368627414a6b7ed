"""The report in a real browser: the 3-D view, its switches and slider, values under the pointer, print, no requests."""

import re

import numpy as np
import pytest

from spslam.evaluation.html_report import write_report
from tests.browser import open_browser
from tests.evaluation.finished_folder import write_run

WORKS = "document.querySelector('.view3d.works') !== null"
OUTPUT = "document.querySelector('.timeline output').textContent"


@pytest.fixture(scope="module")
def browser():
    with open_browser() as running:
        yield running


# Options of `write_run` by the kind of run.
KINDS = {
    "usual": {},
    "without truth": {"missing": ("ground_truth", "previews")},
    "one frame": {"missing": ("previews",), "frames": 1, "losses": ()},
    "5000 frames": {"missing": ("mesh", "previews"), "frames": 5000, "losses": ((1000, 1001), (3000, 3200))},
    "no mesh": {"missing": ("mesh", "previews", "log", "config")},
}


class Reports(dict):
    """Reports by the kind of run, written when they are asked for."""

    def __init__(self, folder):
        super().__init__()
        self.folder = folder

    def __missing__(self, kind):
        self[kind] = write_report(write_run(self.folder / kind, **KINDS[kind]))
        return self[kind]


@pytest.fixture(scope="module")
def reports(tmp_path_factory):
    return Reports(tmp_path_factory.mktemp("reports"))


def difference(first, second):
    """Share of the pixels that differ between two pictures."""
    return float((np.abs(first.astype(int) - second).max(axis=2) > 12).mean())


def test_view_turns_switches_and_follows_the_slider(browser, reports):
    with browser.page(640, 560) as page:  # few pixels, as they are drawn in software
        page.open(reports["usual"])
        page.wait_for(WORKS)
        before = page.element("canvas").picture()
        assert len(np.unique(before.reshape(-1, 3), axis=0)) > 100  # not just a background
        x, y = page.element("canvas").point()
        page.drag((x, y), (x + 160, y + 40))
        turned = page.element("canvas").picture()
        assert difference(before, turned) > 0.1
        shares = {}
        for layer in ("mesh", "path", "lost", "truth", "frustums", "current", "backs"):
            page.element(f"[data-layer={layer}]").click()
            shares[layer] = difference(turned, page.element("canvas").picture())
            page.element(f"[data-layer={layer}]").click()
        assert difference(turned, page.element("canvas").picture()) == 0
        assert shares.pop("mesh") > 0.1
        assert shares.pop("backs") > 0.1
        assert min(shares.values()) > 0, shares
        page.element(".timeline input").fill("29")
        assert page.evaluate(OUTPUT).startswith("frame 29 · 0.97 s · tracked · error probability 0.0001")
        assert difference(turned, page.element("canvas").picture()) > 0
        page.element(".timeline input").fill("12")
        assert "lost" in page.evaluate(OUTPUT)
        page.element("[data-action=follow]").click()
        assert difference(turned, page.element("canvas").picture()) > 0.5
        page.element("[data-action=reset]").click()
        assert difference(before, page.element("canvas").picture()) < 0.02  # this frame's camera has moved
        assert (page.errors, page.warnings, page.requests) == ([], [], [])


def test_mesh_is_the_packed_one(browser, reports):
    with browser.page() as page:
        page.open(reports["usual"])
        page.wait_for(WORKS)
        counts = page.evaluate("""(async () => {
            const data = JSON.parse(document.querySelector('#view-data').textContent);
            const mesh = await reportData.mesh(data.mesh);
            const far = (axis) => mesh.positions.filter((_, i) => i % 3 === axis).map(Math.abs);
            const sines = mesh.colors.every((c, i) => Math.abs(c - 127 - 120 * Math.sin(mesh.positions[i])) < 1);
            return [data.mesh.faces, mesh.faces.length, Math.max(...mesh.faces) + 1, mesh.positions.length,
                    Math.max(...far(0)), Math.max(...far(1)), sines];
        })()""")
    faces, corners, highest, numbers, x, y, colored = counts
    assert (3 * faces, 3 * highest) == (corners, numbers)
    assert faces == 12 * 4**3
    assert (round(x, 3), round(y, 3)) == (4, 3)
    assert colored


def test_wheel_scrolls_the_page_until_the_view_is_clicked(browser, reports):
    with browser.page() as page:
        page.open(reports["usual"])
        page.wait_for(WORKS)
        page.move(page.element("canvas").point())
        top = page.evaluate("window.scrollY")
        page.wheel(50)
        # To the end: a wheel that turns on where the pointer was would be the same turn, which a page cannot stop.
        page.wait_for(f"window.scrollY === {top + 50}")
        page.click(page.element("canvas").point())
        top, before = page.evaluate("window.scrollY"), page.element("canvas").picture()
        page.wheel(-300)
        assert difference(before, page.element("canvas").picture()) > 0.1
        assert page.evaluate("window.scrollY") == top


def test_charts_show_values_under_the_pointer_and_lead_the_slider(browser, reports):
    with browser.page(640, 560) as page:  # few pixels, as they are drawn in software
        page.open(reports["usual"])
        page.wait_for(WORKS)
        for index, words in enumerate((("right",), ("tracking, per frame 9 ms",), ("residual",), ("mapped surface",))):
            page.move(page.element(".line-chart .plot", index).point(20 / 29))
            text = page.element(".line-chart .readout", index).text()
            assert text.startswith("frame 20"), text
            assert all(word in text for word in words), text
        page.click(page.element(".line-chart .plot", 2).point(25 / 29))
        assert page.evaluate(OUTPUT).startswith("frame 25 ")
        assert page.element(".cursor.linked").is_visible()
        page.move(page.element(".plane-chart .plot").point())
        assert re.match(r"frame \d+\s+[\d.-]+ m right, [\d.-]+ m forward",
                        page.element(".plane-chart .readout").text())  # fmt: skip
        page.element(".line-chart .plot").focus()
        page.press("End")
        page.press("ArrowLeft")
        assert page.element(".line-chart .readout").text().startswith("frame 28")
        page.press("Escape")
        assert not page.element(".line-chart .readout").is_visible()
        assert (page.errors, page.warnings, page.requests) == ([], [], [])


def test_phone_shows_all_within_its_width_and_answers_touch(browser, reports):
    with browser.page(400, phone=True) as page:
        page.open(reports["usual"])
        page.wait_for(WORKS)
        assert page.evaluate("document.documentElement.scrollWidth") == 400
        sizes = page.evaluate("""[...document.querySelectorAll('.value-labels span, .frame-labels span, .legend')]
            .map(label => parseFloat(getComputedStyle(label).fontSize))""")
        assert min(sizes) >= 12
        page.tap(page.element(".line-chart .plot").point(0.5))
        assert page.element(".line-chart .readout").is_visible()
        before = page.element("canvas").picture()
        x, y = page.element("canvas").point()
        page.swipe((x, y), (x + 120, y))
        assert difference(before, page.element("canvas").picture()) > 0.1
        assert not page.element(".line-chart .readout").is_visible()
        assert (page.errors, page.warnings, page.requests) == ([], [], [])


SLOW = [pytest.param(kind, marks=pytest.mark.slow) for kind in ("one frame", "5000 frames", "no mesh")]


@pytest.mark.parametrize("kind", ["without truth", *SLOW])
def test_other_runs_show_themselves(browser, reports, kind):
    with browser.page() as page:
        page.open(reports[kind])
        page.wait_for(WORKS)
        assert len(np.unique(page.element("canvas").picture().reshape(-1, 3), axis=0)) > 10
        layers = page.evaluate("[...document.querySelectorAll('[data-layer]')].map(box => box.dataset.layer)")
        assert ("truth" in layers) == (kind != "without truth")
        assert ("mesh" in layers) == (kind in ("without truth", "one frame"))
        assert ("lost" in layers) == (kind != "one frame")
        if kind == "5000 frames":
            page.element(".timeline input").fill(page.evaluate("document.querySelector('.timeline input').max"))
            assert page.evaluate(OUTPUT).startswith("frame 4999 ")
            page.move(page.element(".line-chart .plot", 2).point(0.62))
            assert "frame 31" in page.element(".line-chart .readout", 2).text()
        page.element("[data-action=play]").click()
        page.element("[data-action=top]").click()
        page.element("canvas").picture()
        assert (page.errors, page.warnings, page.requests) == ([], [], [])


def test_print_has_the_picture_in_place_of_the_view(browser, reports):
    with browser.page() as page:
        page.open(reports["usual"])
        page.wait_for(WORKS)
        assert not page.element(".still img").is_visible()
        page.emulate_medium("print")
        assert page.element(".still img").is_visible()
        assert not page.element("canvas").is_visible()
        assert not page.element(".timeline").is_visible()
        pdf = page.pdf()
        assert 3 <= len(re.findall(rb"/Type\s*/Page\b", pdf)) <= 12
        page.emulate_medium("screen")
        assert page.element("canvas").is_visible()


def test_page_says_why_there_is_no_view(browser, reports):
    with browser.page() as page:
        page.before_scripts("HTMLCanvasElement.prototype.getContext = () => null")
        page.open(reports["usual"])
        page.wait_for("!document.querySelector('.without').hidden")
        text = page.element(".without").text()
        reason = "this browser has no WebGL 2, or it is off"
        assert text == f"The 3-D view can't be shown, because {reason}: a still picture in its place."
        assert page.element(".still img").is_visible()
        assert not page.element("canvas").is_visible()
        page.move(page.element(".line-chart .plot").point())
        assert page.element(".line-chart .readout").is_visible()


def test_page_works_without_scripts(browser, reports):
    with browser.page(scripts=False) as page:
        page.open(reports["usual"])
        assert page.element(".still img").is_visible()
        assert page.element("noscript p").is_visible()
        assert page.element(".line-chart svg").is_visible()
        assert not page.element("canvas").is_visible()
