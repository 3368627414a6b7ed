"""Unpacks untrusted archives: only files and folders, and only below the given folder."""

from __future__ import annotations

import shutil
import stat
import tarfile
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from typing import IO

from spslam.download.transfer import require_space
from spslam.errors import DatasetError


class ArchiveError(DatasetError):
    """An archive that is damaged or unsafe, so that unpacking it again would fail too."""


def unpack(archive: Path, folder: Path) -> None:
    """Unpacks a zip or tar file (plain or compressed) below `folder`, and the zip files inside it.

    All names are checked before anything is written. Inner zip files, as in 7-Scenes, are unpacked where they are and
    removed. Modes, owners and times are not kept.

    Args:
        archive: the file.
        folder: where to unpack; created if missing.

    Raises:
        ArchiveError: a file that is not an archive or is damaged, or that contains a path outside `folder`, a link or a
            device.
        DatasetError: not enough space on the disk.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        if zipfile.is_zipfile(archive):
            _unpack_zip(archive, folder)
        elif tarfile.is_tarfile(archive):
            _unpack_tar(archive, folder)
        else:
            raise ArchiveError(f"{archive}: must be a zip or tar file")
    except (zipfile.BadZipFile, tarfile.TarError, zlib.error, EOFError, NotImplementedError) as error:
        raise ArchiveError(f"{archive}: the archive is damaged: {error}") from error


def _unpack_zip(archive: Path, folder: Path) -> None:
    with zipfile.ZipFile(archive) as file:
        members = file.infolist()
        for member in members:
            kind = stat.S_IFMT(member.external_attr >> 16)
            if kind and not (stat.S_ISREG(kind) or stat.S_ISDIR(kind)):
                raise ArchiveError(
                    f"{archive}: must contain only files and folders, but {member.filename} is a link or device"
                )
        places = [_place(archive, folder, member.filename) for member in members]
        require_space(folder, sum(member.file_size for member in members), f"unpacking {archive.name}")
        nested = []
        for member, place in zip(members, places, strict=True):
            if member.is_dir():
                place.mkdir(parents=True, exist_ok=True)
                continue
            with file.open(member) as content:
                _write(content, place)
            if place.suffix.lower() == ".zip":
                nested.append(place)
    for inner in nested:
        _unpack_zip(inner, inner.parent)
        inner.unlink()


def _unpack_tar(archive: Path, folder: Path) -> None:
    # Two passes: all names are checked before anything is written, and a tar file has no index.
    with tarfile.open(archive) as file:
        total = 0
        for member in file:
            _place(archive, folder, member.name)
            if not (member.isfile() or member.isdir()):
                raise ArchiveError(
                    f"{archive}: must contain only files and folders, but {member.name} is a link or device"
                )
            total += member.size
    require_space(folder, total, f"unpacking {archive.name}")
    with tarfile.open(archive) as file:
        for member in file:
            place = _place(archive, folder, member.name)
            if member.isdir():
                place.mkdir(parents=True, exist_ok=True)
                continue
            content = file.extractfile(member)
            if content is not None:
                with content:
                    _write(content, place)


def _place(archive: Path, folder: Path, name: str) -> Path:
    """The path that a member is unpacked to; raises ArchiveError for a path outside the folder."""
    parts = PurePosixPath(name.replace("\\", "/"))
    inside = not parts.is_absolute() and ".." not in parts.parts and ":" not in (parts.parts or ("",))[0]
    place = folder.joinpath(*parts.parts) if inside else folder
    # A link that was in the folder before could point outside too.
    if not inside or not place.resolve().is_relative_to(folder.resolve()):
        raise ArchiveError(f"{archive}: must not contain paths outside the folder it is unpacked in, got {name}")
    return place


def _write(content: IO[bytes], place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    with place.open("wb") as file:
        shutil.copyfileobj(content, file, 1 << 20)
