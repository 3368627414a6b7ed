"""The live examples run, and the pages of the documentation show them as they are."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.live.realsense_sdk import load_sdk, record
from tests.system.sequences import Recorded

ROOT = Path(__file__).parents[2]
EXAMPLES, DOCS = ROOT / "examples", ROOT / "docs"
PAGES = {"live_realsense.py": "library.md", "live_source.py": "live.md", "ros2_node.py": "ros2.md"}
# Loads libusb from its wheel before the example imports the SDK, as the tests do.
RUN = "import runpy, sys; from tests.live.realsense_sdk import load_sdk; load_sdk(); sys.argv = sys.argv[1:]; "
RUN += "runpy.run_path(sys.argv[0], run_name='__main__')"


def run(*command, cwd):
    variables = {**os.environ, "PYTHONPATH": str(ROOT)}
    arguments = [sys.executable, *map(str, command)]
    return subprocess.run(arguments, env=variables, capture_output=True, text=True, cwd=cwd, timeout=200)


def python_blocks(page):
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("example", PAGES)
def test_pages_show_the_examples_as_they_are(example):
    assert (EXAMPLES / example).read_text(encoding="utf-8") in python_blocks(DOCS / PAGES[example])


def test_the_notebook_page_shows_the_cells():
    cells = json.loads((EXAMPLES / "notebook.ipynb").read_text(encoding="utf-8"))["cells"]
    code = ["".join(cell["source"]) + "\n" for cell in cells if cell["cell_type"] == "code"]
    assert python_blocks(DOCS / "notebook.md") == code
    assert not [cell for cell in cells if cell.get("outputs")]


def test_the_realsense_loop_tracks_a_recording_of_the_sdk(tmp_path):
    dataset = Recorded(12)
    record(load_sdk(), tmp_path / "room.db3", dataset, dataset.camera)
    ended = run("-c", RUN, EXAMPLES / "live_realsense.py", "room.ply", "--recording", "room.db3", cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    lines = ended.stdout.splitlines()
    ending = re.fullmatch(
        r"SlamSystem\(160x120, cpu, (\d+) frames \(0 lost\), \d+ voxels\): room.ply, trajectory.txt", lines[-1]
    )
    assert ending, lines[-1]
    # On a busy machine the SDK finds fewer pairs of depth and color; of those that it gives none is left out.
    assert len([line for line in lines if line.startswith("at (")]) == int(ending[1]) >= 6
    assert (tmp_path / "room.ply").stat().st_size > 10_000


def test_a_source_of_ones_own_makes_a_live_run(tmp_path):
    ended = run(EXAMPLES / "live_source.py", "out", "--frames", 6, cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert "FrameReport(frame 0, tracked, at (0.000, 0.000, 0.000) m" in ended.stdout
    assert re.search(r"\d frames, \d dropped, p99 \d+ ms$", ended.stdout)
    assert (tmp_path / "out" / "report.html").is_file()


def test_the_notebook_runs(tmp_path, monkeypatch):
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    notebook = nbformat.read(EXAMPLES / "notebook.ipynb", as_version=4)
    nbclient.NotebookClient(notebook, timeout=200, resources={"metadata": {"path": str(tmp_path)}}).execute()
    results = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    text = "".join(str(output.get("data", output.get("text"))) for output in results)
    assert "SlamSystem(160x120, cpu, 30 frames (0 lost)" in text
    assert "Trajectory(30 poses, 0 lost, 1.0 s): 0." in text
    assert "TriangleMesh(" in text
    assert {"room.glb", "trajectory.txt", "system.safetensors"} <= {path.name for path in tmp_path.iterdir()}
