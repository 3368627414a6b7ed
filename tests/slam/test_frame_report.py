"""Times of a frame's stages: they add up, and nobody is blamed for what ran beside."""

import json

import pytest
import torch

from spslam.slam.device_events import event_recorder
from spslam.slam.fit import Fit
from spslam.slam.frame_report import FrameEvents, FrameReport, PendingReport


class At:
    """An event at a given millisecond."""

    def __init__(self, ms: float, passed: bool = True):
        self.ms, self.passed, self.waited = ms, passed, False

    def is_complete(self):
        return self.passed

    def wait(self):
        self.waited = True

    def ms_since(self, earlier):
        return self.ms - earlier.ms


def mapped_frame(**changes) -> FrameEvents:
    events = {
        "requested": At(10),
        "started": At(13),
        "tracking": (At(13), At(15)),
        "encode": (At(16), At(17)),
        "mapping": (At(17), At(21)),
        "upload": (At(4), At(4.5)),
        "finished": At(22),
    }
    return FrameEvents(**{**events, **changes})


def test_stages_and_the_rest_add_up():
    times = mapped_frame().times_ms(host_wait_ms=2.5)
    assert times == pytest.approx(
        {"upload_ms": 0.5, "wait_ms": 2.5, "tracking_ms": 2, "encode_ms": 1, "mapping_ms": 4, "other_ms": 2.5}
    )


def test_waiting_counts_only_where_the_device_was_idle():
    assert mapped_frame().times_ms(host_wait_ms=50)["wait_ms"] == 3
    assert mapped_frame(started=At(10)).times_ms(host_wait_ms=50)["wait_ms"] == 0


def test_stages_that_did_not_take_place_have_no_length():
    times = mapped_frame(tracking=None, encode=None, mapping=None, upload=None).times_ms(0)
    assert [times[f"{name}_ms"] for name in ("upload", "tracking", "encode", "mapping")] == [0, 0, 0, 0]
    assert times["other_ms"] == 12


REPORT = FrameReport(
    frame=3,
    index=4,
    timestamp=0.1,
    lost=False,
    valid_depth_share=0.9,
    tracking_iterations=8,
    fit=Fit(residual_cm=0.2, mean_robust_weight=0.7),
    error_probability=0.01,
    recovered=False,
    relocalized=False,
    mapping_iterations=5,
    voxels=100,
    decode_ms=6.0,
)


def test_a_report_is_done_with_the_last_event_of_the_frame():
    events = mapped_frame(finished=At(22, passed=False))
    pending = PendingReport(REPORT, events, 0.0, torch.tensor(0.25), moving=torch.tensor([3, 60]))
    assert not pending.is_done()
    report = pending.result()
    assert events.finished.waited
    assert (report.frame, report.loss, report.moving_share, report.mapping_ms) == (3, 0.25, 0.05, 4)


def test_a_log_row_is_flat_and_without_nan():
    row = REPORT.log_row()
    assert (row["frame"], row["residual_cm"], row["mean_robust_weight"], row["loss"]) == (3, 0.2, 0.7, None)
    assert row["free_space_violation"] is None
    assert "fit" not in row
    assert json.loads(json.dumps(row, allow_nan=False)) == row


def test_events_of_a_device_are_in_order(device):
    record = event_recorder(device)
    first = record()
    torch.ones(1000, device=device).sum()
    second = record()
    second.wait()
    assert first.is_complete()
    assert second.is_complete()
    assert second.ms_since(first) >= 0
