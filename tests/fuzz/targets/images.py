"""Color and depth images: PNG, JPEG, TIFF and npy."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from random import Random

import cv2
import numpy as np

from spslam.datasets.images import read_color, read_depth
from tests.datasets.layouts import HEIGHT, WIDTH, color_image, depth_meters
from tests.fuzz.formats import Format
from tests.fuzz.mutations import INTERESTING, any_integer, mutate_bytes, mutate_text

DEPTH = np.round(1000 * depth_meters(0)).astype(np.uint16)
NOISE = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def encoded(suffix: str, image: np.ndarray, *flags: int) -> bytes:
    """An image's file."""
    done, content = cv2.imencode(suffix, image, list(flags))
    assert done
    return content.tobytes()


class _Image(Format):
    """Images of one kind, read as color and as depth, of any size and of an expected one."""

    suffix: str
    examples: tuple[bytes, ...]

    def write(self, random: Random, folder: Path) -> None:
        content = self.spoiled(random, random.choice(self.examples))
        (folder / f"image{self.suffix}").write_bytes(content)

    def spoiled(self, random: Random, content: bytes) -> bytes:
        return mutate_bytes(random, content, self.examples)

    def read(self, folder: Path) -> None:
        path = folder / f"image{self.suffix}"
        # An image that can't be depth may be color, and the other way round.
        done = [_ends_well(read_color, path), _ends_well(read_depth, path, None)]
        if not any(done):
            read_depth(path, 1000.0, (65535,), (WIDTH, HEIGHT))


def _ends_well(read, *arguments) -> bool:
    from spslam.errors import DatasetError

    try:
        read(*arguments)
    except DatasetError:
        return False
    return True


class Png(_Image):
    """PNG: bytes, and chunks with a checksum that holds."""

    name, suffix = "png", ".png"
    examples = (
        encoded(".png", DEPTH),
        encoded(".png", color_image(0)),
        encoded(".png", NOISE),
        encoded(".png", np.dstack([NOISE, NOISE[..., :1]])),
        encoded(".png", NOISE[..., 0], cv2.IMWRITE_PNG_BILEVEL, 1),
    )

    def spoiled(self, random: Random, content: bytes) -> bytes:
        if random.random() < 0.4:
            return super().spoiled(random, content)
        chunks = list(_png_chunks(content))
        for _ in range(random.choice((1, 1, 2))):
            self._spoil_chunk(random, chunks)
        return content[:8] + b"".join(_png_chunk(name, body) for name, body in chunks)

    def _spoil_chunk(self, random: Random, chunks: list[tuple[bytes, bytes]]) -> None:
        place = random.randrange(len(chunks))
        name, body = chunks[place]
        match random.randrange(7):
            case 0:  # the header: sizes, depth, kind, interlacing
                head = bytearray(chunks[0][1].ljust(13, b"\0"))
                if random.random() < 0.5:
                    side = random.choice((any_integer(random, 32, False), 32, 24, 1, 33, 16384, 30000))
                    struct.pack_into(">I", head, random.choice((0, 4)), side)
                else:
                    head[random.randrange(8, 13)] = random.choice((0, 1, 2, 3, 4, 6, 8, 16, 255))
                chunks[0] = chunks[0][0], bytes(head)
            case 1:
                chunks[place] = name, mutate_bytes(random, body)
            case 2:  # other pixels, well compressed
                size = random.choice((0, 1, WIDTH * HEIGHT, 10**5, 10**7))
                chunks[place] = name, zlib.compress(bytes(size))
            case 3:
                chunks[place] = (
                    random.choice((b"IHDR", b"IDAT", b"PLTE", b"tRNS", b"iCCP", b"zTXt", b"eXIf", b"IEND")),
                    body,
                )
            case 4:
                del chunks[place]
            case 5:
                extra = random.choice((b"zTXt", b"iCCP", b"iTXt"))
                chunks.insert(place, (extra, b"name\0\0" + zlib.compress(bytes(random.choice((10, 10**6, 10**7))))))
            case 6:  # an animation
                control = struct.pack(">II", *(random.choice((0, 1, 2, 2**31 - 1)) for _ in range(2)))
                frame = struct.pack(
                    ">IIIIIHHBB", *(random.choice((0, 1, WIDTH, HEIGHT, 10**5)) for _ in range(5)), 1, 1, 0, 0
                )
                chunks[1:1] = [(b"acTL", control), (b"fcTL", frame)]
                chunks.insert(
                    random.randrange(len(chunks)),
                    (b"fdAT", struct.pack(">I", random.choice(INTERESTING) % 2**32) + body),
                )
        if not chunks:
            chunks.append((name, body))


def _png_chunks(content: bytes):
    place = 8
    while place < len(content):
        (length,) = struct.unpack_from(">I", content, place)
        yield content[place + 4 : place + 8], content[place + 8 : place + 8 + length]
        place += 12 + length


def _png_chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


