"""Many rounds through the generated room: does the error grow from round to round, and does memory?

    python -m experiments.rounds --rounds 10 --device cuda --preset balanced --json rounds.json

One round is 300 frames. The whole trajectory is aligned at once; the error of a round is that of its frames. Memory is
measured at the end of a round: the map, the stored pixels (limited by pixels.budget_mb), the process, the GPU.
"""

import argparse
import os
from pathlib import Path

import numpy as np
import torch

from experiments import timing
from experiments.arguments import add_options, make_parser
from spslam.config import load_config
from spslam.datasets import open_sequence
from spslam.datasets.generated import FRAMES_PER_ROUND
from spslam.errors import DatasetError
from spslam.evaluation.trajectory_metrics import absolute_errors, align
from spslam.run.device import resolve_device
from spslam.run.frame_feed import FrameFeed
from spslam.slam.system import SlamSystem


def main() -> None:
    """Parses the arguments, runs the rounds, prints a line per round."""
    args = _parser().parse_args()
    frames = FRAMES_PER_ROUND * args.rounds
    overrides = [f"device={args.device}", f"dataset.frames={frames}", f"dataset.noise={args.noise}", *args.set]
    config = load_config("demo", args.preset, overrides)
    device = resolve_device(config.device)
    dataset = open_sequence(config.dataset, None, None)
    ground_truth = dataset.poses()
    system = SlamSystem(config, dataset.camera, ground_truth[0], device)
    held = []
    with FrameFeed(dataset, config, device) as feed:
        for frame in feed:
            if isinstance(frame, DatasetError):
                raise frame
            system.submit(frame)
            if len(system.state.frames) % FRAMES_PER_ROUND == 0:
                held.append(memory(system))
                print(f"round {len(held)}", flush=True)
    system.finish()
    path = system.trajectory()
    known = path.mask_lost(ground_truth)
    errors_cm = 100 * absolute_errors(path.poses, known, align(path.poses, known)).reshape(args.rounds, -1)
    lost = path.lost.reshape(args.rounds, -1).sum(1)
    rows = [
        {
            "round": number,
            "ate_rmse_cm": float(np.sqrt(np.nanmean(of_round**2))),
            "ate_max_cm": float(np.nanmax(of_round)),
            "lost": int(lost_of_round),
            **held_then,
        }
        for number, (of_round, lost_of_round, held_then) in enumerate(zip(errors_cm, lost, held, strict=True), 1)
    ]
    timing.report(f"generated room, {args.preset or config.preset}, {frames} frames", rows, device, args.json)


def memory(system: SlamSystem) -> dict[str, float]:
    """Memory in use."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    figures = {
        "voxels": system.state.scene.volume.num_voxels,
        "map_mb": system.state.scene.nbytes / 2**20,
        "pixels_mb": system.state.pixels.nbytes / 2**20,
        "rss_mb": pages * os.sysconf("SC_PAGE_SIZE") / 2**20,
    }
    if system.device.type == "cuda":
        figures["gpu_mb"] = torch.cuda.memory_allocated(system.device) / 2**20
    return figures


def _parser() -> argparse.ArgumentParser:
    parser = make_parser(__doc__)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--noise", type=float, default=1.0, help="of the depth camera; 1 is a Kinect's")
    parser.add_argument("--device", default="auto")
    add_options(parser)
    parser.add_argument("--json", type=Path, help="file to write the results to")
    return parser


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
