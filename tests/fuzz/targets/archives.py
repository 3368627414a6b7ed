"""Archives: zip and tar files, with names that lead out, sizes that lie, and archives in them."""

from __future__ import annotations

import gzip
import io
import stat
import struct
import tarfile
import warnings
import zipfile
from pathlib import Path
from random import Random

from spslam.download.unpacking import unpack
from tests.fuzz.formats import Format
from tests.fuzz.mutations import any_integer, mutate_bytes

NAMES = (
    *(
        "a.txt",
        "a/b.txt",
        "a/b/c.bin",
        "a",
        "a/",
        "./a",
        "../out.txt",
        "../../out.txt",
        "a/../../out.txt",
        "/tmp/out.txt",
    ),
    *(
        "..\\out.txt",
        "C:/out.txt",
        "C:\\out.txt",
        ".",
        "..",
        "",
        "/",
        "a//b",
        "a/./b",
        "a\0b",
        "é\u202e.txt",
        "n" * 300,
    ),
    *("d/" * 200 + "x", "inner.zip", "archive.zip", "archive.tar", "../archive.zip", "con", "a\nb", "~/x", "-rf", " "),
)
CONTENTS = (b"", b"text", bytes(1000), bytes(range(256)) * 20, b"PK\3\4", b"0" * 10**5)
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)


class _Archive(Format):
    """An archive, unpacked into a folder beside it."""

    suffix: str

    def write(self, random: Random, folder: Path) -> None:
        content = self.packed(random, 0)
        if random.random() < 0.6:
            content = mutate_bytes(random, content)
        (folder / f"archive.{self.suffix}").write_bytes(content)

    def packed(self, random: Random, depth: int) -> bytes:
        """A good or a hostile archive."""
        raise NotImplementedError

    def read(self, folder: Path) -> None:
        unpack(folder / f"archive.{self.suffix}", folder / "out")

    def may_write(self, folder: Path) -> tuple[Path, ...]:
        return (folder / "out",)


class Zip(_Archive):
    """Zip files, and zip files in them."""

    name, suffix = "zip", "zip"
    # In a member's entry of the directory, and before its content.
    ENTRY, LOCAL = (8, 10, 16, 20, 24, 28, 30, 32, 34, 38, 42), (6, 8, 14, 18, 22, 26, 28)

    def packed(self, random: Random, depth: int) -> bytes:
        buffer = io.BytesIO()
        with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w") as archive:
            warnings.simplefilter("ignore")  # the same name twice is one of the ways
            for _ in range(random.choice((0, 1, 2, 3, 8))):
                member = zipfile.ZipInfo(random.choice(NAMES) or "empty")
                if random.random() < 0.1:
                    kind = random.choice((stat.S_IFLNK, stat.S_IFDIR, stat.S_IFIFO, stat.S_IFREG, stat.S_IFCHR))
                    member.external_attr = kind << 16
                member.compress_type = random.choice(METHODS) if random.random() < 0.3 else zipfile.ZIP_DEFLATED
                content = random.choice(CONTENTS)
                if depth < 5 and random.random() < 0.3:
                    member.filename, content = (
                        random.choice(("inner.zip", "a/inner.ZIP")),
                        self.packed(random, depth + 1),
                    )
                archive.writestr(member, content)
        content = buffer.getvalue()
        return self._with_other_fields(random, content) if random.random() < 0.4 else content

    def _with_other_fields(self, random: Random, content: bytes) -> bytes:
        sign, fields = random.choice(
            ((b"PK\1\2", self.ENTRY), (b"PK\3\4", self.LOCAL), (b"PK\5\6", (4, 8, 10, 12, 16, 20)))
        )
        places = [i for i in range(len(content)) if content.startswith(sign, i)]
        if not places:
            return content
        spoiled, place = bytearray(content + bytes(8)), random.choice(places) + random.choice(fields)
        bits, form = random.choice(((16, "<H"), (32, "<I")))
        struct.pack_into(form, spoiled, place, any_integer(random, bits, False))
        return bytes(spoiled[:-8])


class Tar(_Archive):
    """Tar files, plain and gzipped."""

    name, suffix = "tar", "tar"
    KINDS = (
        *(tarfile.REGTYPE,) * 12,
        tarfile.DIRTYPE,
        tarfile.SYMTYPE,
        tarfile.LNKTYPE,
        tarfile.CHRTYPE,
        tarfile.FIFOTYPE,
    )
    KINDS += (tarfile.GNUTYPE_SPARSE, tarfile.GNUTYPE_LONGNAME, tarfile.XHDTYPE, tarfile.XGLTYPE, b"Z", b"\0", b"7")
    HEADERS = (
        b"18 path=../out.txt\n",
        b"20 size=99999999999\n",
        b"22 GNU.sparse.major=1\n",
        b"9" * 3000,
        b"-5 a=b\n",
        b"30 mtime=",
    )
    HEADERS += (
        b"25 GNU.sparse.size=10000000\n24 GNU.sparse.map=0,10000000\n",
        b"20 hdrcharset=BINARY\n",
        b"12 path=a\0b\n",
    )

    def packed(self, random: Random, depth: int) -> bytes:
        buffer = io.BytesIO()
        form = random.choice((tarfile.GNU_FORMAT, tarfile.PAX_FORMAT, tarfile.USTAR_FORMAT))
        with tarfile.open(fileobj=buffer, mode="w", format=form) as archive:
            for _ in range(random.choice((0, 1, 2, 3, 8))):
                self._add(random, archive)
        content = bytearray(buffer.getvalue())
        if random.random() < 0.3 and len(content) >= 512:
            self._spoil_header(random, content)
        packed = bytes(content)
        if random.random() < 0.5:
            packed = gzip.compress(mutate_bytes(random, packed) if random.random() < 0.3 else packed, 1)
        return packed

    def _add(self, random: Random, archive: tarfile.TarFile) -> None:
        member = tarfile.TarInfo(random.choice(NAMES))
        member.type, member.linkname = random.choice(self.KINDS), random.choice(NAMES)
        content = random.choice(self.HEADERS if member.type in (tarfile.XHDTYPE, tarfile.XGLTYPE) else CONTENTS)
        member.size = len(content)
        try:
            archive.addfile(member, io.BytesIO(content))
        except (ValueError, UnicodeError):  # a name too long for the format
            return

    def _spoil_header(self, random: Random, content: bytearray) -> None:
        """Another size, kind or name in a header whose checksum holds."""
        place = 512 * random.randrange(len(content) // 512)
        match random.randrange(3):
            case 0:
                size = random.choice(
                    (b"77777777777\0", b"00000000000\0", b"\x80" + b"\xff" * 11, b"\x80" + bytes(7) + b"\1" * 4)
                )
                content[place + 124 : place + 136] = size
            case 1:
                content[place + 156 : place + 157] = random.choice(self.KINDS)
            case 2:
                content[place : place + 100] = random.choice(NAMES).encode()[:100].ljust(100, b"\0")
        content[place + 148 : place + 156] = b" " * 8
        checksum = sum(content[place : place + 512])
        content[place + 148 : place + 156] = b"%06o\0 " % checksum


FORMATS = (Zip(), Tar())
