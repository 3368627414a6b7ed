"""The HTML report: it shows all files of a run, leaves out missing ones, and is self-contained."""

import base64
import hashlib
import json
import re
import zlib
from html.parser import HTMLParser

import numpy as np
import pytest
import trimesh

from spslam.errors import OutputError
from spslam.evaluation.charts import nice_ticks
from spslam.evaluation.html_report import write_report
from spslam.evaluation.report_images import image_uri
from spslam.evaluation.report_view import MAX_FACES
from spslam.trajectory import Trajectory
from tests.evaluation.finished_folder import write_run

# What the 3-D view holds, deflated and in base64: any four letters may be in it.
PICTURES = ("mesh", "previews")  # take most of a report's time
PAYLOAD = r'<script type="(text/plain|application/json)".*?</script>|data:[^"]*'


class Structure(HTMLParser):
    """Collects the links and texts of a page, and checks that tags are closed in order."""

    def __init__(self):
        super().__init__()
        self.open, self.sources, self.text = [], [], []

    def handle_starttag(self, tag, attributes):
        self.sources += [value for name, value in attributes if name in ("src", "href", "data")]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.sources += [value for name, value in attributes if name in ("src", "href", "data")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def read(path):
    page = Structure()
    page.feed(path.read_text(encoding="utf-8"))
    assert page.open == []
    return page


def test_report_shows_all_sections_and_is_self_contained(tmp_path):
    path = write_report(write_run(tmp_path / "kitchen <1>"))
    assert path == tmp_path / "kitchen <1>" / "report.html"
    page = read(path)
    assert page.sources
    assert all(source.startswith("data:image/png;base64,") for source in page.sources)
    assert len(page.sources) == 1 + 4 + 3  # overview, a view with input depth, one without
    text = path.read_text()
    shown = re.sub(PAYLOAD, "", text, flags=re.DOTALL).replace('<meta http-equiv="Content-Security-Policy"', "")
    assert "http" not in shown
    assert not re.search(r"<[^>]* on\w+=", shown)
    for word in ("kitchen <1>", "<processor & co>", "Map", "Views", "Trajectory", "Error over time", "Time", "Tracking",
                 "All metrics", "Settings", "# a <comment>", "1.25 cm", "ground truth", "lost"):  # fmt: skip
        assert any(word in part for part in page.text), word


@pytest.mark.parametrize("missing", ["mesh", "ground_truth", "log", "previews", "config"])
def test_missing_files_are_left_out(tmp_path, missing):
    path = write_report(write_run(tmp_path, (missing,)))
    headings = re.findall("<h2>(.*?)</h2>", path.read_text())
    removed = {"mesh": "Map", "ground_truth": "Error over time", "log": "Time", "previews": "Views", "config": ""}[
        missing
    ]
    assert removed not in headings
    read(path)


def test_trajectory_and_metrics_are_sufficient(tmp_path):
    run = write_run(tmp_path, ("mesh", "ground_truth", "log", "previews", "config"))
    assert re.findall("<h2>(.*?)</h2>", write_report(run).read_text()) == [
        "Trajectory",
        "As in the paper",
        "All metrics",
    ]


def test_one_frame_is_sufficient(tmp_path):
    run = write_run(tmp_path, ("ground_truth",))
    Trajectory(np.zeros(1), np.eye(4)[None]).save_tum(run / "trajectory.txt")
    (run / "log.jsonl").write_text('{"tracking_ms": 0, "encode_ms": 1, "mapping_ms": 2}\n')
    read(write_report(run))


def test_an_empty_mesh_is_left_out(tmp_path):
    run = write_run(tmp_path)
    header = "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\n"
    (run / "mesh.ply").write_text(header + "element face 0\nproperty list uchar int vertex_indices\nend_header\n")
    assert "Map" not in re.findall("<h2>(.*?)</h2>", write_report(run).read_text())


def test_writing_again_gives_the_same_bytes(tmp_path):
    run = write_run(tmp_path)
    first = write_report(run).read_bytes()
    assert write_report(run).read_bytes() == first


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("metrics.json", "{", "metrics.json: isn't valid JSON"),
        ("metrics.json", "[1]", "metrics.json: must contain an object with named values, got list"),
        ("log.jsonl", "{}\nx\n", "log.jsonl: isn't valid JSON"),
        ("trajectory.txt", "1 2 3\n", "trajectory.txt, line 1: must be"),
        ("mesh.ply", "nonsense", "mesh.ply: can't be read as a mesh"),
        ("previews/camera.json", '{"width": 3}', "camera.json: must contain a camera"),
    ],
)
def test_errors_name_the_damaged_file(tmp_path, name, content, message):
    run = write_run(tmp_path)
    (run / name).write_text(content)
    with pytest.raises(Exception, match=re.escape(message)) as caught:
        write_report(run)
    assert type(caught.value).__module__ == "spslam.errors"
    assert not (run / "report.html").exists()


def test_a_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(OutputError, match="must be the output folder of a finished run, but has no trajectory.txt"):
        write_report(tmp_path)


@pytest.mark.parametrize(("low", "high"), [(0, 1), (-3.2, 7.9), (0, 1e-6), (0, 123456), (5, 5.001)])
def test_ticks_are_round_and_span_the_range(low, high):
    ticks = nice_ticks(low, high)
    assert ticks[0] <= low + 1e-12
    assert ticks[-1] >= high - 1e-9 * abs(high)
    assert 2 <= len(ticks) <= 12


