"""A data set's files: fetched, unpacked, and noted as done."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from spslam.download.catalog import Archive, Source
from spslam.download.transfer import FIRST_PAUSE_S, fetch
from spslam.download.unpacking import ArchiveError, unpack
from spslam.errors import OutputError
from spslam.io import atomic_write

# Below the data folder: what is on its way, and a note for each archive that was unpacked.
NOTES_FOLDER = ".downloads"

# Called with the archive's name, the bytes there and the bytes in all (None if unknown).
Progress = Callable[[str, int, int | None], None]


def download(
    source: Source, data: Path, progress: Progress | None = None, first_pause_s: float = FIRST_PAUSE_S
) -> list[str]:
    """Fetch and unpack a source's archives below ``data``; returns the names of those that were.

    Archives that were unpacked before are left as they are. What was interrupted goes on where it stopped. An archive
    is removed when it is unpacked.

    Raises
    ------
    DatasetError
        As :func:`spslam.download.transfer.fetch` and :func:`spslam.download.unpacking.unpack`.
    OutputError
        When the folder can't be made or written to.
    """
    notes = data / NOTES_FOLDER
    try:
        notes.mkdir(parents=True, exist_ok=True)
        return [archive.name for archive in source.archives if _bring(archive, data, notes, progress, first_pause_s)]
    except OSError as error:
        raise OutputError(f"{error.filename or data}: can't be written: {error.strerror or error}") from error


def is_complete(source: Source, data: Path) -> bool:
    """Whether all archives of a source were unpacked below ``data``."""
    return all(_note(archive, data / NOTES_FOLDER).is_file() for archive in source.archives)


def _bring(archive: Archive, data: Path, notes: Path, progress: Progress | None, first_pause_s: float) -> bool:
    note, file = _note(archive, notes), notes / archive.name
    if note.is_file():
        return False

    def tell(done: int, total: int | None) -> None:
        if progress is not None:
            progress(archive.name, done, total)

    # An archive that is there whole was fetched before, and interrupted while it was unpacked.
    found = None if file.is_file() else fetch(archive.url, file, archive.sha256, tell, first_pause_s)
    try:
        unpack(file, data / archive.folder)
    except ArchiveError:
        file.unlink()  # so that it is fetched anew
        raise
    atomic_write(note, json.dumps({"url": archive.url, "bytes": file.stat().st_size, "sha256": found}) + "\n")
    file.unlink()
    return True


def _note(archive: Archive, notes: Path) -> Path:
    return notes / f"{archive.name}.json"
