"""Downloads and unpacks the archives of a dataset, and records which are done."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from spslam.download.catalog import Archive, Source
from spslam.download.transfer import FIRST_PAUSE_S, fetch
from spslam.download.unpacking import ArchiveError, unpack
from spslam.errors import OutputError
from spslam.io import atomic_write

# Below the data folder: partial downloads, and a record of each archive that was unpacked.
RECORDS_FOLDER = ".downloads"

# Called with the name of the archive, the bytes downloaded and the total bytes (None if unknown).
Progress = Callable[[str, int, int | None], None]


def download(
    source: Source, data: Path, progress: Progress | None = None, first_pause_s: float = FIRST_PAUSE_S
) -> list[str]:
    """Downloads and unpacks the archives of a source below `data`.

    Archives that were unpacked before are skipped. An interrupted download resumes where it stopped. An archive is
    removed after it is unpacked.

    Args:
        source: what to download.
        data: folder to unpack in; created if missing.
        progress: called while an archive is downloaded.
        first_pause_s: see `spslam.download.transfer.fetch`.

    Returns:
        Names of the archives that were unpacked.

    Raises:
        DatasetError: as `spslam.download.transfer.fetch` and `spslam.download.unpacking.unpack`.
        OutputError: the folder cannot be created or written to.
    """
    records = data / RECORDS_FOLDER
    try:
        records.mkdir(parents=True, exist_ok=True)
        return [
            archive.name
            for archive in source.archives
            if _download_archive(archive, data, records, progress, first_pause_s)
        ]
    except OSError as error:
        raise OutputError(f"{error.filename or data}: can't be written: {error.strerror or error}") from error


def is_complete(source: Source, data: Path) -> bool:
    """Whether all archives of a source were unpacked below `data`."""
    return all(_record(archive, data / RECORDS_FOLDER).is_file() for archive in source.archives)


def _download_archive(
    archive: Archive, data: Path, records: Path, progress: Progress | None, first_pause_s: float
) -> bool:
    """Downloads and unpacks one archive; returns False where that was done before."""
    record, file = _record(archive, records), records / archive.name
    if record.is_file():
        return False

    def report(done: int, total: int | None) -> None:
        if progress is not None:
            progress(archive.name, done, total)

    # A complete archive file is left from an earlier call that was interrupted while unpacking.
    found = None if file.is_file() else fetch(archive.url, file, archive.sha256, report, first_pause_s)
    try:
        unpack(file, data / archive.folder)
    except ArchiveError:
        file.unlink()  # so that the next call downloads it again
        raise
    atomic_write(record, json.dumps({"url": archive.url, "bytes": file.stat().st_size, "sha256": found}) + "\n")
    file.unlink()
    return True


def _record(archive: Archive, records: Path) -> Path:
    return records / f"{archive.name}.json"
