"""What is told of each frame, also while the device is still at work on it."""

from dataclasses import dataclass
from typing import Any

import torch

from spslam.slam.device_events import DeviceEvent


@dataclass(frozen=True)
class FrameReport:
    """What happened to one frame; a line of log.jsonl.

    The stages' times are the device's. On CUDA they are taken by events, from where the stage begins in the stream to
    where it ends, so they hold what the device did and what it idled in between for want of launches.

    Attributes:
        frame: number of the frame in the run, from 0.
        index: its index in the data set.
        timestamp: s.
        lost: whether its pose is not to be trusted.
        valid_depth_share: share of pixels with usable depth.
        tracking_iterations: of this frame; 0 for the first.
        residual_cm: weighted RMS distance of its pixels to the map; None where it was not tracked.
        inlier_share: share of its pixels on mapped surface; None where it was not tracked.
        mean_robust_weight: mean robust weight of its pixels on the map, from 0 to 1; None where it was not tracked.
        min_eigenvalue: smallest eigenvalue of its normal equations a pixel; None where it was not tracked.
        prediction_error_cm, prediction_error_deg: from the motion model's pose to the one found; None where that was not asked.
        free_space_violation: share of the surface other frames know that it looks through; None where that was not asked.
        occluded_share: share of that surface that something nearer hides; None where that was not asked.
        map_coverage: share of the last trusted frame's pixels on mapped surface; None where that was not asked.
        brightness_correlation: correlation of its brightness with the map's colors; None where that was not asked, or is not known.
        error_probability: probability from these that its pose is wrong; None where it was not tracked.
        recovered: whether its pose comes from a start that projective ICP found.
        relocalized: whether that start was a stored frame that looks alike.
        mapping_iterations: of the joint optimization after this frame.
        loss: total loss of the last mapping iteration; None where there was none.
        voxels: allocated vertices.
        decode_ms: reading, decoding and sampling the frame, on a thread and ahead of need.
        upload_ms: copying it to the device, beside other work; 0 on the CPU.
        wait_ms: the device had nothing to do, for the frame was not there yet.
        tracking_ms: predicting and finding its pose.
        encode_ms: allocation, encoding and fusion; 0 where the frame was not mapped.
        mapping_ms: joint optimization; 0 where there was none.
        other_ms: the rest of the time from when the frame was asked for until it was done.
    """

    frame: int
    index: int
    timestamp: float
    lost: bool
    valid_depth_share: float
    tracking_iterations: int
    residual_cm: float | None
    inlier_share: float | None
    mean_robust_weight: float | None
    min_eigenvalue: float | None
    prediction_error_cm: float | None
    prediction_error_deg: float | None
    free_space_violation: float | None
    occluded_share: float | None
    map_coverage: float | None
    brightness_correlation: float | None
    error_probability: float | None
    recovered: bool
    relocalized: bool
    mapping_iterations: int
    loss: float | None
    voxels: int
    decode_ms: float
    upload_ms: float
    wait_ms: float
    tracking_ms: float
    encode_ms: float
    mapping_ms: float
    other_ms: float


@dataclass
class FrameEvents:
    """Where a frame's stages begin and end on the device's time line; a stage that did not take place has no marks.

    Attributes:
        asked: the frame was asked for and the one before is done.
        began: the frame is there.
        done: the frame has had everything.
        upload, tracking, encode, mapping: begin and end of the stages; `upload` is on a stream of its own.
    """

    asked: DeviceEvent
    began: DeviceEvent
    done: DeviceEvent
    upload: tuple[DeviceEvent, DeviceEvent] | None = None
    tracking: tuple[DeviceEvent, DeviceEvent] | None = None
    encode: tuple[DeviceEvent, DeviceEvent] | None = None
    mapping: tuple[DeviceEvent, DeviceEvent] | None = None

    def times_ms(self, host_wait_ms: float) -> dict[str, float]:
        """The times of `FrameReport`, all marks having passed.

        Args:
            host_wait_ms: how long the host waited for the frame; only what the device idled through counts.
        """
        wait_ms = min(host_wait_ms, self.began.ms_since(self.asked))
        stages = {f"{name}_ms": _length_ms(getattr(self, name)) for name in ("tracking", "encode", "mapping")}
        total_ms = self.done.ms_since(self.asked)
        return {
            "upload_ms": _length_ms(self.upload),
            "wait_ms": wait_ms,
            **stages,
            "other_ms": max(total_ms - wait_ms - sum(stages.values()), 0.0),
        }


@dataclass(frozen=True)
class PendingReport:
    """A report whose times and loss are known when the device is done with the frame.

    Attributes:
        known: the other fields of `FrameReport`.
        marks: of the stages.
        host_wait_ms: how long the host waited for the frame to be read.
        loss: float32 [] in page-locked memory, on its way there; None where there is none.
    """

    known: dict[str, Any]
    marks: FrameEvents
    host_wait_ms: float
    loss: torch.Tensor | None

    def is_done(self) -> bool:
        """Whether `result()` would return at once."""
        return self.marks.done.is_complete()

    def result(self) -> FrameReport:
        """The whole report; waits until the device is done with the frame."""
        self.marks.done.wait()
        loss = None if self.loss is None else float(self.loss)
        fields = {**self.known, "loss": loss, **self.marks.times_ms(self.host_wait_ms)}
        return FrameReport(**fields)


def _length_ms(stage: tuple[DeviceEvent, DeviceEvent] | None) -> float:
    return stage[1].ms_since(stage[0]) if stage else 0.0
