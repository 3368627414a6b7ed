"""The file names of a run's output folder: where they lead, and that they are written down once."""

import ast
from pathlib import Path

import pytest

from spslam.run_folder import MESH_FORMATS, RunFolder

PACKAGE = Path(__file__).parent.parent / "spslam"
FOLDER = RunFolder(Path("out"))


def test_files_are_distinct_and_in_the_folder():
    files = FOLDER.files()
    assert len(set(files)) == len(files)
    assert {path.parent for path in files} == {FOLDER.path}
    assert {FOLDER.mesh_as(file_format) for file_format in MESH_FORMATS} <= set(files)
    assert FOLDER.mesh in files


def test_rows_with_a_preview_are_found_in_order(tmp_path):
    folder = RunFolder(tmp_path)
    assert folder.preview_rows() == []
    folder.previews.mkdir()
    for row in (12, 3, 1_000_000):
        folder.color_preview(row).touch()
    folder.depth_preview(7).touch()
    (folder.previews / "frame-7.png").touch()
    (folder.previews / "frame-last.png").touch()
    assert folder.preview_rows() == [3, 12, 1_000_000]


def test_segments_are_in_the_order_of_their_numbers(tmp_path):
    folder = RunFolder(tmp_path)
    for number in (10, 2, 1):
        folder.segment(number).touch()
    (tmp_path / "segment-last.txt").touch()
    assert folder.segments() == [folder.segment(number) for number in (1, 2, 10)]
    assert set(folder.segments()) <= set(folder.files())


def test_a_run_has_finished_when_nothing_is_left_to_resume(tmp_path):
    folder = RunFolder(tmp_path)
    assert not folder.is_finished
    folder.metrics.touch()
    assert folder.is_finished
    folder.chunks.mkdir()
    for marker in (folder.checkpoint, folder.chunk_plan):
        marker.touch()
        assert not folder.is_finished
        marker.unlink()
    assert folder.is_finished


def literals(path):
    """String constants of a module and the fixed parts of its f-strings, without docstrings."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    docstrings = {ast.get_docstring(node, clean=False) for node in ast.walk(tree) if isinstance(node, documented)}
    constants = (node.value for node in ast.walk(tree) if isinstance(node, ast.Constant))
    return {value for value in constants if isinstance(value, str)} - docstrings


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_other_module_names_these_files(path):
    if path == PACKAGE / "run_folder.py":
        return
    names = {file.name for file in FOLDER.files()} | {FOLDER.previews.name, FOLDER.preview_ground_truth.name}
    assert not literals(path) & names, "use spslam.run_folder.RunFolder"
