"""The verdict: which frames are lost, the likely reasons, and what to try."""

import json

import numpy as np
import pytest

from spslam.config import load_config
from spslam.evaluation.run_output import RunOutput
from spslam.evaluation.verdict import UNKNOWN_ERROR, judge_run
from spslam.trajectory import Trajectory
from tests.evaluation.finished_folder import trajectory_poses, write_run

BARE = ("mesh", "previews", "config")


def judge(folder, changes=None, **run):
    write_run(folder, BARE, **run)
    if changes:
        metrics = json.loads((folder / "metrics.json").read_text()) | changes
        (folder / "metrics.json").write_text(json.dumps(metrics))
    return judge_run(RunOutput.read(folder), load_config("demo"))


def test_a_run_without_losses_is_good(tmp_path):
    verdict = judge(tmp_path, losses=())
    assert (verdict.level, verdict.headline, verdict.advice) == ("good", "All 30 frames are tracked.", [])
    assert verdict.details == [
        "The path deviates from the ground truth by 1.25 cm (ATE RMSE).",
        "The run made 12.5 frames/s; the camera recorded 30 per second.",
    ]


@pytest.mark.parametrize(
    ("measures", "reason", "advice"),
    [
        ({"valid_depth_share": 0.004}, "only 0.4 % of the image has depth from 0.1 to 10 m", "sensor's range"),
        ({"prediction_error_cm": 24.0, "prediction_error_deg": 17.0}, "24 cm and 17 degrees", "more slowly"),
        ({"occluded_share": 0.4, "prediction_error_cm": 24.0}, "hides 40 % of the known surface", "hands"),
        ({"inlier_share": 0.1}, "only 10 % of its pixels lie on mapped surface", "mapping.every"),
        ({"free_space_violation": 0.2}, "contradicts surface", "intrinsics"),
        ({"min_eigenvalue": 1e-4}, "bare wall", "corners"),
        ({"brightness_correlation": -0.1}, "brightness does not match", "of the same time"),
        ({}, "wrong with a probability of 0.99", "log.jsonl"),
    ],
)
def test_the_log_tells_the_reason(tmp_path, measures, reason, advice):
    verdict = judge(tmp_path, **measures)
    assert verdict.headline == "Tracking is lost once, and found again: 2 of 30 frames (6.7 %) are lost."
    assert verdict.level == "doubtful"
    assert verdict.details[0].startswith("Frames 12 to 13 are lost (0.4 s after the start) because ")
    assert reason in verdict.details[0]
    assert verdict.details[0].endswith("Frame 14 was tracked again.")
    assert len(verdict.advice) == 1
    assert advice in verdict.advice[0]


def test_losses_are_counted_and_the_longest_described(tmp_path):
    losses = tuple((start, start + 1 + start % 3) for start in range(10, 80, 10))
    verdict = judge(tmp_path, frames=100, losses=losses)
    assert verdict.headline == "Tracking is lost 7 times, and found again each time: 14 of 100 frames (14 %) are lost."
    assert len([text for text in verdict.details if " lost (" in text]) == 5
    assert "2 shorter losses are not listed; log.jsonl has every frame." in verdict.details


def test_a_loss_to_the_end_is_bad(tmp_path):
    verdict = judge(tmp_path, losses=((20, 30),), inlier_share=0.1)
    assert verdict.headline == "Tracking is lost from frame 20 to the end: 10 of 30 frames (33 %) are lost."
    assert verdict.level == "bad"
    assert verdict.details[0].endswith("lie on mapped surface.")


def test_doubts_about_the_data_make_a_run_doubtful(tmp_path):
    verdict = judge(tmp_path, {"warnings": ["depth is off", "fx looks wrong"]}, losses=())
    assert (verdict.level, len(verdict.advice)) == ("doubtful", 1)
    assert "The look at the data raised 2 doubts, listed below." in verdict.details


def test_a_gap_in_time_is_named(tmp_path):
    write_run(tmp_path, BARE, inlier_share=0.1)
    times = np.arange(30) / 30 + 2.0 * (np.arange(30) >= 12)
    lost = np.isin(np.arange(30), (12, 13))
    Trajectory(times, trajectory_poses(), lost).save_tum(tmp_path / "trajectory.txt")
    verdict = judge_run(RunOutput.read(tmp_path), load_config("demo"))
    assert "because there is no frame for 2 s before it and only 10 % of" in verdict.details[0]


def test_a_large_error_is_bad_though_no_frame_is_lost(tmp_path):
    verdict = judge(tmp_path, {"ate_rmse_cm": 40.0}, losses=())
    assert verdict.level == "bad"
    assert "wrong depth scale" in verdict.advice[0]


def test_doubtful_poses_and_skipped_frames_are_named(tmp_path):
    write_run(tmp_path, BARE, losses=())
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    lines[7]["error_probability"] = 0.3
    (tmp_path / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    metrics = json.loads((tmp_path / "metrics.json").read_text()) | {"skipped_frames": 3}
    (tmp_path / "metrics.json").write_text(json.dumps(metrics))
    verdict = judge_run(RunOutput.read(tmp_path), load_config("demo"))
    text = " ".join(verdict.details)
    assert "that of frame 7: it is wrong with a probability of 0.3." in text
    assert "3 frames could not be read, or their depth was frozen" in text
    assert verdict.level == "doubtful"


def test_a_run_without_log_options_and_ground_truth_has_a_verdict(tmp_path):
    write_run(tmp_path, (*BARE, "log", "ground_truth"))
    verdict = judge_run(RunOutput.read(tmp_path), None)
    assert verdict.details[0] == (
        "Frames 12 to 13 are lost (0.4 s after the start), and the log does not say why. Frame 14 was tracked again."
    )
    assert UNKNOWN_ERROR in verdict.details
