"""Unpacks untrusted archives: only files and folders, and only below the given folder.

The size that an archive declares is compared with its own before anything is written: images hardly compress, so an
archive with a hundred times its size in it is no dataset.
"""

from __future__ import annotations

import errno
import gzip
import io
import os
import re
import shutil
import stat
import tarfile
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO

from spslam.download.transfer import require_space
from spslam.errors import DatasetError, brief

# Of zip files within zip files; 7-Scenes has one level.
MAX_DEPTH = 3
# Bytes and members that an archive may hold: as many as for nothing, and as many for its own bytes.
_FREE_BYTES, _BYTES_PER_BYTE = 64 << 20, 100
_FREE_MEMBERS, _BYTES_PER_MEMBER = 10_000, 200
# Read at a time, so that neither a directory nor a header takes much memory; a zip's directory comes in one piece.
_TAR_CHUNK_BYTES, _ZIP_CHUNK_BYTES = 16 << 10, 16 << 20
_TAR_BLOCK_BYTES = 512
# Python's parser of tar headers goes over a row of digits once for each of them.
_LONG_NUMBER = re.compile(rb"\d{21}")
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 1
_GZIP_MARK = b"\x1f\x8b"
# What the system says of a name that no file can have here.
_NAME_ERRORS = {errno.ENAMETOOLONG, errno.EISDIR, errno.ENOTDIR, errno.EEXIST, errno.EINVAL, errno.ELOOP, errno.EILSEQ}
# And of a nested archive that another one took away by holding a name twice.
_NAME_ERRORS |= {errno.ENOENT}


class ArchiveError(DatasetError):
    """An archive that is damaged or unsafe, so that unpacking it again would fail too."""


def unpack(archive: Path, folder: Path) -> None:
    """Unpacks a zip or tar file below `folder`, and the zip files inside it.

    All names and sizes are checked before anything is written. Inner zip files, as in 7-Scenes, are unpacked where they
    are and removed. Modes, owners and times are not kept.

    Args:
        archive: a zip file, stored or deflated, or a tar file, plain or gzipped.
        folder: where to unpack; created if missing.

    Raises:
        ArchiveError: a file that is not an archive or is damaged; a path outside `folder`, a link or a device in it;
            zip files nested deeper than `MAX_DEPTH`; or more content than an archive of its size plausibly has.
        DatasetError: not enough space on the disk.
        OSError: the operating system refuses to write.
    """
    folder.mkdir(parents=True, exist_ok=True)
    budget = _Budget(archive)
    with _faults_of(archive):
        if zipfile.is_zipfile(archive):
            _unpack_zip(archive, folder, budget, MAX_DEPTH)
        elif _is_tar(archive):
            _unpack_tar(archive, folder, budget)
        else:
            raise ArchiveError(f"{archive}: must be a zip or tar file")


class _RefusedError(Exception):
    """What is wrong with an archive, without its name."""


class _Budget:
    """What an archive and all archives in it may still hold."""

    def __init__(self, archive: Path) -> None:
        size = archive.stat().st_size
        self._archive = archive
        self._bytes = _FREE_BYTES + _BYTES_PER_BYTE * size
        self._members = _FREE_MEMBERS + size // _BYTES_PER_MEMBER

    def spend(self, count: int) -> None:
        """Takes a member of `count` bytes off the budget; raises ArchiveError where it is used up."""
        self._bytes -= count
        self._members -= 1
        if self._bytes < 0 or self._members < 0 or count < 0:
            raise ArchiveError(f"{self._archive}: must contain what an archive of its size can hold, got more")


class _ShortReads(io.RawIOBase):
    """A file to read from, which refuses to read much at once.

    Args:
        file: the file.
        most: bytes at a time.
        headers: whether only headers are read.
    """

    def __init__(self, file: IO[bytes], most: int, headers: bool = False) -> None:
        self._file, self._most, self._headers = file, most, headers

    def read(self, size: int | None = -1) -> bytes:  # type: ignore[override]
        if size is None or size < 0:
            place = self._file.tell()
            size = self._file.seek(0, os.SEEK_END) - place
            self._file.seek(place)
        if size > self._most:
            raise _RefusedError(f"a header must have at most {self._most} bytes, got {size}")
        content = self._file.read(size)
        if self._headers and size > _TAR_BLOCK_BYTES and _LONG_NUMBER.search(content):
            raise _RefusedError("a header must not contain numbers of over 20 digits")
        return content

    def seek(self, place: int, whence: int = os.SEEK_SET) -> int:
        return self._file.seek(place, whence)

    def tell(self) -> int:
        return self._file.tell()

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True


class _WholeMember(tarfile.TarInfo):
    """A member of a tar file that isn't sparse: the maps of sparse ones can be of any length."""

    def _proc_sparse(self, archive: tarfile.TarFile) -> tarfile.TarInfo:
        raise _RefusedError("must contain whole files, but has sparse ones")

    _proc_gnusparse_10 = _proc_sparse


