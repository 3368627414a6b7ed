"""`spslam pretrain`: trains the encoder and decoder of the scene prior on procedurally generated solids."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from spslam.cli.arguments import add_quiet, at_least_one
from spslam.cli.progress import SECONDS_BETWEEN_LINES

DEFAULT_OUTPUT = Path("prior.safetensors")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--output",
        metavar="FILE",
        type=Path,
        default=DEFAULT_OUTPUT,
        help=f"weights file to write (default: {DEFAULT_OUTPUT}), for prior.weights in a configuration",
    )
    parser.add_argument("--steps", metavar="N", type=at_least_one, help="optimization steps (default: as shipped)")
    parser.add_argument("--seed", metavar="N", type=int, help="seed of all random numbers (default: 0)")
    parser.add_argument(
        "--neighborhood",
        type=int,
        choices=(8, 64),
        help="number of voxel vertices that a point is encoded to (default: 64)",
    )
    parser.add_argument("--resume", action="store_true", help="resume an interrupted training from its checkpoint")
    parser.add_argument("--plot", action="store_true", help="plot the training error to an image beside FILE")
    add_quiet(parser)


def execute(args: argparse.Namespace) -> None:
    from spslam.prior.pretrain import pretrain, training_files
    from spslam.prior.training_plots import plot_training, require_matplotlib

    if args.plot:
        require_matplotlib()
    args.output.parent.mkdir(parents=True, exist_ok=True)
    files = training_files(args.output)
    try:
        provenance = pretrain(args.output, _settings(args), args.resume, progress=_make_progress(args.quiet))
    except KeyboardInterrupt:
        raise KeyboardInterrupt("the same command with --resume continues") from None
    if args.plot:
        plot_training(files.log, files.plot)
    if not args.quiet:
        _print_validation(provenance["validation"])
        print(f"weights       {args.output}")
        print(f"log           {files.log}")
        if args.plot:
            print(f"plot          {files.plot}")


def _settings(args: argparse.Namespace) -> Any:
    from spslam.cli.parser import UsageError
    from spslam.prior.training import PretrainSettings

    given = {name: getattr(args, name) for name in ("steps", "seed", "neighborhood") if getattr(args, name) is not None}
    try:
        return PretrainSettings(**given)
    except ValueError as error:
        raise UsageError(str(error).removeprefix("PretrainSettings: ")) from None


def _make_progress(quiet: bool) -> Callable[[int, int, float], None] | None:
    """A progress bar on a terminal; elsewhere a line every few seconds."""
    if quiet:
        return None
    return _Bar() if sys.stderr.isatty() else _Lines()


class _Bar:
    def __init__(self) -> None:
        self._bar: Any = None

    def __call__(self, done: int, total: int, error_mm: float) -> None:
        if self._bar is None:
            from tqdm import tqdm

            self._bar = tqdm(total=total, initial=done - 1, unit=" steps", file=sys.stderr)
        self._bar.set_postfix_str(f"{error_mm:.2f} mm", refresh=False)
        self._bar.update(done - self._bar.n)
        if done == total:
            self._bar.close()


class _Lines:
    def __init__(self) -> None:
        self._last = time.monotonic()

    def __call__(self, done: int, total: int, error_mm: float) -> None:
        now = time.monotonic()
        if done == total or now - self._last >= SECONDS_BETWEEN_LINES:
            self._last = now
            print(f"{done}/{total} steps, mean error {error_mm:.2f} mm", file=sys.stderr, flush=True)


def _print_validation(figures: dict[str, dict[str, float]]) -> None:
    print(f"{'held out':<18}{'0-4 cm':>9}{'4-8 cm':>9}{'sign':>9}{'crossing':>10}   (mm at 4 cm voxels)")
    for kind, row in figures.items():
        print(
            f"{kind:<18}{row['near_mae_mm']:>9.2f}{row['far_mae_mm']:>9.2f}"
            f"{row['sign_accuracy']:>9.2%}{row['zero_crossing_mm']:>10.2f}"
        )
