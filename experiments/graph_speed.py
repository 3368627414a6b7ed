"""Rates of the keyframe graph's work on the keyframes of a finished run.

    spslam run 7scenes --data path/to/redkitchen --frames 0:300 --output runs/kitchen
    python -m experiments.graph_speed runs/kitchen --device cuda --keyframes 1000

Registered: each keyframe with the four before it, from the relative pose of the run. Map made again: all of them
encoded into an empty map, from the first again after the last until there are as many as asked for. Medians over
rounds.
"""

import statistics
import time
from collections.abc import Callable
from itertools import cycle, islice
from pathlib import Path

import torch

from experiments import timing
from spslam.config import Config, load_config
from spslam.geometry import compose, inverse
from spslam.prior import load_prior
from spslam.run.device import resolve_device
from spslam.run_folder import RunFolder
from spslam.scene import SparseVolume
from spslam.slam.graph.archive import KeyframeArchive
from spslam.slam.graph.registration import Registrar
from spslam.slam.graph.remap import encode_keyframes, own_stream
from spslam.slam.host_threads import host_threads
from spslam.slam.opened_map import load_archive
from spslam.slam.poses import pose_tensor

BEFORE = 4  # keyframes, which each is registered with


def main() -> None:
    """Parses the arguments, measures, prints a table."""
    parser = timing.arguments(__doc__)
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument("--keyframes", type=int, default=1000, help="of the map that is made again")
    args = parser.parse_args()
    timing.use_threads(args.threads)
    folder, device = RunFolder(args.run), resolve_device(args.device)
    archive, config = load_archive(folder), load_config(folder.config)
    rows: list[dict[str, object]] = [
        registered(archive, config, device, args.rounds, features) for features in (True, False)
    ]
    rows.append(made_again(archive, config, device, args.rounds, args.keyframes))
    timing.report(f"{args.run}, {len(archive.keyframes)} keyframes", rows, device, args.json)


def registered(
    archive: KeyframeArchive, config: Config, device: torch.device, rounds: int, features: bool
) -> dict[str, object]:
    """A row: pairs of keyframes registered in one call, with the help of image features or without."""
    keyframes, poses = archive.keyframes, archive.poses
    pairs = [(one, one - before) for one in range(len(keyframes)) for before in range(1, BEFORE + 1) if one >= before]
    starts = torch.stack(
        [pose_tensor(compose(inverse(poses[other]), poses[one]), torch.device("cpu")) for one, other in pairs]
    )
    registrar = Registrar(archive.noise, config.seed, config.tracking.color, features, device, host_threads(device))
    chosen = [(keyframes[one], keyframes[other]) for one, other in pairs]
    seconds = _seconds(lambda: registrar.register_all(chosen, starts), rounds)
    work = "pairs registered" + (", with image features" if features else "")
    return {"work": work, "count": len(pairs), "s": seconds, "per s": len(pairs) / seconds}


def made_again(
    archive: KeyframeArchive, config: Config, device: torch.device, rounds: int, count: int
) -> dict[str, object]:
    """A row: so many keyframes encoded into an empty map."""
    pool = host_threads(device)
    prior = load_prior(config.prior.weights, config.prior.neighborhood).to(device)
    keyframes = list(islice(cycle(zip(archive.keyframes, archive.poses, strict=True)), count))

    def make() -> None:
        volume = SparseVolume(config.scene.voxel_size_m, config.scene.max_voxels, device)
        with own_stream(device):
            encode_keyframes(volume, keyframes, prior, config, pool)

    seconds = _seconds(make, rounds)
    return {"work": "keyframes made a map again", "count": count, "s": seconds, "per s": count / seconds}


def _seconds(call: Callable[[], object], rounds: int) -> float:
    """Median of the wall time of a call, the first one left out."""
    times = []
    for _ in range(rounds + 1):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return statistics.median(times[1:])


if __name__ == "__main__":
    main()
