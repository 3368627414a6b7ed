"""What a notebook shows: escaped, self-contained, and of sensible size."""

import html
import re
import sys
import types

import numpy as np
import pytest

from spslam import notebook
from spslam.meshing import TriangleMesh
from spslam.trajectory import Trajectory
from tests.system.sequences import Recorded, run_on


def loaded_from(text):
    """Addresses that the HTML would load something from."""
    return re.findall(r'(?:src|href)\s*=\s*["\']?(https?://[^"\' ]+)', html.unescape(text))


@pytest.fixture
def mesh():
    vertices = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1]], np.float32)
    faces, colors = np.array([[0, 2, 1]], np.int32), np.full((3, 3), 200, np.uint8)
    return TriangleMesh(vertices, faces, colors, np.tile(np.float32([0, 0, -1]), (3, 1)))


def test_trajectory_shows_its_path_and_figures():
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.arange(5)
    shown = Trajectory(np.arange(5.0), poses, np.array([0, 0, 1, 0, 0], bool))._repr_html_()
    assert "<svg" in shown
    assert "stroke-dasharray" in shown
    assert "5 (1 lost)" in shown
    assert "4.00 m" in shown
    assert "4.0 s" in shown


@pytest.mark.parametrize("count", [0, 1])
def test_trajectories_without_a_path_show_their_figures(count):
    shown = Trajectory(np.arange(float(count)), np.tile(np.eye(4), (count, 1, 1)))._repr_html_()
    assert f"<td>{count}</td>" in shown


def test_lost_trajectory_shows_its_figures():
    assert "2 (2 lost)" in Trajectory([0, 1], np.tile(np.eye(4), (2, 1, 1)), [True, True])._repr_html_()


def test_mesh_can_be_turned_around_offline(mesh):
    shown = mesh._repr_html_()
    assert shown.startswith("<iframe srcdoc=")
    assert "<td>1</td>" in shown
    assert loaded_from(shown) == []
    assert len(shown) < 2e6


def test_empty_and_huge_meshes_show_their_figures(mesh, monkeypatch):
    empty = TriangleMesh(mesh.vertices, mesh.faces[:0], mesh.colors, mesh.normals)
    assert "iframe" not in empty._repr_html_()
    monkeypatch.setattr(notebook, "_MAX_FACES", 0)
    assert "not shown beyond" in mesh._repr_html_()


def test_what_is_shown_is_escaped():
    assert "<script>" not in notebook.table_html({"<script>": "<script>"}, "<script>")


def test_run_shows_its_progress_in_a_notebook_only(monkeypatch, tmp_path):
    """IPython is played by a module of its name."""
    assert not notebook.in_notebook()
    shown = []

    class Handle:
        def update(self, what):
            shown.append(what._repr_html_())

    def display(what, display_id):
        shown.append(what._repr_html_())
        return Handle()

    shell = type("ZMQInteractiveShell", (), {})()
    ipython = types.SimpleNamespace(get_ipython=lambda: shell, display=types.SimpleNamespace(display=display))
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    run_on(monkeypatch, Recorded(3), tmp_path / "run")
    assert "3/3 frames" in shown[-1]
    assert "<progress" in shown[0]
    assert 'value="1.0000"' in shown[-1]
