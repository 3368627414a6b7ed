"""Time to render a frame of each generated place with each sensor, ms of one core.

python -m experiments.places_speed --places room apartment --sensors exact stereo --size 320 240
"""

import json
import statistics
import time

import cv2

from experiments.arguments import make_parser
from spslam.datasets.places import MOTIONS, PLACES, SENSORS, Capture, PlacesDataset


def main() -> None:
    """Parses the arguments and prints a row per place: the median (slowest) of frames spread over the sequence."""
    parser = make_parser(__doc__)
    parser.add_argument("--places", nargs="+", choices=tuple(PLACES), default=tuple(PLACES))
    parser.add_argument("--sensors", nargs="+", choices=tuple(SENSORS), default=tuple(SENSORS))
    parser.add_argument("--motion", choices=tuple(MOTIONS), default="walking")
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--capture", nargs="*", default=(), metavar="NAME=VALUE", help="such as exposure_ms=10")
    parser.add_argument("--frames", type=int, default=31, help="how many are measured")
    parser.add_argument("--seconds", type=float, default=100.0, help="length of the sequence")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    print("| place | " + " | ".join(sensor.replace("_", " ") for sensor in args.sensors) + " |")
    print("|---|" + "---|" * len(args.sensors))
    for place in args.places:
        cells = [measure(place, sensor, args) for sensor in args.sensors]
        print(f"| {place} | " + " | ".join(cells) + " |", flush=True)


def measure(place: str, sensor: str, args) -> str:
    """Median (slowest) ms of the frames."""
    rate = 30.0
    effects = {name: json.loads(value) for name, value in (text.split("=") for text in args.capture)}
    capture = Capture(*args.size, rate_hz=rate, **effects)
    data = PlacesDataset(place, args.motion, sensor, frames=round(args.seconds * rate), capture=capture)
    times = []
    data[0]  # loads what is made once
    for k in range(args.frames):
        started = time.thread_time()
        data[k * (len(data) - 1) // max(args.frames - 1, 1)]
        times.append(1e3 * (time.thread_time() - started))
    return f"{statistics.median(times):.0f} ({max(times):.0f})"


if __name__ == "__main__":
    main()
