"""The report of a frame, which can be created before the device has finished the frame."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch

from spslam.geometry import pose7_to_matrix
from spslam.slam.device_events import DeviceEvent
from spslam.slam.fit import Fit
from spslam.slam.graph.edges import LoopDecision
from spslam.slam.pixels import FramePixels
from spslam.slam.prepared_frame import PreparedFrame
from spslam.slam.recovery.tracked_frame import TrackedFrame
from spslam.slam.state import SlamState


@dataclass(frozen=True, repr=False)
class FrameReport:
    """What happened to one frame; `log_row()` is its line of log.jsonl.

    The stages' times are the device's. On CUDA they are taken by events, from where the stage begins in the stream to
    where it ends, so they include the time in which the device was idle between launches.

    Attributes:
        frame: number of the frame in the run, from 0.
        index: its index in the dataset.
        timestamp: s.
        lost: whether its pose is not to be trusted.
        valid_depth_share: share of pixels with usable depth.
        tracking_iterations: of this frame; 0 for the first.
        fit: how well its pose fits; NaN where it was not tracked or a measure was not needed.
        error_probability: that its pose is wrong; NaN where it was not tracked.
        recovered: whether its pose was tracked from an initial pose that image features or projective ICP found.
        relocalized: whether they found it against a stored frame that looks alike.
        mapping_iterations: of the joint optimization after this frame.
        voxels: allocated vertices.
        decode_ms: reading, decoding and sampling the frame, on a thread and ahead of need.
        loss: total loss of the last mapping iteration; None where there was none.
        moving_share: share of the surface in view that moves; None where the frame was not looked at for that.
        upload_ms: copying it to the device, beside other work; 0 on the CPU.
        wait_ms: time in which the device was idle because the frame had not been read yet.
        tracking_ms: finding its pose.
        encode_ms: allocation, encoding and fusion; 0 where the frame was not mapped.
        mapping_ms: joint optimization; 0 where there was none.
        other_ms: the rest of the time from when the frame was requested until it was done.
        loops: what was decided before the frame on loops that the keyframe graph tried.
        pose: float64 [4, 4] T_world_camera as it was tracked; None where the frame is lost. `SlamSystem.trajectory()`
            has the poses as mapping may have refined them since.
    """

    frame: int
    index: int
    timestamp: float
    lost: bool
    valid_depth_share: float
    tracking_iterations: int
    fit: Fit
    error_probability: float
    recovered: bool
    relocalized: bool
    mapping_iterations: int
    voxels: int
    decode_ms: float
    loss: float | None = None
    moving_share: float | None = None
    upload_ms: float = 0.0
    wait_ms: float = 0.0
    tracking_ms: float = 0.0
    encode_ms: float = 0.0
    mapping_ms: float = 0.0
    other_ms: float = 0.0
    loops: tuple[LoopDecision, ...] = ()
    pose: np.ndarray | None = field(default=None, compare=False)

    def log_row(self) -> dict[str, Any]:
        """All fields but the pose in one flat JSON object, those of `fit` among them; None for NaN, unknown to JSON."""
        flat = {**vars(self), "loops": [asdict(loop) for loop in self.loops], **vars(self.fit)}
        return {
            name: None if isinstance(x, float) and math.isnan(x) else x
            for name, x in flat.items()
            if name not in ("fit", "pose")
        }

    def __repr__(self) -> str:
        parts = [f"frame {self.frame}", "lost" if self.lost else "tracked"]
        if self.pose is not None:
            parts.append("at ({:.3f}, {:.3f}, {:.3f}) m".format(*self.pose[:3, 3]))
        if not math.isnan(self.fit.residual_cm):
            parts.append(f"residual {self.fit.residual_cm:.2f} cm")
        if self.mapping_iterations:
            parts.append("mapped")
        return f"FrameReport({', '.join(parts)})"


@dataclass
class FrameEvents:
    """Where a frame's stages begin and end in the device's queue; a stage that did not take place has no events.

    Attributes:
        requested: the frame was requested and the one before is done.
        started: the frame is there.
        finished: the device is done with the frame.
        upload, tracking, encode, mapping: begin and end of the stages; `upload` is on a stream of its own.
    """

    requested: DeviceEvent
    started: DeviceEvent
    finished: DeviceEvent
    upload: tuple[DeviceEvent, DeviceEvent] | None = None
    tracking: tuple[DeviceEvent, DeviceEvent] | None = None
    encode: tuple[DeviceEvent, DeviceEvent] | None = None
    mapping: tuple[DeviceEvent, DeviceEvent] | None = None

    def times_ms(self, host_wait_ms: float) -> dict[str, float]:
        """The times of `FrameReport`, once all events are complete.

        Args:
            host_wait_ms: how long the host waited for the frame; only what the device idled through counts.
        """
        wait_ms = min(host_wait_ms, self.started.ms_since(self.requested))
        stages = {f"{name}_ms": _length_ms(getattr(self, name)) for name in ("tracking", "encode", "mapping")}
        total_ms = self.finished.ms_since(self.requested)
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
        report: without times and loss.
        events: of the stages.
        host_wait_ms: how long the host waited for the frame to be read.
        loss: float32 [] in page-locked memory, on its way there; None where there is none.
        pose: seven numbers of T_world_camera, or float32 [7] on its way as the loss; None where the frame is lost.
        moving: int32 [2] on its way as the loss, cells that move and all with depth; None where nobody looked.
    """

    report: FrameReport
    events: FrameEvents
    host_wait_ms: float
    loss: torch.Tensor | None
    pose: Sequence[float] | torch.Tensor | None = None
    moving: torch.Tensor | None = None

    def is_done(self) -> bool:
        """Whether `result()` would return at once."""
        return self.events.finished.is_complete()

    def result(self) -> FrameReport:
        """The whole report; waits until the device is done with the frame."""
        self.events.finished.wait()
        loss = None if self.loss is None else float(self.loss)
        numbers = self.pose.tolist() if isinstance(self.pose, torch.Tensor) else self.pose
        pose = None if numbers is None else pose7_to_matrix(np.array(numbers))
        moving = None if self.moving is None else self.moving.tolist()
        share = None if moving is None else moving[0] / max(moving[1], 1)
        times: dict[str, Any] = {**self.events.times_ms(self.host_wait_ms), "moving_share": share}
        return FrameReport(**{**vars(self.report), "loss": loss, "pose": pose, **times})


def _length_ms(stage: tuple[DeviceEvent, DeviceEvent] | None) -> float:
    return stage[1].ms_since(stage[0]) if stage else 0.0


def frame_report(
    state: SlamState,
    frame: PreparedFrame,
    pixels: FramePixels,
    tracked: TrackedFrame,
    mapping_iterations: int,
    loops: tuple[LoopDecision, ...],
) -> FrameReport:
    """The report of the newest frame of a state, without the times of the device.

    Args:
        state: after the frame.
        frame: as it came.
        pixels: of the frame.
        tracked: what tracking made of it.
        mapping_iterations: made after it.
        loops: that were decided on before it.
    """
    return FrameReport(
        frame=state.frames.processed - 1,
        index=frame.index,
        timestamp=frame.timestamp,
        lost=state.frames.is_lost(-1),
        valid_depth_share=pixels.valid_depth_share,
        tracking_iterations=tracked.iterations,
        fit=tracked.fit,
        error_probability=tracked.error_probability,
        recovered=tracked.recovered,
        relocalized=tracked.relocalized,
        mapping_iterations=mapping_iterations,
        voxels=state.scene.volume.num_voxels,
        decode_ms=frame.decode_ms,
        loops=loops,
    )
