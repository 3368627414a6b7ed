"""Meshes of generated places by spslam, beside plain TSDF fusion (Open3D) of the same frames at spslam's own poses.

    python -m experiments.places_meshes --places room hall --sensors stereo exact --frames 150 --save meshes.json

Of each place and sensor the figures of `spslam eval`: accuracy, completeness, depth L1, F1 at 1 cm. Open3D's row is
the best by F1 of voxels of 1 and 2 cm with weights from 1 and from 3. The last columns say in how many of the figures
spslam is ahead or equal, and by how much it is behind at most, in percent of Open3D's figure. Needs
`pip install 'spslam[open3d]'`.
"""

import argparse
import json
import tempfile
from itertools import product
from pathlib import Path

from experiments.arguments import add_options, make_parser
from experiments.tsdf_baseline import figures_of_baseline
from spslam.config import load_config
from spslam.datasets import open_dataset
from spslam.datasets.places import PLACES, SENSORS
from spslam.evaluation.finished_run import surface_figures
from spslam.evaluation.run_output import RunOutput
from spslam.run.sequence import RunRequest, run_sequence

VOXELS_M = (0.01, 0.02)
LESS_IS_BETTER = ("accuracy_cm", "completeness_cm", "depth_l1_cm")
F1 = "f1_1cm"
FIGURES = (*LESS_IS_BETTER, F1)


def main() -> None:
    """Parses the arguments; prints a row per case and how often spslam is ahead."""
    args = _parser().parse_args()
    print(f"| place | sensor | {' | '.join(FIGURES)} | ahead or equal | behind by % |")
    print("|---" * (len(FIGURES) + 4) + "|")
    rows = []
    for place, sensor in product(args.places, args.sensors):
        rows.append(measure(args, place, sensor))
        print(table_row(rows[-1]), flush=True)
        if args.save:
            args.save.write_text(json.dumps(rows, indent=1))
    ahead = sum(row["ahead"] == len(FIGURES) for row in rows)
    print(f"ahead or equal in every figure: {ahead} of {len(rows)}")


def measure(args: argparse.Namespace, place: str, sensor: str) -> dict:
    """The figures of one case by spslam and by the best TSDF fusion, and how they compare."""
    options = [f"dataset.place={place}", f"dataset.sensor={sensor}", f"dataset.frames={args.frames}", *args.set]
    config = load_config("places", args.preset, [f"device={args.device}", "run.previews=0", *options])
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "run"
        run_sequence(RunRequest(config, None, output))
        run, dataset = RunOutput.read(output), open_dataset(config.dataset)
        own = surface_figures(run, dataset, dataset.surface)
        others = [row for voxel_m in VOXELS_M for row in figures_of_baseline(run, dataset, dataset.surface, voxel_m)]
    other = max(others, key=lambda row: row[F1])
    behind = {name: shortfall_percent(name, own[name], other[name]) for name in FIGURES}
    return {
        "case": [place, sensor],
        "spslam": {name: own[name] for name in FIGURES},
        "open3d": {name: other[name] for name in FIGURES},
        "ahead": sum(value <= 0 for value in behind.values()),
        "behind_percent": max(*behind.values(), 0.0),
    }


def shortfall_percent(name: str, own: float, other: float) -> float:
    """By how much a figure is worse than the other, in percent of the other; negative where it is better."""
    worse = own - other if name in LESS_IS_BETTER else other - own
    return 100 * worse / max(abs(other), 1e-9)


def table_row(row: dict) -> str:
    """A line of the table."""
    cells = [f"{row['spslam'][name]:.2f} / {row['open3d'][name]:.2f}" for name in FIGURES]
    return f"| {' | '.join([*row['case'], *cells, str(row['ahead'])])} | {row['behind_percent']:.1f} |"


def _parser() -> argparse.ArgumentParser:
    parser = make_parser(__doc__)
    parser.add_argument("--places", nargs="+", choices=tuple(PLACES), default=tuple(PLACES))
    parser.add_argument("--sensors", nargs="+", choices=tuple(SENSORS), default=tuple(SENSORS))
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--save", type=Path, help="JSON file of the rows")
    add_options(parser)
    return parser


if __name__ == "__main__":
    main()
