import pytest

from spslam.errors import OutputError
from spslam.io import atomic_write


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_bytes_text_and_function(tmp_path):
    atomic_write(tmp_path / "a.bin", b"\x00\x01")
    atomic_write(tmp_path / "b.txt", "meters: µ")
    atomic_write(tmp_path / "c.ply", lambda path: path.write_text(path.suffix))
    assert (tmp_path / "a.bin").read_bytes() == b"\x00\x01"
    assert (tmp_path / "b.txt").read_text(encoding="utf-8") == "meters: µ"
    assert (tmp_path / "c.ply").read_text() == ".ply"
    assert names(tmp_path) == ["a.bin", "b.txt", "c.ply"]


def test_a_failing_writer_leaves_the_old_content(tmp_path):
    atomic_write(tmp_path / "a.txt", "old")

    def write_half_and_fail(path):
        path.write_text("ne")
        raise RuntimeError("interrupted")

    with pytest.raises(RuntimeError, match="interrupted"):
        atomic_write(tmp_path / "a.txt", write_half_and_fail)
    assert (tmp_path / "a.txt").read_text() == "old"
    assert names(tmp_path) == ["a.txt"]


def test_a_missing_folder_is_an_output_error(tmp_path):
    with pytest.raises(OutputError, match=r"missing/a\.txt: can't be written: No such file"):
        atomic_write(tmp_path / "missing" / "a.txt", "x")


def test_a_file_written_as_private_gets_default_permissions(tmp_path):
    def write_private(path):
        path.unlink()
        path.touch(mode=0o600)

    atomic_write(tmp_path / "private", write_private)
    atomic_write(tmp_path / "ordinary", b"")
    assert (tmp_path / "private").stat().st_mode == (tmp_path / "ordinary").stat().st_mode
