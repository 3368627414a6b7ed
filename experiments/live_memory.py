"""Memory of a live run that goes on for long: a recording is played to and fro, and what is held is printed.

    python -m experiments.live_memory --config 7scenes --data DATA/redkitchen --frames 54000
    python -m experiments.live_memory --config demo --frames 9000 --rate 60 --every 900

54,000 frames are half an hour at 30 Hz. Without --rate each frame comes when the one before is tracked, so that none is
dropped, whatever else the machine does.

Each row is the time since the first frame, frames tracked and dropped up to then, latency (p99 of the last frames),
processor time per frame since the row before (which other programs disturb less than latency), the process's memory
(resident; of that what is no file's), and what grows or could: map, stored pixels, keyframes and edges of the graph,
frames whose image features are kept, and the frames' own rows.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import torch

from experiments.arguments import add_options, add_sequence, make_parser
from spslam.config import load_config
from spslam.datasets import open_sequence
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.datasets.prefetch import prefetch
from spslam.errors import DatasetError
from spslam.live.loop import LiveStatus
from spslam.live.replay import AHEAD, ReplaySource
from spslam.live.request import LiveRequest
from spslam.live.session import run_live
from spslam.live.source import LiveFrame
from spslam.run.observer import ObservedRun, RunObserver
from spslam.slam.frame_report import FrameReport
from spslam.slam.state import SlamState

WAIT_S = 0.1  # between two looks for Ctrl-C


class MemoryLog(RunObserver):
    """Prints a row from time to time.

    Args:
        every: frames between two rows.
    """

    def __init__(self, every: int):
        self.rows: list[dict[str, float]] = []
        self.status = LiveStatus()
        self.tracked = threading.Semaphore()
        self._every = every

    def begin(self, run: ObservedRun, state: SlamState) -> None:
        self._state, self._began = state, time.monotonic()
        self._processor_s = time.process_time()

    def observe(self, report: FrameReport, frame: RgbdFrame | None = None) -> None:
        if (report.frame + 1) % self._every:
            return
        processor_s, before = time.process_time(), self._processor_s
        self._processor_s = processor_s
        row = {
            "minutes": (time.monotonic() - self._began) / 60,
            "frames": self.status.frames,
            "dropped": self.status.dropped,
            "p99_ms": self.status.latencies.recent_p99(),
            "processor_ms": 1e3 * (processor_s - before) / self._every,
            **memory_mb(),
            **held(self._state),
        }
        self.rows.append(row)
        print("  ".join(f"{name} {value:.4g}" for name, value in row.items()), flush=True)

    def tell(self, status: LiveStatus) -> None:
        """Takes note of where the run stands, and lets the next frame come."""
        self.status = status
        self.tracked.release()


class UnhurriedSource(ReplaySource):
    """A replay of which each frame comes when the one before is tracked.

    Args:
        dataset: the frames.
        repeat: as of `ReplaySource`.
        tracked: released for each frame, and once before the first.
    """

    def __init__(self, dataset: RgbdDataset, repeat: int, tracked: threading.Semaphore) -> None:
        super().__init__(dataset, repeat=repeat)
        self._tracked = tracked

    def frames(self) -> Iterator[LiveFrame | DatasetError | None]:
        with prefetch(self, self._readers, AHEAD) as decoded:
            for frame in decoded:
                while not self._tracked.acquire(timeout=WAIT_S):
                    yield None
                if frame is not None:
                    yield frame if isinstance(frame, DatasetError) else LiveFrame(frame, time.monotonic())


def memory_mb() -> dict[str, float]:
    """Of the process, MB: resident, and resident without files."""
    status = Path("/proc/self/status").read_text()
    kib = {name: int(value) for name, value in re.findall(r"(VmRSS|RssAnon):\s+(\d+)", status)}
    return {"rss_mb": kib["VmRSS"] / 1024, "anonymous_mb": kib["RssAnon"] / 1024}


def held(state: SlamState) -> dict[str, float]:
    """What a state holds."""
    rows_mb = sum(column.nbytes for column in state.frames.tensors().values()) / 2**20
    graph = state.graph
    return {
        "voxels": state.scene.volume.num_voxels,
        "pixels_mb": state.pixels.nbytes / 2**20,
        "keyframes": 0 if graph is None else len(graph.keyframes),
        "edges": 0 if graph is None else len(graph.content.edges),
        "left_out": 0 if graph is None else len(graph.anchors),
        "feature_frames": len(state.features),
        "rows_mb": rows_mb,
    }


def main() -> None:
    """Parses the arguments, plays the recording, prints the rows."""
    args = _parser().parse_args()
    config = load_config(args.config, args.preset, [f"device={args.device}", *args.set])
    dataset = open_sequence(config.dataset, args.data, None)
    passes = max(-(-args.frames // max(len(dataset) - 1, 1)), 1)
    log = MemoryLog(args.every)
    source = ReplaySource(dataset, args.rate, passes) if args.rate else UnhurriedSource(dataset, passes, log.tracked)
    with tempfile.TemporaryDirectory() as folder:
        request = LiveRequest(config, Path(folder), mesh=False)
        metrics = run_live(request, source, log.tell, observer=log)
    print(json.dumps({name: value for name, value in metrics.items() if isinstance(value, (int, float))}))
    if args.json:
        args.json.write_text(json.dumps(log.rows, indent=1) + "\n")


def _parser() -> argparse.ArgumentParser:
    parser = make_parser(__doc__)
    add_sequence(parser)
    parser.add_argument("--frames", type=int, default=54_000, help="at least so many; the last pass is played whole")
    parser.add_argument("--rate", type=float, help="frames per second; as fast as they are tracked if not given")
    parser.add_argument("--every", type=int, default=1800, help="frames between two rows")
    parser.add_argument("--device", default="cpu")
    add_options(parser)
    parser.add_argument("--json", type=Path, help="file to write the rows to")
    return parser


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
