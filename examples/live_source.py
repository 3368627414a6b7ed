"""A camera of your own for live runs: a class with two attributes and one method. Here it is a generated room.

python examples/live_source.py out              until Ctrl-C; writes what `spslam live` writes
python examples/live_source.py out --frames 30  a second of it
"""

import argparse
import time
from pathlib import Path

from spslam import Camera, RgbdFrame, load_config
from spslam.datasets.generated import GeneratedDataset
from spslam.live import LiveRequest, LiveSource
from spslam.live.session import run_live


class MyCamera(LiveSource):
    """What your driver has to offer; `grab` stands for its blocking call."""

    def __init__(self, count):
        self.driver, self.count = GeneratedDataset(max(count, 300), 160, 120), count
        self.name = "my camera"
        lens = self.driver.camera
        self.camera = Camera(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)

    def frames(self):
        for number in range(self.count):
            color, millimeters = self.grab(number)
            yield RgbdFrame.from_arrays(color, millimeters, time.time(), depth_scale=1000)

    def grab(self, number):
        time.sleep(1 / 30)
        frame = self.driver[number]
        return frame.color, (1000 * frame.depth).astype("uint16")


def main():
    parser = argparse.ArgumentParser(description="a live run over a camera of your own")
    parser.add_argument("output", type=Path, help="folder for the results")
    parser.add_argument("--frames", type=int, default=300, help="when to end")
    args = parser.parse_args()
    request = LiveRequest(load_config("folder", overrides=["device=cpu"]), args.output)
    metrics = run_live(request, MyCamera(args.frames), lambda status: print(status.report, flush=True))
    print(f"{metrics['frames']} frames, {metrics['dropped_frames']} dropped, p99 {metrics['latency_p99_ms']:.0f} ms")


if __name__ == "__main__":
    main()
