"""What `spslam merge` leaves where it does not come to its end."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from spslam.errors import OutputError
from spslam.run import merge
from tests.cli.command import spslam


@pytest.fixture
def request_of(tmp_path, monkeypatch):
    """A function that makes a request to merge runs, whose maps are stubs and whose results one file."""
    for name in ("_archives", "make_map", "archive_of"):
        monkeypatch.setattr(merge, name, lambda *_: None)
    monkeypatch.setattr(merge, "_joined", lambda *_: (SimpleNamespace(settings=None), []))
    monkeypatch.setattr(merge, "joined_state", lambda *_: None)
    monkeypatch.setattr(merge, "_config_of", lambda _: SimpleNamespace())

    def make(error):
        def write(folder, *_):
            (folder.path / "half").write_text("")
            if error is not None:
                raise error
            return {"merged": []}

        monkeypatch.setattr(merge, "_write", write)
        return merge.MergeRequest([tmp_path / "one", tmp_path / "two"], tmp_path / "out", device="cpu")

    return make


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OutputError("disk full")])
def test_a_merge_that_fails_or_is_interrupted_leaves_nothing(request_of, tmp_path, error):
    with pytest.raises(type(error)):
        merge.merge_runs(request_of(error))
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_merge_has_left_is_cleared(request_of, tmp_path):
    (tmp_path / ".out.merging").mkdir()
    (tmp_path / ".out.merging" / "left").touch()
    merge.merge_runs(request_of(None))
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "half"]


def test_another_merge_that_is_running_is_left_alone(request_of, tmp_path):
    with merge.OutputFolder(tmp_path / ".out.merging").locked():
        with pytest.raises(OutputError, match="another run is writing into it"):
            merge.merge_runs(request_of(None))
        assert (tmp_path / ".out.merging").is_dir()


def test_an_interruption_is_one_line(tmp_path, monkeypatch):
    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(merge, "merge_runs", interrupted)
    result = spslam("merge", "a", "b", "--output", "out", cwd=tmp_path)
    assert result.returncode == 130 and result.stderr == "spslam: interrupted\n"


def test_an_empty_folder_behind_a_symbolic_link_is_filled(request_of, tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "disk")
    merge.merge_runs(request_of(None))
    assert [path.name for path in (tmp_path / "disk").iterdir()] == ["half"]


def test_the_working_directory_is_refused(request_of, tmp_path, monkeypatch):
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path / "out")
    with pytest.raises(OutputError, match="is the working directory; use another --output"):
        merge.merge_runs(request_of(None))


@pytest.mark.parametrize("order", [("one", "near", "far"), ("one", "far", "near")])
def test_maps_are_joined_in_any_order_that_works(monkeypatch, order):
    """`far` shares a place with `near` only."""
    shared = [{"one", "near"}, {"near", "far"}]

    def of(names):
        return SimpleNamespace(recordings=list(names))

    def join(first, second, _):
        one, other = first.recordings, second.recordings
        return of(one + other) if any({a, b} in shared for a in one for b in other) else "no place is shared"

    monkeypatch.setattr(merge, "join_archives", join)
    monkeypatch.setattr(merge, "registrar_of", lambda *_: None)
    joined, rows = merge._joined([Path(name) for name in order], [of([name]) for name in order], None)
    assert joined.recordings == ["one", "near", "far"]
    assert tuple(joined.recordings[row] for row in rows) == order
    with pytest.raises(OutputError, match="far: shares no place with one: no place is shared"):
        merge._joined([Path("one"), Path("far")], [of(["one"]), of(["far"])], None)
