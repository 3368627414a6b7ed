"""Time to decode PNG files, by `spslam.datasets.png` and by OpenCV, in turn; exits with 1 where pixels differ.

    python -m experiments.png_decoding --depth 'DATA/redkitchen/seq-01/*.depth.png' --color 'DATA/rgb/*.png'

Milliseconds of processor time of one thread per image, medians of the rounds. --encode-color writes other images, as
JPEG files, as PNG first.
"""

import functools
import glob
import sys
import time
from collections.abc import Callable

import cv2
import numpy as np
import torch

from experiments import timing
from experiments.arguments import make_parser
from spslam.datasets.png import decode_png


def main() -> None:
    """Parses the arguments and prints a line per set of files."""
    parser = make_parser(__doc__)
    parser.add_argument("--depth", nargs="*", default=[], metavar="PATTERN", help="gray images")
    parser.add_argument("--color", nargs="*", default=[], metavar="PATTERN", help="RGB images")
    parser.add_argument("--encode-color", nargs="*", default=[], metavar="PATTERN", help="images to be written as PNG")
    parser.add_argument("--images", type=int, default=60, help="of each set at most")
    parser.add_argument("--rounds", type=int, default=7)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    sets = [(1, each, read) for each in args.depth] + [(3, each, read) for each in args.color]
    sets += [(3, each, encode) for each in args.encode_color]
    print("| files | OpenCV ms | spslam ms |\n|---|---|---|")
    for channels, pattern, load in sets:
        contents = [load(path) for path in sorted(glob.glob(pattern))[: args.images]]
        if not contents:
            sys.exit(f"{pattern}: no such files")
        check(contents, channels, pattern)
        contenders = {
            name: functools.partial(decode_all, decode, contents, channels)
            for name, decode in (("OpenCV", by_opencv), ("spslam", decode_png))
        }
        times = timing.compare(contenders, args.rounds, torch.device("cpu"), time.thread_time)
        print(f"| {pattern} |" + "".join(f" {ms / len(contents):.2f} |" for ms in times.values()), flush=True)


def read(path: str) -> bytes:
    """A file's content."""
    with open(path, "rb") as file:
        return file.read()


def encode(path: str) -> bytes:
    """An image as a PNG."""
    return cv2.imencode(".png", cv2.imread(path))[1].tobytes()


def by_opencv(content: bytes, channels: int) -> np.ndarray:
    """As `decode_png`."""
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED if channels == 1 else cv2.IMREAD_COLOR)
    return image if channels == 1 else cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)


def check(contents: list[bytes], channels: int, pattern: str) -> None:
    """Exits where one image is decoded otherwise than by OpenCV."""
    for content in contents:
        if not np.array_equal(decode_png(content, channels), by_opencv(content, channels)):
            sys.exit(f"{pattern}: pixels differ from OpenCV's")


def decode_all(decode: Callable[[bytes, int], object], contents: list[bytes], channels: int) -> None:
    """Decodes all images."""
    for content in contents:
        decode(content, channels)


if __name__ == "__main__":
    main()