def _unpack_zip(archive: Path, folder: Path, budget: _Budget, depth: int) -> None:
    if depth == 0:
        raise ArchiveError(f"{archive}: must be nested at most {MAX_DEPTH} deep")
    with archive.open("rb") as content, zipfile.ZipFile(_ShortReads(content, _ZIP_CHUNK_BYTES)) as file:
        members = file.infolist()
        for member in members:
            _check_zip_member(archive, member)
            budget.spend(member.file_size)
        places = [_place(archive, folder, member.filename) for member in members]
        require_space(folder, sum(member.file_size for member in members), f"unpacking {archive.name}")
        nested = []
        for member, place in zip(members, places, strict=True):
            if member.is_dir():
                place.mkdir(parents=True, exist_ok=True)
                continue
            with file.open(member) as source:
                _write(source, place)
            if place.suffix.lower() == ".zip":
                nested.append(place)
    for inner in dict.fromkeys(nested):
        with _faults_of(inner):
            _unpack_zip(inner, inner.parent, budget, depth - 1)
        inner.unlink()


def _check_zip_member(archive: Path, member: zipfile.ZipInfo) -> None:
    kind = stat.S_IFMT(member.external_attr >> 16)
    if kind and not (stat.S_ISREG(kind) or stat.S_ISDIR(kind)):
        raise ArchiveError(
            f"{archive}: must contain only files and folders, but {brief(member.filename)} is a link or device"
        )
    if member.flag_bits & _ENCRYPTED:
        raise ArchiveError(f"{archive}: must not be encrypted, but {brief(member.filename)} is")
    if member.compress_type not in _METHODS:
        raise ArchiveError(f"{archive}: must be stored or deflated, but {brief(member.filename)} isn't")


def _is_tar(archive: Path) -> bool:
    try:
        with _tar_members(archive) as members:
            next(iter(members), None)
    except (tarfile.ReadError, EOFError):
        return False
    return True


def _unpack_tar(archive: Path, folder: Path, budget: _Budget) -> None:
    # Two passes, because the names come between the contents.
    total = 0
    with _tar_members(archive) as members:
        for member in members:
            _place(archive, folder, member.name)
            if not (member.isfile() or member.isdir()):
                raise ArchiveError(
                    f"{archive}: must contain only files and folders, but {brief(member.name)} is a link or device"
                )
            # Before the loop continues and skips the content, which may have to be inflated for that.
            budget.spend(member.size)
            total += member.size
    require_space(folder, total, f"unpacking {archive.name}")
    with _tar_file(archive, headers=False) as file:
        for member in file:
            place = _place(archive, folder, member.name)
            if member.isdir():
                place.mkdir(parents=True, exist_ok=True)
                continue
            source = file.extractfile(member)
            if source is not None:
                with source:
                    _write(source, place)


@contextmanager
def _tar_members(archive: Path) -> Iterator[Iterable[tarfile.TarInfo]]:
    """The members of a tar file without their content."""
    with _tar_file(archive, headers=True) as file:
        yield file


@contextmanager
def _tar_file(archive: Path, headers: bool) -> Iterator[tarfile.TarFile]:
    with archive.open("rb") as packed:
        is_packed = packed.read(2) == _GZIP_MARK
        packed.seek(0)
        content = gzip.GzipFile(fileobj=packed) if is_packed else packed
        reader = _ShortReads(content, _TAR_CHUNK_BYTES, headers)  # type: ignore[arg-type]
        with tarfile.open(fileobj=reader, mode="r:", tarinfo=_WholeMember) as file:  # type: ignore[call-overload]
            yield file


def _place(archive: Path, folder: Path, name: str) -> Path:
    """The path that a member is unpacked to; raises ArchiveError outside the folder, or beside the archive itself."""
    parts = PurePosixPath(name.replace("\\", "/"))
    inside = not parts.is_absolute() and ".." not in parts.parts and ":" not in (parts.parts or ("",))[0]
    place = folder.joinpath(*parts.parts) if inside else folder
    resolved, root, source = place.resolve(), folder.resolve(), archive.resolve()
    # A link that was in the folder before could point outside too.
    if not inside or not resolved.is_relative_to(root):
        raise ArchiveError(f"{archive}: must not contain paths outside the folder it is unpacked in, got {brief(name)}")
    # The folder of archives may lie below the one that is unpacked into, and has notes on them.
    if resolved == source or (root in source.parent.parents and resolved.is_relative_to(source.parent)):
        raise ArchiveError(f"{archive}: must not contain paths in the folder that it lies in, got {brief(name)}")
    return place


def _write(source: IO[bytes], place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    with place.open("wb") as file:
        shutil.copyfileobj(source, file, _TAR_CHUNK_BYTES)


@contextmanager
def _faults_of(archive: Path) -> Iterator[None]:
    """Turns whatever an archive's content makes its parser stumble over into one line that names the archive."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.errno not in _NAME_ERRORS:
            raise
        raise ArchiveError(f"{archive}: the archive is damaged: {brief(str(error.strerror or error))}") from error
    except DatasetError:
        raise
    except _RefusedError as error:
        raise ArchiveError(f"{archive}: {error}") from None
    except Exception as error:  # zipfile, tarfile and zlib raise a dozen classes, and none in common
        raise ArchiveError(f"{archive}: the archive is damaged: {brief(str(error) or type(error).__name__)}") from error
