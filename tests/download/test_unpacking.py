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


def refused(archive, message):
    with pytest.raises(DatasetError, match=message) as error:
        unpack(archive, archive.parent / "out")
    assert str(error.value).startswith(f"{archive.parent}/")
    assert "\n" not in str(error.value)


def test_an_archive_of_zeros_is_no_dataset(tmp_path):
    """A thousand times its own size, beyond what small archives may hold anyway."""
    zeros = {"zeros.bin": bytes(150 << 20)}
    for name, pack in (("a.zip", zipped), ("a.tgz", tarred)):
        refused(write(tmp_path, name, pack(zeros)), "must contain what an archive of its size can hold, got more")
    assert tree(tmp_path / "out") == {}


def test_archives_that_are_nested_deep(tmp_path):
    content = zipped({"a.txt": b"end"})
    for depth in range(1200):
        content = zipped({f"{depth}.zip": content})
    refused(write(tmp_path, "deep.zip", content), "must be nested at most 3 deep")


def test_what_nested_archives_hold_counts_for_the_outer_one(tmp_path):
    inner = zipped({f"{i}.bin": bytes(20 << 20) for i in range(3)})
    refused(
        write(tmp_path, "a.zip", zipped({f"{i}.zip": inner for i in range(3)})), "must contain what an archive of its"
    )


@pytest.mark.parametrize("count", [11_000])
def test_archives_of_many_members(tmp_path, count):
    archive = write(tmp_path, "a.tgz", tarred({f"{i}": b"" for i in range(count)}))
    refused(archive, "must contain what an archive of its size can hold, got more")
    assert not list((tmp_path / "out").iterdir())


def test_sparse_files_and_long_headers_are_refused(tmp_path):
    sparse = tarfile.TarInfo("a.bin")
    sparse.type = tarfile.GNUTYPE_SPARSE
    refused(write(tmp_path, "sparse.tgz", tarred(FILES, sparse)), "must contain whole files, but has sparse ones")
    for name, content, message in (
        ("long.tgz", b"3 a=" + bytes(1 << 20), "a header must have at most 16384 bytes"),
        ("digits.tgz", b"1" * 8000, "a header must not contain numbers of over 20 digits"),
    ):
        buffer = io.BytesIO()
        with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
            member = tarfile.TarInfo("header")
            member.type, member.size = tarfile.XHDTYPE, len(content)
            archive.addfile(member, io.BytesIO(content))
            archive.addfile(tarfile.TarInfo("a.txt"))
        refused(write(tmp_path, name, buffer.getvalue()), message)


def test_methods_that_inflate_without_a_limit_are_refused(tmp_path):
    for method in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", method) as archive:
            archive.writestr("a.bin", bytes(1000))
        refused(write(tmp_path, "a.zip", buffer.getvalue()), "must be stored or deflated, but a.bin isn't")


def test_an_encrypted_archive(tmp_path):
    content = bytearray(zipped({"a.bin": b"secret"}))
    content[6] |= 1
    content[content.index(b"PK\x01\x02") + 8] |= 1
    refused(write(tmp_path, "a.zip", bytes(content)), "must not be encrypted, but a.bin is")


def test_an_archive_does_not_replace_itself_or_its_notes(tmp_path):
    notes = tmp_path / "out" / ".downloads"
    notes.mkdir(parents=True)
    for name in (".downloads/a.zip", ".downloads/other.zip.json"):
        archive = write(notes, "a.zip", zipped({name: b"mine"}))
        before = archive.read_bytes()
        with pytest.raises(DatasetError, match="must not contain paths in the folder that it lies in, got .downloads/"):
            unpack(archive, tmp_path / "out")
        assert tree(notes) == {"a.zip": before}
    inner = zipped({"seq.zip": b"me"})
    refused(
        write(tmp_path, "b.zip", zipped({"seq.zip": inner})),
        "must not contain paths in the folder that it lies in, got seq.zip",
    )


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_nested_archives_of_one_name(tmp_path):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in ("one.txt", "two.txt"):
            archive.writestr("seq.zip", zipped({name: b"x"}))
    unpack(write(tmp_path, "a.zip", buffer.getvalue()), tmp_path / "out")
    assert tree(tmp_path / "out") == {"two.txt": b"x"}
    taken = zipped({"a.zip": zipped({"b.zip": zipped(FILES)}), "b.zip": zipped(FILES)})
    refused(write(tmp_path, "c.zip", taken), "the archive is damaged: No such file or directory")


@pytest.mark.parametrize(
    "names", [["a" * 300], ["a", "a/b"], ["a/b", "a"], ["."], ["a//", "a"], ["a\0b"], ["x/" * 3000 + "y"]]
)
@pytest.mark.parametrize("suffix", ["zip", "tgz"])
def test_names_that_no_file_can_have(tmp_path, names, suffix):
    """Either the archive is refused or its files get the names that they can have."""
    archive = write(tmp_path, f"a.{suffix}", {"zip": zipped, "tgz": tarred}[suffix]({name: b"x" for name in names}))
    try:
        unpack(archive, tmp_path / "out")
    except DatasetError as error:
        assert f"a.{suffix}: " in str(error)
    assert {path.name for path in tmp_path.iterdir()} <= {"out", archive.name}
