"""Speed of reading alone, by number of threads, or of processes: decoding, sampling and, for a GPU, the upload.

With processes (`--set run.reader=process`) the processor time is only of the process that takes the frames.

python -m experiments.reading --config 7scenes --data path/to/redkitchen --frames 0:300 --workers 1 2 4 8 16
"""

import os
import statistics
import time
from pathlib import Path

import cv2
import torch

from experiments import timing
from experiments.arguments import add_changes, add_sequence, make_parser
from spslam.cli.arguments import frame_range
from spslam.config import Config, load_config
from spslam.datasets import open_sequence
from spslam.datasets.base import RgbdDataset
from spslam.run.device import resolve_device
from spslam.run.frame_feed import FrameFeed


def main() -> None:
    """Parses the arguments and prints a row per number of threads."""
    parser = make_parser(__doc__)
    add_sequence(parser)
    parser.add_argument("--frames", default="0:300", type=frame_range, help="START:STOP[:STEP]")
    parser.add_argument("--device", default="cpu", help="cuda includes the upload")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--rounds", type=int, default=3)
    add_changes(parser)
    parser.add_argument("--json", type=Path, help="file to write the results to")
    args = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    device = resolve_device(args.device)
    rows = []
    for workers in args.workers:
        config = load_config(args.config, None, [f"run.prefetch_workers={workers}", *args.set])
        dataset = open_sequence(config.dataset, args.data, args.frames)
        rounds = [read_all(dataset, config, device) for _ in range(args.rounds)]
        rows.append({"workers": workers, **{name: statistics.median(r[name] for r in rounds) for name in rounds[0]}})
    timing.report(f"{args.config}, {len(dataset)} frames, {os.cpu_count()} cores", rows, device, args.json)


def read_all(dataset: RgbdDataset, config: Config, device: torch.device) -> dict[str, float]:
    """Frames/s, and ms/frame: of the reading threads, and of the processors in user and system mode."""
    with FrameFeed(dataset, config, device) as feed:
        feed.prepare()  # the start of a process is none of it
        started, before = time.perf_counter(), os.times()
        for _ in feed:
            pass
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        seconds = time.perf_counter() - started
        frames, after = len(dataset), os.times()
        return {
            "frames_s": frames / seconds,
            "thread_ms": 1e3 * feed.decode_seconds / frames,
            "user_ms": 1e3 * (after.user - before.user) / frames,
            "system_ms": 1e3 * (after.system - before.system) / frames,
        }


if __name__ == "__main__":
    main()