def scripts(text):
    """What the page runs: its own scripts, and the library that they inflate."""
    library = re.search(r'<script type="text/plain" id="view-library">(.*?)</script>', text)[1]
    own = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    return [*own, zlib.decompress(base64.b64decode(library)).decode()]


def test_policy_allows_the_scripts_of_the_page_alone(tmp_path):
    text = write_report(write_run(tmp_path, PICTURES)).read_text()
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1]
    allowed = re.search(r"script-src ([^;]*)", policy)[1].split()
    found = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts(text)]
    assert allowed == [f"'sha256-{digest}'" for digest in found]
    assert policy.startswith("default-src 'none';")
    assert "The MIT License" in scripts(text)[-1]


def test_what_a_run_brings_cannot_leave_its_element(tmp_path):
    evil = "</script></pre><script>alert(1)</script>"
    run = write_run(tmp_path / "x", PICTURES)
    (run / "config.yaml").write_text(f"# {evil}\n")
    metrics = json.loads((run / "metrics.json").read_text()) | {"command": evil, evil: evil, "version": evil}
    (run / "metrics.json").write_text(json.dumps(metrics))
    text = write_report(run).read_text()
    assert evil not in text
    assert "alert(1)" not in "".join(scripts(text))
    read(run / "report.html")


def test_report_has_command_and_changed_options(tmp_path):
    run = write_run(tmp_path, PICTURES)
    (run / "config.yaml").write_text("preset: fast\nresolved: true\ndataset:\n  type: folder\n  path: my data\n")
    command = "spslam run folder --data 'my data' --preset fast"
    metrics = json.loads((run / "metrics.json").read_text()) | {"command": command}
    (run / "metrics.json").write_text(json.dumps(metrics))
    page = read(write_report(run))
    text = "|".join(page.text)
    assert command in text
    assert "dataset.path|my data|null" in text
    assert "preset|fast|balanced" in text
    assert "tracking." not in text.partition("Command and options")[2].partition("All metrics")[0]


@pytest.mark.parametrize("value", ["text", None, [1], {}, 1e999, True])
def test_metrics_and_log_of_another_type_are_no_error(tmp_path, value):
    run = write_run(tmp_path, PICTURES)
    metrics = {key: value for key in ("frames", "fps", "ate_rmse_cm", "wall_s", "command", "tracking_iterations",
                                      "first_mapping_s", "mesh_s", "skipped_frames")}  # fmt: skip
    (run / "metrics.json").write_text(json.dumps(metrics).replace("Infinity", "1e999"))
    line = {key: value for key in ("tracking_ms", "encode_ms", "residual_cm", "error_probability", "inlier_share")}
    (run / "log.jsonl").write_text((json.dumps(line).replace("Infinity", "1e999") + "\n") * 30)
    read(write_report(run))


def test_page_of_a_large_mesh_and_a_long_run_stays_below_8_megabytes(tmp_path):
    run = write_run(tmp_path, ("previews",), frames=5000, losses=tuple((i, i + 1) for i in range(10, 4990, 7)))
    rows, columns = np.mgrid[:500, :500]
    generator = np.random.default_rng(0)
    points = np.stack([columns / 100, rows / 100, 3 + 0.05 * generator.random((500, 500))], axis=-1).reshape(-1, 3)
    colors = generator.integers(0, 256, (250_000, 4), dtype=np.uint8)
    corner = (500 * rows + columns)[:-1, :-1].reshape(-1, 1)
    faces = np.concatenate([corner + (0, 1, 500), corner + (1, 501, 500)])
    trimesh.Trimesh(points, faces, vertex_colors=colors, process=False).export(run / "mesh.ply")
    text = write_report(run).read_text()
    mesh = json.loads(re.search(r'id="view-data">(.*?)</script>', text)[1])["mesh"]
    assert len(text.encode()) < 8_000_000
    assert 100_000 < mesh["faces"] <= MAX_FACES
    values = [json.loads(data) for data in re.findall(r'<script type="application/json">(.*?)</script>', text)]
    assert len(values) == 6
    assert all(len(chart["frames"]) <= 10 * 500 for chart in values)


def test_what_no_page_can_hold_is_no_error(tmp_path):
    run = write_run(tmp_path, PICTURES)
    metrics = json.loads((run / "metrics.json").read_text()) | {"device_name": "\ud800", "fps": 1e308}
    (run / "metrics.json").write_text(json.dumps(metrics))
    lines = (run / "trajectory.txt").read_text().splitlines()
    lines[5] = "0.133333 1e39 -1e39 1e39 0 0 0 1"
    (run / "trajectory.txt").write_text("\n".join(lines) + "\n")
    read(write_report(run))


def test_pictures_that_png_does_not_suit_are_jpeg():
    noise = np.random.default_rng(0).integers(0, 256, (400, 640, 3), dtype=np.uint8)
    assert image_uri(noise).startswith("data:image/jpeg;base64,")
    assert len(image_uri(noise)) < 300_000
    assert image_uri(np.zeros((400, 640, 3), np.uint8)).startswith("data:image/png;base64,")
