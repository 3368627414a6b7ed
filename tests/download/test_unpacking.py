"""Unpacking of valid, damaged and unsafe archives."""

import io
import stat
import tarfile
import zipfile

import pytest

from spslam.download.unpacking import unpack
from spslam.errors import DatasetError


def zipped(files: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def tarred(files: dict[str, bytes], *members: tarfile.TarInfo) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
        for name, content in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
        for member in members:
            archive.addfile(member)
    return buffer.getvalue()


def tree(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def write(folder, name, content):
    (folder / name).write_bytes(content)
    return folder / name


FILES = {"room/results/frame000000.jpg": b"image", "room/traj.txt": b"1 0 0", "room_mesh.ply": b"ply"}


@pytest.mark.parametrize(("name", "pack"), [("a.zip", zipped), ("a.tgz", tarred)])
def test_a_valid_archive(tmp_path, name, pack):
    unpack(write(tmp_path, name, pack(FILES)), tmp_path / "out")
    assert tree(tmp_path / "out") == FILES


def test_nested_archives(tmp_path):
    inner = {"seq-01/frame-000000.color.png": b"a", "seq-01/frame-000000.pose.txt": b"b"}
    content = zipped({"chess/seq-01.zip": zipped(inner), "chess/TestSplit.txt": b"sequence1"})
    unpack(write(tmp_path, "chess.zip", content), tmp_path / "out")
    expected = {f"chess/{name}": text for name, text in inner.items()} | {"chess/TestSplit.txt": b"sequence1"}
    assert tree(tmp_path / "out") == expected


ESCAPES = ["../evil.txt", "room/../../evil.txt", "/tmp/evil.txt", "..\\evil.txt", "C:/evil.txt"]


@pytest.mark.parametrize("escape", ESCAPES)
@pytest.mark.parametrize(("name", "pack"), [("a.zip", zipped), ("a.tgz", tarred)])
def test_paths_outside_the_folder_are_refused_before_anything_is_written(tmp_path, name, pack, escape):
    archive = write(tmp_path, name, pack({**FILES, escape: b"evil"}))
    with pytest.raises(DatasetError, match=f"{name}: must not contain paths outside the folder it is unpacked in, "):
        unpack(archive, tmp_path / "out")
    assert tree(tmp_path / "out") == {}
    assert not list(tmp_path.rglob("evil.txt"))


def test_paths_outside_the_folder_are_refused_in_nested_archives(tmp_path):
    content = zipped({"chess/seq-01.zip": zipped({"../../../evil.txt": b"evil"})})
    with pytest.raises(DatasetError, match="seq-01.zip: must not contain paths outside the folder"):
        unpack(write(tmp_path, "a.zip", content), tmp_path / "out")
    assert not list(tmp_path.rglob("evil.txt"))


def test_links_are_refused(tmp_path):
    link = zipfile.ZipInfo("room/link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(link, "/etc")
    with pytest.raises(DatasetError, match="must contain only files and folders, but room/link is a link"):
        unpack(write(tmp_path, "a.zip", buffer.getvalue()), tmp_path / "out")
    for kind in (tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE):
        member = tarfile.TarInfo("room/link")
        member.type, member.linkname = kind, "/etc"
        with pytest.raises(DatasetError, match="must contain only files and folders, but room/link is a link"):
            unpack(write(tmp_path, "a.tgz", tarred(FILES, member)), tmp_path / "out")
    assert tree(tmp_path / "out") == {}


def test_an_existing_link_out_of_the_folder_is_not_followed(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "room").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(DatasetError, match="must not contain paths outside the folder"):
        unpack(write(tmp_path, "a.zip", zipped(FILES)), tmp_path / "out")
    assert not list((tmp_path / "elsewhere").iterdir())


def test_damaged_archives(tmp_path):
    good = zipped({"a.bin": bytes(range(256)) * 400})
    flipped = bytearray(good)
    flipped[60] ^= 0xFF
    cut = tarred({"a.bin": bytes(range(256)) * 4000})[:-200]
    for name, content, message in (
        ("a.zip", bytes(flipped), "the archive is damaged"),
        ("b.zip", good[:-30], "must be a zip or tar file"),
        ("c.tgz", cut, "the archive is damaged"),
        ("d.zip", b"<html>not found</html>", "must be a zip or tar file"),
        ("e.zip", b"", "must be a zip or tar file"),
    ):
        with pytest.raises(DatasetError, match=f"{name}: {message}"):
            unpack(write(tmp_path, name, content), tmp_path / "out")