class Jpeg(_Image):
    """JPEG: bytes, and the fields of its segments."""

    name, suffix = "jpeg", ".jpg"
    examples = (
        encoded(".jpg", color_image(0)),
        encoded(".jpg", NOISE),
        encoded(".jpg", NOISE, cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
        encoded(".jpg", NOISE[..., 0]),
        encoded(".jpg", NOISE, cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
    )

    def spoiled(self, random: Random, content: bytes) -> bytes:
        if random.random() < 0.5:
            return super().spoiled(random, content)
        markers = [i for i in range(len(content) - 10) if content[i] == 0xFF and content[i + 1] not in (0, 0xFF)]
        place = random.choice(markers)
        spoiled = bytearray(content)
        match random.randrange(5):
            case 0:
                spoiled[place + 1] = random.choice(
                    (0xC0, 0xC1, 0xC2, 0xC3, 0xC4, 0xC9, 0xD8, 0xD9, 0xDA, 0xDB, 0xDC, 0xDD)
                )
            case 1:
                struct.pack_into(">H", spoiled, place + 2, any_integer(random, 16, False))
            case 2:  # the size
                frame = next(i for i in markers if content[i + 1] in (0xC0, 0xC2))
                struct.pack_into(">H", spoiled, frame + random.choice((5, 7)), any_integer(random, 16, False))
            case 3:  # components and tables
                spoiled[place + random.randrange(4, 10)] = random.randrange(256)
            case 4:  # a scan again and again
                scan = content.rindex(b"\xff\xda")
                return content[:-2] + content[scan:-2] * random.choice((1, 10, 300, 1000)) + content[-2:]
        return bytes(spoiled)


class Tiff(_Image):
    """TIFF: bytes, and the entries of its directory."""

    name, suffix = "tiff", ".tiff"
    examples = (
        encoded(".tiff", DEPTH),
        encoded(".tiff", depth_meters(0).astype(np.float32)),
        encoded(".tiff", depth_meters(0)),
        encoded(".tiff", NOISE, cv2.IMWRITE_TIFF_COMPRESSION, 1),
        encoded(".tiff", DEPTH, cv2.IMWRITE_TIFF_COMPRESSION, 8),
    )
    TAGS = (254, 256, 257, 258, 259, 262, 273, 274, 277, 278, 279, 284, 317, 322, 323, 324, 325, 330, 338, 339, 34675)

    def spoiled(self, random: Random, content: bytes) -> bytes:
        if random.random() < 0.4:
            return super().spoiled(random, content)
        spoiled = bytearray(content)
        (directory,) = struct.unpack_from("<I", content, 4)
        (count,) = struct.unpack_from("<H", content, directory)
        for _ in range(random.choice((1, 1, 2, 3))):
            entry = directory + 2 + 12 * random.randrange(count)
            match random.randrange(4):
                case 0:
                    struct.pack_into("<H", spoiled, entry, random.choice(self.TAGS))
                case 1:
                    struct.pack_into("<H", spoiled, entry + 2, random.choice((0, 1, 2, 3, 4, 5, 9, 12, 13, 16, 255)))
                case 2:
                    struct.pack_into("<I", spoiled, entry + 4, any_integer(random, 32, False))
                case 3:
                    struct.pack_into("<I", spoiled, entry + 8, any_integer(random, 32, False))
        return bytes(spoiled)


class Npy(_Image):
    """Arrays: bytes, and the words of the header."""

    name, suffix = "npy", ".npy"
    WORDS = (
        "<f4",
        "<f8",
        ">f4",
        "<u2",
        "|u1",
        "<i8",
        "|O",
        "<U9",
        "<M8[s]",
        "[('a','<f4')]",
        "V8",
        "<f2",
        "<c16",
        "<f16",
    )
    SHAPES = (
        "()",
        "(24,)",
        "(24, 32)",
        "(32, 24)",
        "(10**6,)",
        "(1000000, 1000000)",
        "(-1, 24)",
        "(0, 24)",
        "(24, 32, 1)",
    )
    SHAPES += ("(True, 24)", "(2.0, 3)", "[24, 32]", "(99999999999999999999, 1)", "(1, 4611686018427387904)", "({}, 1)")

    def __init__(self) -> None:
        arrays = (DEPTH, depth_meters(0).astype(np.float32), depth_meters(0), np.asfortranarray(depth_meters(0)))
        self.examples = tuple(_saved(array) for array in arrays)

    def spoiled(self, random: Random, content: bytes) -> bytes:
        kind = random.random()
        if kind < 0.3:
            return super().spoiled(random, content)
        if kind < 0.35:
            buffer = io.BytesIO()
            np.savez(buffer, a=DEPTH)
            return mutate_bytes(random, buffer.getvalue()) if random.random() < 0.5 else buffer.getvalue()
        (length,) = struct.unpack_from("<H", content, 8)
        header, body = content[10 : 10 + length].decode(), content[10 + length :]
        match random.randrange(4):
            case 0:
                header = header.replace(header.split("'")[3], random.choice(self.WORDS))
            case 1:
                header = header.replace("(24, 32)", random.choice(self.SHAPES))
            case 2:
                header = mutate_text(random, header)
            case 3:
                header = random.choice(("(", "[", "-", "~", "{1:", "lambda:", "'")) * random.choice((10, 1000, 9000))
        text = header.encode("utf-8", "surrogateescape")
        version = random.choice((b"\1\0", b"\1\0", b"\1\0", b"\2\0", b"\3\0", b"\0\0"))
        size = struct.pack("<H" if version == b"\1\0" else "<I", min(len(text), 65535))
        return b"\x93NUMPY" + version + size + text + body


def _saved(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


FORMATS = (Png(), Jpeg(), Tiff(), Npy())
