"""Ways to spoil bytes and texts that know nothing of a format."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from random import Random

# Sizes and indices that overflow, or that a check is likely to be off by one at.
MAX_TEXT = 1_000_000  # characters
INTERESTING = (
    *(0, 1, 2, 3, 4, 7, 8, 15, 16, 17, 31, 32, 63, 64, 100, 127, 128, 255, 256, 1000, 1023, 1024, 4095, 4096),
    *(2**15 - 1, 2**15, 2**16 - 1, 2**16, 2**20 - 1, 2**20, 2**21, 2**24, 2**25, 2**30, 2**31 - 1, 2**31, 2**31 + 1),
    *(2**32 - 1, 2**32, 2**33, 2**40, 2**53, 2**62, 2**63 - 769, 2**63 - 1, 2**63, 2**64 - 769, 2**64 - 1),
    *(-1, -2, -3, -8, -128, -(2**15), -(2**20), -(2**20) - 1, -(2**31), -(2**31) - 1, -(2**62), -(2**63)),
)
NUMBERS = (
    *("0", "-0", "1", "-1", "0.5", "1e-9", "1e-30", "1e-310", "5e-324", "1e9", "1e30", "1e300", "1e308", "-1e308"),
    *("1e309", "-1e309", "nan", "NaN", "-nan", "inf", "-inf", "Infinity", "2147483648", "9223372036854775808"),
    *("18446744073709551616", "9" * 30, "9" * 400, "9" * 4301, "1_000", "0x10", "1.5.5", "1e", "+", "-", ".", ""),
    *("\u0661\u0662", "\u00b2", "\u00bd", "1,5", "1;5", "1 2", "None", "true", "#", "1#"),
)
WORDS = (
    *(
        "\0",
        "\ufeff",
        "\r",
        "\r\n",
        "\x0b",
        "\x1c",
        "\u2028",
        "\u200b",
        "\t",
        "  ",
        "\n\n",
        "\\",
        "/",
        "..",
        "../..",
        "~",
    ),
    *("'", '"', "`", "%s", "%n", "{}", "{0}", "$(id)", "[", "]", "{", "}", "(", ")", "<", ">", ":", ",", ";", "#", "="),
    *("/dev/zero", "/dev/stdin", "/etc/passwd", "\ud7ff", "\U0001f600", "A" * 300, "é" * 200),
)


def mutate_bytes(random: Random, content: bytes, others: Sequence[bytes] = (), times: int | None = None) -> bytes:
    """Spoils bytes a few times over.

    Args:
        random: decides how.
        content: what is spoiled.
        others: what parts may be taken from.
        times: how often; one to four times where None, mostly once.
    """
    for _ in range(times or random.choice((1, 1, 1, 2, 3, 4))):
        content = random.choice(_BYTE_MUTATIONS)(random, content, others)
    return content


def mutate_text(random: Random, text: str, times: int | None = None) -> str:
    """Spoils a text of words, numbers and lines a few times over; one in eight times its bytes, see `mutate_bytes`."""
    if random.random() < 0.125:
        return mutate_bytes(random, to_bytes(text)).decode("utf-8", "surrogateescape")
    for _ in range(times or random.choice((1, 1, 1, 2, 3, 4))):
        # Lines are repeated a thousand times, up to four times over: the harness has a limit on memory too.
        text = random.choice(_TEXT_MUTATIONS)(random, text)[:MAX_TEXT]
    return text


def to_bytes(text: str) -> bytes:
    """UTF-8 of a text that may hold bytes which are none, and halves of characters."""
    return "".join(part if not "\ud800" <= part < "\udc80" else "?" for part in text).encode("utf-8", "surrogateescape")


def any_integer(random: Random, bits: int, signed: bool) -> int:
    """An interesting or random integer of so many bits."""
    value = random.choice(INTERESTING) if random.random() < 0.8 else random.getrandbits(bits)
    value &= (1 << bits) - 1
    return value - (1 << bits) if signed and value >> (bits - 1) else value


def _place(random: Random, content: bytes) -> int:
    """Anywhere, but half of the time near the start, where headers are."""
    if not content:
        return 0
    return random.randrange(len(content) if random.random() < 0.5 else min(len(content), 256))


def _span(random: Random, content: bytes) -> tuple[int, int]:
    begin = _place(random, content)
    return begin, min(begin + random.choice((1, 2, 4, 8, 16, 64, 256, 4096)), len(content))


def _flip(random: Random, content: bytes, others: Sequence[bytes]) -> bytes:
    spoiled = bytearray(content)
    for _ in range(random.choice((1, 1, 2, 4, 16)) if spoiled else 0):
        spoiled[_place(random, content)] ^= 1 << random.randrange(8)
    return bytes(spoiled)


def _overwrite(random: Random, content: bytes, others: Sequence[bytes]) -> bytes:
    begin, end = _span(random, content)
    fill = random.choice((b"\0", b"\xff", b"\x7f", b"\x80", b"0", b" ", None))
    new = random.randbytes(end - begin) if fill is None else fill * (end - begin)
    return content[:begin] + new + content[end:]


def _put_integer(random: Random, content: bytes, others: Sequence[bytes]) -> bytes:
    bits, order = random.choice(((8, "<B"), (16, "<H"), (16, ">H"), (32, "<I"), (32, ">I"), (64, "<Q"), (64, ">Q")))
    new = struct.pack(order, any_integer(random, bits, signed=False))
    place = _place(random, content)
    if random.random() < 0.5:
        place -= place % len(new)
    return content[:place] + new + content[place + len(new) :]


def _truncate(random: Random, content: bytes, others: Sequence[bytes]) -> bytes:
    keep = random.choice((0, 1, len(content) - 1, len(content) - 2, _place(random, content), _place(random, content)))
    return content[: max(keep, 0)]


def _extend(random: Random, content: bytes, others: Sequence[bytes]) -> bytes:
    count = random.choice((1, 2, 8, 100, 4096, 1 << 16))
    return content + (bytes(count) if random.random() < 0.5 else random.randbytes(count))


def _remove(random: Random, content: bytes, others: Sequence[bytes]) -> bytes:
    begin, end = _span(random, content)
    return content[:begin] + content[end:]


def _repeat(random: Random, content: bytes, others: Sequence[bytes]) -> bytes:
    begin, end = _span(random, content)
    times = random.choice((2, 2, 3, 10, 100, 1000)) if end - begin < 1000 else 2
    return content[:begin] + content[begin:end] * times + content[end:]


def _move(random: Random, content: bytes, others: Sequence[bytes]) -> bytes:
    begin, end = _span(random, content)
    rest = content[:begin] + content[end:]
    place = _place(random, rest)
    return rest[:place] + content[begin:end] + rest[place:]


def _splice(random: Random, content: bytes, others: Sequence[bytes]) -> bytes:
    other = random.choice(list(others)) if others else content
    begin = _place(random, other)
    if random.random() < 0.5:
        return content[: _place(random, content)] + other[begin:]
    part, place = other[begin : begin + random.choice((4, 16, 64, 1024))], _place(random, content)
    return content[:place] + part + content[place + len(part) :]


_BYTE_MUTATIONS: tuple[Callable[[Random, bytes, Sequence[bytes]], bytes], ...] = (
    *(_flip, _overwrite, _put_integer, _put_integer, _truncate, _extend, _remove, _repeat, _move, _splice),
)


def _edit_word(random: Random, text: str) -> str:
    """Another number or word in place of one, or beside it."""
    words = text.split(" ")
    place = random.randrange(len(words))
    new = random.choice(NUMBERS if random.random() < 0.7 else WORDS)
    words[place : place + random.choice((0, 1, 1, 1))] = [new]
    return " ".join(words)


def _edit_number(random: Random, text: str) -> str:
    """Another number in place of one, wherever it stands."""
    starts = [i for i, character in enumerate(text) if character.isdigit()]
    if not starts:
        return text
    begin = end = random.choice(starts)
    while begin > 0 and (text[begin - 1].isdigit() or text[begin - 1] in ".-+e"):
        begin -= 1
    while end < len(text) and (text[end].isdigit() or text[end] in ".-+e"):
        end += 1
    return text[:begin] + random.choice(NUMBERS) + text[end:]


def _insert_word(random: Random, text: str) -> str:
    place = random.randrange(len(text) + 1)
    return text[:place] + random.choice(WORDS) + text[place:]


def _edit_lines(random: Random, text: str) -> str:
    lines = text.split("\n")
    i, j = random.randrange(len(lines)), random.randrange(len(lines))
    match random.randrange(6):
        case 0:
            lines[i], lines[j] = lines[j], lines[i]
        case 1:
            del lines[i]
        case 2:
            lines[i:i] = [lines[j]] * random.choice((1, 1, 2, 10, 1000))
        case 3:
            random.shuffle(lines)
        case 4:
            lines[i] = lines[i][: random.randrange(len(lines[i]) + 1)]
        case 5:
            lines[i:i] = random.choice(([""] * 1000, ["#" * 1000], [" "]))
    return random.choice(("\n", "\n", "\n", "\n", "\r\n", " ", "")).join(lines)


def _cut_text(random: Random, text: str) -> str:
    begin, end = sorted(random.randrange(len(text) + 1) for _ in range(2))
    return random.choice((text[:begin], text[begin:], text[:begin] + text[end:], text + text[begin:end], ""))


_TEXT_MUTATIONS: tuple[Callable[[Random, str], str], ...] = (
    *(_edit_word, _edit_word, _edit_number, _edit_number, _edit_number, _insert_word, _edit_lines, _cut_text),
)
