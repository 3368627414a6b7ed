"""How well the error probability separates wrong poses from right ones, and the coefficients that fit these data.

    python -m experiments.confidence_calibration --config 7scenes --data path/to/redkitchen --step 2 --save kitchen2.npz
    python -m experiments.confidence_calibration --saved kitchen2.npz room3.npz

Right poses are those that tracking finds in a run from the motion model's prediction, without recovery. Wrong poses are
found from starts that are 10-60 cm and 5-40 degrees off, or that are the poses of other frames, if the result is more
than 6 cm or 4 degrees from the run's own pose. The first command measures one sequence, the second evaluates saved
measurements.
"""

import argparse
import math
from dataclasses import replace

import numpy as np
import torch

from experiments.arguments import add_measurements, add_options, add_sequence, make_parser
from experiments.basin import matrix, moved
from spslam.config import load_config
from spslam.datasets import open_sequence
from spslam.geometry import rotation_angle
from spslam.slam.fit import Fit
from spslam.slam.pixels import FramePixels, sample_frame
from spslam.slam.poses import pose_tensor
from spslam.slam.recovery.pose_confidence import PoseConfidenceModel
from spslam.slam.recovery.verifier import Verifier
from spslam.slam.system import SlamSystem
from spslam.slam.tracker import TrackingProblem

EVERY, FIRST, STARTS = 3, 6, 5  # frames whose wrong starts are tried, from which frame on, and how many
WRONG_CM, WRONG_DEG = 6.0, 4.0
COLUMNS = (
    "mean_robust_weight",
    "min_eigenvalue",
    "prediction_error_cm",
    "prediction_error_deg",
    "free_space_violation",
    "brightness_correlation",
)
QUANTILES = (0.5, 0.9, 0.99, 0.999, 1.0)
RIDGE = 3e-3


def main() -> None:
    """Parses the arguments; measures a sequence, or evaluates saved measurements."""
    args = _parser().parse_args()
    tables = [measure(args)] if args.saved is None else [dict(np.load(path)) for path in args.saved]
    if args.save:
        np.savez(args.save, **tables[0])
    judge(*(np.concatenate([table[name] for table in tables]) for name in ("right", "wrong")))


def measure(args: argparse.Namespace) -> dict[str, np.ndarray]:
    """Fits of right and wrong poses of one sequence, one row per pose with `COLUMNS`."""
    config = load_config(args.config, args.preset, ["device=cpu", *args.set])
    dataset = open_sequence(config.dataset, args.data, slice(None, None, args.step))
    ground_truth, random = dataset.poses(), np.random.default_rng(0)
    system = SlamSystem(config, dataset.camera, ground_truth[0])
    tracker, verifier = system.tracker, Verifier(config, dataset.camera, PoseConfidenceModel.load())
    right, wrong = [], []
    for number, frame in enumerate(dataset):
        pixels, tried = sample_frame(frame, dataset.camera, config), []
        if number >= FIRST and number % EVERY == 0:
            poses = system.state.frames.poses
            starts = [poses[random.integers(number)].clone() for _ in range(STARTS - 2)]
            away = [(random.uniform(10, 60), random.uniform(5, 40)) for _ in range(2)]
            starts += [pose_tensor(moved(matrix(poses[-1]), offset, random), system.device) for offset in away]
            tried = [fit_from(system, verifier, pixels, start, number) for start in starts]
        if number > 1:
            right.append(row(fit_from(system, verifier, pixels, tracker.predict(system.state.frames), number)[0]))
        system.process(frame)
        wrong += [row(fit) for fit, pose in tried if is_apart(pose, matrix(system.state.frames.poses[-1]))]
    return {"right": np.array(right), "wrong": np.array(wrong)}


def fit_from(
    system: SlamSystem, verifier: Verifier, pixels: FramePixels, start: torch.Tensor, number: int
) -> tuple[Fit, np.ndarray]:
    """The fit of what tracking alone makes of a start, verified, and its pose."""
    estimate = system.tracker.track(TrackingProblem(system.state.scene, pixels.records, start, number))
    fit = verifier.verified(estimate.fit, estimate.pose, system.state.scene, pixels, system.history)
    return fit, matrix(estimate.pose)


