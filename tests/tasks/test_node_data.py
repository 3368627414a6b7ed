"""Recordings on a node: by their path, or copied once."""

import os
import shutil

import numpy as np
import pytest

from spslam.errors import ClusterError
from spslam.tasks import node_data
from spslam.tasks.node_data import ListedFile, cache_folder, list_files, local_input, read_part


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(node_data, "CHUNK_BYTES", 7)


@pytest.fixture
def recording(tmp_path):
    folder = tmp_path / "far" / "recording"
    (folder / "color").mkdir(parents=True)
    (folder / "color" / "0.png").write_bytes(bytes(range(40)))
    (folder / "empty").write_bytes(b"")
    return folder


class Reader:
    """Reads from a folder, and counts."""

    def __init__(self, path):
        self.path, self.calls = path, 0

    def __call__(self, name, offset, count):
        self.calls += 1
        return read_part(self.path, name, offset, count)


def test_what_is_there_is_read_there(recording):
    reader = Reader(recording)
    assert local_input(str(recording), list_files(recording), reader, False) == recording
    assert not reader.calls and not cache_folder().exists()


def test_what_is_not_there_is_copied_once(recording):
    wanted, elsewhere = list_files(recording), "/nowhere/recording"
    reader = Reader(recording)
    copies = [local_input(elsewhere, wanted, reader, False) for _ in range(2)]
    assert copies[0] == copies[1] and copies[0].name == "recording"
    assert list_files(copies[0]) == wanted and reader.calls == 6
    assert (copies[0] / "color" / "0.png").read_bytes() == bytes(range(40))


def test_other_files_under_the_same_path_are_not_taken(recording, tmp_path):
    wanted, reader = list_files(recording), Reader(recording)
    here = tmp_path / "recording"
    (here / "color").mkdir(parents=True)
    (here / "color" / "0.png").write_bytes(b"shorter")
    assert list_files(local_input(str(here), wanted, reader, False)) == wanted
    assert reader.calls


@pytest.mark.parametrize("always_copy", [False, True])
def test_changed_content_of_equal_size_is_copied_again(recording, always_copy):
    """Weights that were trained again have the size of the earlier ones."""
    weights = recording / "color" / "0.png"
    earlier = local_input("/nowhere/recording", list_files(recording), Reader(recording), always_copy)
    weights.write_bytes(bytes(range(1, 41)))
    copy = local_input("/nowhere/recording", list_files(recording), Reader(recording), always_copy)
    assert copy != earlier
    assert (copy / "color" / "0.png").read_bytes() == weights.read_bytes()


def test_other_content_of_equal_size_under_the_same_path_is_not_taken(recording, tmp_path):
    wanted, here = list_files(recording), tmp_path / "recording"
    shutil.copytree(recording, here)
    assert local_input(str(here), wanted, Reader(recording), False) == here
    (here / "color" / "0.png").write_bytes(bytes(40))
    copy = local_input(str(here), wanted, Reader(recording), False)
    assert copy != here and list_files(copy) == wanted


def test_a_large_file_is_known_by_name_size_and_its_copy_by_its_time(recording, tmp_path, monkeypatch):
    monkeypatch.setattr(node_data, "HASHED_BYTES", 39)
    here = tmp_path / "recording"
    shutil.copytree(recording, here)
    os.utime(here / "color" / "0.png", ns=(1, 1))
    assert local_input(str(here), list_files(recording), Reader(recording), False) == here
    copies = set()
    for time_ns in (5, 6):
        os.utime(recording / "color" / "0.png", ns=(time_ns, time_ns))
        copies.add(local_input("/nowhere/recording", list_files(recording), Reader(recording), False))
    assert len(copies) == 2


def test_what_changes_before_it_is_copied_is_reported(recording):
    wanted = list_files(recording)
    (recording / "color" / "0.png").write_bytes(bytes(40))
    with pytest.raises(ClusterError, match=r"0.png: changed after the command began"):
        local_input("/nowhere/recording", wanted, Reader(recording), False)


def test_a_copy_is_made_where_it_is_asked_for(recording):
    copy = local_input(str(recording), list_files(recording), Reader(recording), True)
    assert copy != recording and list_files(copy) == list_files(recording)


def test_a_file_keeps_its_name(recording):
    file = recording / "color" / "0.png"
    copy = local_input("/nowhere/0.png", list_files(file), Reader(file), False)
    assert copy.name == "0.png" and copy.read_bytes() == file.read_bytes()


def test_an_interrupted_copy_is_begun_again(recording):
    wanted = list_files(recording)

    def broken(name, offset, count):
        if offset:
            raise OSError("gone")
        return np.zeros(count, np.uint8)

    with pytest.raises(ClusterError, match="can't be copied there: gone"):
        local_input("/nowhere/recording", wanted, broken, False)
    copy = local_input("/nowhere/recording", wanted, Reader(recording), False)
    assert (copy / "color" / "0.png").read_bytes() == bytes(range(40))


def test_what_is_nowhere_and_what_shrinks_is_reported(recording):
    with pytest.raises(ClusterError, match="/nowhere: no such file or folder"):
        local_input("/nowhere", list_files(recording / "none"), Reader(recording), False)
    with pytest.raises(ClusterError, match="became shorter"):
        local_input("/nowhere/x", [ListedFile("empty", 3)], Reader(recording), False)
