"""What happens while one records, and nothing says so: hands, a robot's own arm, shaking, flicker, text over the image.

    python -m experiments.capture_faults --seeds 451 452 --frames 160 --jobs 2
    python -m experiments.capture_faults --faults "robot's arm" --seeds 451 452 --set dataset.mask=none

Each fault in a generated recording of each place and seed, whose motion and sensor go round with the row; the columns
are those of `experiments.places_sweep`. Refused is a recording that the look at its first frames would not let run.
"""

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import torch

from experiments.arguments import add_options, make_parser
from experiments.places_sweep import CONFIDENT, WRONG_CM, WRONG_DEG, local_errors
from experiments.wrong_recordings import Fault, Reader, WrongRecording
from spslam.config import load_config
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.datasets.mask import apply_mask
from spslam.datasets.places import MOTIONS, PLACES, SENSORS, PlacesDataset
from spslam.datasets.plausibility import check_first_frames
from spslam.evaluation.trajectory_metrics import absolute_errors, align
from spslam.slam.system import SlamSystem

COLUMNS = ("fault", "place", "sensor", "motion", "seed", "ATE cm", "lost", "wrong", "confidently wrong", "left out %")
HAND_FRAMES = 15
_FLICKER, _FLICKER_HZ, _BANDS = 0.2, 99.3, 2.0
_SHAKE_M, _SHAKE_RAD, _SHAKE_HZ = 0.003, np.radians(0.35), (8, 22)


def carried(read: Reader, i: int, count: int, rows: float = 0.62, across: float = 0.4) -> RgbdFrame:
    """Something with a texture of its own, 35 to 45 cm before the camera, moves along with it.

    Args:
        read: the true frames.
        i: of the frame.
        count: of frames.
        rows: share of the image above it.
        across: share of the image's width that it takes, in the middle.
    """
    frame, random = read(i), np.random.default_rng(i)
    shown, height = carried_pixels(frame.depth.shape, rows, across), frame.depth.shape[0]
    depth_m = 0.45 - 0.1 * np.arange(height)[:, None] / height + random.normal(0, 0.002, frame.depth.shape)
    look = np.random.default_rng(5).integers(20, 230, (12, 16, 3)).astype(np.uint8)
    color = np.where(shown[..., None], cv2.resize(look, frame.depth.shape[::-1]), frame.color)
    return replace(frame, color=color, depth=np.where(shown, depth_m, frame.depth).astype(np.float32))


def carried_pixels(shape: tuple[int, ...], rows: float = 0.62, across: float = 0.4) -> np.ndarray:
    """Bool [H, W], where `carried` shows it in images of a shape."""
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]]
    return (v > rows * shape[0]) & (abs(u / shape[1] - 0.5) < across / 2)


def hand_at_the_start(read: Reader, i: int, count: int) -> RgbdFrame:
    """A hand hides three quarters of the first frames, 30 cm before the camera."""
    frame = read(i)
    if i >= HAND_FRAMES:
        return frame
    column = np.arange(frame.depth.shape[1])
    hidden = np.broadcast_to(column < 0.75 * len(column), frame.depth.shape)
    depth = np.where(hidden, 0.3 + 0.05 * np.sin(column / 40 + i / 3), frame.depth).astype(np.float32)
    return replace(frame, color=np.where(hidden[..., None], np.uint8(90), frame.color), depth=depth)


def flickering(read: Reader, i: int, count: int) -> RgbdFrame:
    """Light that goes with the mains, twice while an image's rows are read, and elsewhere in each image."""
    frame = read(i)
    rows = np.arange(frame.color.shape[0])[:, None, None] / frame.color.shape[0]
    gain = 1 + _FLICKER * np.sin(2 * np.pi * (_FLICKER_HZ * frame.timestamp + _BANDS * rows))
    return replace(frame, color=np.clip(frame.color * gain, 0, 255).astype(np.uint8))


def with_text(read: Reader, i: int, count: int) -> RgbdFrame:
    """Text and a logo are drawn over the color image."""
    frame = read(i)
    color, (height, width) = frame.color.copy(), frame.depth.shape
    cv2.putText(color, "REC 12:34:56 CAM-01", (8, 22), 0, 0.6, (255, 255, 255), 2)
    cv2.putText(color, "LOGO", (width - 110, height - 20), 0, 1.2, (255, 40, 40), 4)
    return replace(frame, color=color)