def row(fit: Fit) -> list[float]:
    """The columns of a fit."""
    return [getattr(fit, name) for name in COLUMNS]


def is_apart(pose: np.ndarray, other: np.ndarray) -> bool:
    """Whether a pose is different from the run's."""
    angle = np.degrees(rotation_angle(pose[:3, :3].T @ other[:3, :3]))
    return bool(100 * np.linalg.norm(pose[:3, 3] - other[:3, 3]) > WRONG_CM or angle > WRONG_DEG)


def judge(right: np.ndarray, wrong: np.ndarray) -> None:
    """Prints error probabilities at first look, at second look and when lost, and the fitted coefficients."""
    model = PoseConfidenceModel.load()
    print(f"{len(right)} right poses, {len(wrong)} wrong ones")
    unseen = {"free_space_violation": math.nan, "brightness_correlation": math.nan}
    looks = {"first look": unseen, "second look": {}, "after loss": {"prediction_error_cm": math.nan}}
    for name, unknown in looks.items():
        error_probabilities = [
            np.array([model.error_probability(replace(as_fit(line), **unknown)) for line in table])
            for table in (right, wrong)
        ]
        quantiles = " ".join(f"{value:.3f}" for value in np.quantile(error_probabilities[0], QUANTILES))
        shares = ", ".join(
            f"{100 * (error_probabilities[1] <= least).mean():.2f} % below {least:g}" for least in (0.1, 0.5)
        )
        print(f"{name:14s} right, quantiles {QUANTILES}: {quantiles}; wrong: {shares}")
    names = ("constant", "mean_robust_weight", "lg(information)", "prediction_error", "free_space_violation")
    print("fitted:", ", ".join(f"{a:.2f} {name}" for a, name in zip(coefficients(right, wrong), names, strict=True)))


def as_fit(line: np.ndarray) -> Fit:
    """The fit of a row."""
    return Fit(**dict(zip(COLUMNS, line.tolist(), strict=True)))


def coefficients(right: np.ndarray, wrong: np.ndarray) -> np.ndarray:
    """Logistic regression by Newton's method; both classes have the same weight, slopes have a small ridge penalty."""
    table = np.concatenate([right, wrong])
    mean_robust_weight, min_eigenvalue, prediction_error_cm, prediction_error_deg, free_space_violation = table.T[:5]
    model = PoseConfidenceModel.load()
    scales = model.prediction_error_scale_cm, model.prediction_error_scale_deg
    prediction_error = np.log1p(prediction_error_cm / scales[0] + prediction_error_deg / scales[1])
    lg = np.log10(np.maximum(min_eigenvalue, model.eigenvalue_floor))
    features = np.stack(
        [mean_robust_weight, lg, prediction_error, np.minimum(free_space_violation, model.max_free_space_violation)], 1
    )
    target = np.repeat([0.0, 1.0], [len(right), len(wrong)])
    weight = np.repeat([0.5 / len(right), 0.5 / len(wrong)], [len(right), len(wrong)])
    mean, deviation = features.mean(0), features.std(0)
    design = np.column_stack([np.ones(len(table)), (features - mean) / deviation])
    ridge, solution = np.diag([0.0] + [RIDGE] * 4), np.zeros(5)
    for _ in range(200):
        odds = 1 / (1 + np.exp(-np.clip(design @ solution, -40, 40)))
        gradient = design.T @ (weight * (odds - target)) + ridge @ solution
        hessian = (design * (weight * odds * (1 - odds))[:, None]).T @ design + ridge + 1e-12 * np.eye(5)
        step = np.linalg.solve(hessian, gradient)
        solution -= step / max(1.0, np.abs(step).max())
    slopes = solution[1:] / deviation
    return np.concatenate([[solution[0] - slopes @ mean], slopes])


def _parser() -> argparse.ArgumentParser:
    parser = make_parser(__doc__)
    add_sequence(parser)
    parser.add_argument("--step", type=int, default=1, help="use every n-th frame")
    add_options(parser)
    add_measurements(parser)
    return parser


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
