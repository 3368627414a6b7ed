"""The HTML report: it shows all files of a run, leaves out missing ones, and is self-contained."""

import json
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
import trimesh

from spslam.camera import Camera
from spslam.errors import OutputError
from spslam.evaluation.charts import nice_ticks
from spslam.evaluation.html_report import write_report
from spslam.geometry import pose_from
from spslam.trajectory import Trajectory

CAMERA = Camera(64, 48, 55.0, 55.0, 31.5, 23.5)
FRAMES = 30


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


def trajectory_poses():
    return np.stack([pose_from(np.eye(3), np.array([0.02 * i, 0.01 * np.sin(i), 0.03 * i])) for i in range(FRAMES)])


def write_run(folder, mesh=True, ground_truth=True, log=True, previews=True, config=True):
    folder.mkdir(exist_ok=True)
    times, poses = np.arange(FRAMES) / 30, trajectory_poses()
    lost = np.zeros(FRAMES, bool)
    lost[12:14] = True
    Trajectory(times, poses, lost).save_tum(folder / "trajectory.txt")
    metrics = {"frames": FRAMES, "fps": 12.5, "ate_rmse_cm": 1.25, "wall_s": 3.0, "device_name": "<processor & co>"}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    if previews or ground_truth:
        (folder / "previews").mkdir(exist_ok=True)
        (folder / "previews" / "camera.json").write_text(json.dumps(vars(CAMERA)))
    if ground_truth:
        moved = pose_from(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), np.array([1.0, 2, 3])) @ poses
        Trajectory(times[::2], moved[::2]).save_tum(folder / "previews" / "ground_truth.txt")
    if previews:
        for row in (0, FRAMES - 1):
            cv2.imwrite(str(folder / "previews" / f"frame-{row:06d}.png"), np.full((48, 64, 3), 99, np.uint8))
        cv2.imwrite(str(folder / "previews" / "depth-000000.png"), np.full((48, 64), 2000, np.uint16))
    if mesh:
        room = trimesh.creation.box((8, 6, 8)).subdivide().subdivide()
        room.visual.vertex_colors = np.full((len(room.vertices), 4), 180, np.uint8)
        room.export(folder / "mesh.ply")
    if log:
        lines = [
            {"frame": i, "tracking_ms": 9.0, "encode_ms": 0, "mapping_ms": 80.0 * (i % 5 == 0),
             "residual_cm": None if i == 0 else 0.5, "inlier_share": 0.9}
            for i in range(FRAMES)
        ]  # fmt: skip
        (folder / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    if config:
        (folder / "config.yaml").write_text("# a <comment>\nseed: 0\n")
    return folder


def test_report_shows_all_sections_and_is_self_contained(tmp_path):
    path = write_report(write_run(tmp_path / "kitchen <1>"))
    assert path == tmp_path / "kitchen <1>" / "report.html"
    page = read(path)
    assert page.sources
    assert all(source.startswith("data:image/png;base64,") for source in page.sources)
    assert len(page.sources) == 1 + 4 + 3  # overview, a view with input depth, one without
    text = path.read_text()
    assert "http" not in re.sub('data:[^"]*', "", text)
    assert "<script" not in text
    for word in ("kitchen <1>", "<processor & co>", "Map", "Views", "Trajectory", "Error over time", "Time", "Tracking",
                 "All metrics", "Settings", "# a <comment>", "1.25 cm", "ground truth", "lost"):  # fmt: skip
        assert any(word in part for part in page.text), word


@pytest.mark.parametrize("missing", ["mesh", "ground_truth", "log", "previews", "config"])
def test_missing_files_are_left_out(tmp_path, missing):
    path = write_report(write_run(tmp_path, **{missing: False}))
    headings = re.findall("<h2>(.*?)</h2>", path.read_text())
    removed = {"mesh": "Map", "ground_truth": "Error over time", "log": "Time", "previews": "Views", "config": ""}[
        missing
    ]
    assert removed not in headings
    read(path)


def test_trajectory_and_metrics_are_sufficient(tmp_path):
    run = write_run(tmp_path, mesh=False, ground_truth=False, log=False, previews=False, config=False)
    assert re.findall("<h2>(.*?)</h2>", write_report(run).read_text()) == [
        "Trajectory",
        "As in the paper",
        "All metrics",
    ]


def test_one_frame_is_sufficient(tmp_path):
    run = write_run(tmp_path, ground_truth=False)
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