def shake(data: PlacesDataset, seed: int) -> None:
    """Shakes the camera of a generated place, by three sines each along and about its axes."""
    random, way = np.random.default_rng(seed), data.motion.poses
    phases, rates_hz = random.uniform(0, 2 * np.pi, (3, 6)), random.uniform(*_SHAKE_HZ, (3, 6))
    weights = np.array([1, 0.7, 0.5])[:, None]

    def poses(times: np.ndarray) -> np.ndarray:
        shaken = way(times)
        for pose, time in zip(shaken, np.asarray(times, np.float64), strict=True):
            off = (weights * np.sin(2 * np.pi * rates_hz * time + phases)).sum(axis=0)
            pose[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(_SHAKE_RAD * off[:3])[0]
            pose[:3, 3] += _SHAKE_M * pose[:3, :3] @ off[3:]
        return shaken

    data.motion.poses = poses  # type: ignore[method-assign]


FAULTS: dict[str, Fault] = {
    "none": Fault(),
    "hand at the start": Fault(frame=hand_at_the_start),
    "robot's arm": Fault(frame=carried),
    "robot's body": Fault(frame=partial(carried, rows=0.75, across=2.0)),
    "shaking": Fault(),
    "flicker": Fault(frame=flickering),
    "text": Fault(frame=with_text),
}


def main() -> None:
    """Parses the arguments; runs the cases; prints a row per case."""
    args = _parser().parse_args()
    cases = []
    for fault in args.faults:
        for row, (place, seed) in enumerate(product(args.places, args.seeds)):
            cases.append((fault, place, tuple(SENSORS)[1 + row % 4], MOTIONS[row % 4], seed))
    print(f"| {' | '.join(COLUMNS)} |\n" + "|---" * len(COLUMNS) + "|")
    rows = []
    with ProcessPoolExecutor(args.jobs) as pool:
        for row in pool.map(partial(measure, args), cases):
            rows.append(row)
            print(f"| {' | '.join(map(str, row))} |", flush=True)
            if args.save:
                args.save.write_text(json.dumps(rows))


def measure(args: argparse.Namespace, case: tuple[str, str, str, str, int]) -> list:
    """The row of a case."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    fault, place, sensor, motion, seed = case
    data = PlacesDataset(place, motion, sensor, args.frames, seed)
    if fault == "shaking":
        shake(data, seed)
    recording = WrongRecording(data, FAULTS[fault], with_poses=False)
    config = load_config("places", args.preset, ["device=cpu", f"seed={seed}", *args.set])
    recording.is_seekable = True  # as files are
    apply_mask(recording, config.dataset.mask)
    if config.run.data_check != "skip" and any(finding.certain for finding in check_first_frames(recording)):
        return [*case, "refused"]
    poses, probability = _run(config, recording)
    truth, known = recording.true_poses(), np.isfinite(poses[:, 0, 0])
    off_m = absolute_errors(poses[known], truth[known], align(poses[known], truth[known]))
    error_cm, error_deg = local_errors(poses, truth)
    wrong = (error_cm > WRONG_CM) | (error_deg > WRONG_DEG)
    ate = f"{100 * np.sqrt(np.mean(off_m**2)):.2f}"
    share = 0.0 if recording.left_out is None else recording.left_out.mean()
    confident = int((wrong & (probability < CONFIDENT)).sum())
    return [*case, ate, int((~known).sum()), int(wrong.sum()), confident, round(100 * float(share))]


def _run(config, recording: RgbdDataset) -> tuple[np.ndarray, np.ndarray]:
    """Poses [F, 4, 4], NaN where lost, and the error probabilities [F] that were stated, NaN where none was."""
    system, stated = SlamSystem(config, recording.camera), []
    for frame in recording:
        probability = system.process(frame).error_probability
        stated.append(np.nan if probability is None else probability)
    system.finish()
    found = system.trajectory()
    return np.where(np.asarray(found.lost)[:, None, None], np.nan, found.poses), np.array(stated)


def _parser() -> argparse.ArgumentParser:
    parser = make_parser(__doc__)
    parser.add_argument("--faults", nargs="+", choices=tuple(FAULTS), default=tuple(FAULTS))
    parser.add_argument("--places", nargs="+", choices=tuple(PLACES), default=tuple(PLACES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--frames", type=int, default=160)
    parser.add_argument("--jobs", type=int, default=2, help="cases at a time")
    parser.add_argument("--save", type=Path, help="file for the rows, JSON")
    add_options(parser)
    return parser


if __name__ == "__main__":
    main()
