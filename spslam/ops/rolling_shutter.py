"""Frames of a rolling shutter as a camera would have them that takes all rows at the middle row's moment.

The camera is taken to move evenly while it reads a frame out (Hedborg et al., "Rolling shutter bundle adjustment", CVPR
2012). A surface point x of row v, in camera axes, is at the middle row's moment x + s (w x x + c) to first order, with
s = readout (v / (H - 1) - 1/2), w the angular and c the linear velocity. A frame during which the camera would move by
more than 0.15 rad or m stays as it is. The ops wait for nothing, and their results are the same to the bit every time
on one device.
"""

from typing import NamedTuple

import torch

from spslam.ops import _library, trusted  # noqa: F401
from spslam.ops._checks import check, check_tensor
from spslam.ops._public import changed_in_place, public_op
from spslam.ops.scene_view import Intrinsics, check_intrinsics


class ShutterMotion(NamedTuple):
    """How the camera moves while it reads a frame out.

    Attributes:
        before: float32 [7] T_world_camera of the frame before.
        pose: float32 [7] of the frame's middle row.
        seconds: between the two, s.
        readout: float32 [1] from the first row to the last, s, negative where the last is read first (see
            `measure_capture_timing_`); 0 leaves frames as they are.
    """

    before: torch.Tensor
    pose: torch.Tensor
    seconds: float
    readout: torch.Tensor

    def check(self, function: str, like: torch.Tensor) -> None:
        """Raises TypeError or ValueError, naming `function`, where something does not fit."""
        check_tensor(function, "motion.before", self.before, (7,), torch.float32, like=like)
        check_tensor(function, "motion.pose", self.pose, (7,), torch.float32, like=like)
        check_tensor(function, "motion.readout", self.readout, (1,), torch.float32, like=like)
        check(self.seconds > 0, function, "motion.seconds", "be positive", self.seconds)


@public_op()
def rectify_shutter_records_(
    out: torch.Tensor, records: torch.Tensor, motion: ShutterMotion, intrinsics: Intrinsics, *, height: int, width: int
) -> None:
    """Writes pixel records as of the middle row's moment: their depth and, to the nearest pixel, their place.

    Colors stay, as do records that would be moved off the image.

    Args:
        out: int32 [P, 3], overwritten; may be `records`.
        records: int32 [P, 3] packed pixel records (see `sample_frame_pixels`).
        motion: of the camera.
        intrinsics: of the images that the records are of.
        height: of these images, px.
        width: likewise.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or a number out of range.

    Example:
        >>> poses = torch.tensor([[1.0, 0, 0, 0, 0, 0, 0], [1.0, 0, 0, 0, 0, 0, 0.1]])
        >>> motion = ShutterMotion(poses[0], poses[1], 0.1, torch.tensor([0.1]))  # forward, at 1 m/s
        >>> records = torch.tensor([[3 | 2 << 16, torch.tensor([2.0]).view(torch.int32).item(), 0]], dtype=torch.int32)
        >>> rectify_shutter_records_(records, records, motion, Intrinsics(8.0, 8.0, 3.5, 1.0), height=3, width=8)
        >>> records[:, 1].view(torch.float32)  # in the last row, read 0.05 s after the middle one
        tensor([2.0500])
    """
    name = "rectify_shutter_records_"
    check_tensor(name, "records", records, ("P", 3), torch.int32)
    check_tensor(name, "out", out, records.shape, torch.int32, like=records)
    motion.check(name, like=records)
    check_intrinsics(name, intrinsics)
    check(height > 1, name, "height", "be above 1", height)
    check(width > 1, name, "width", "be above 1", width)
    trusted.rectify_shutter_records_(out, records, motion, intrinsics, height, width)
    changed_in_place(out)


@public_op()
def rectify_shutter_images_(
    out_depth: torch.Tensor,
    out_intensity: torch.Tensor,
    depth: torch.Tensor,
    intensity: torch.Tensor,
    motion: ShutterMotion,
    intrinsics: Intrinsics,
    *,
    unit: float,
) -> None:
    """Writes a depth and an intensity image as of the middle row's moment.

    A pixel takes the depth of the nearest pixel that was read, and the intensity between four.

    Args:
        out_depth: uint16 [H, W], overwritten; other memory than `depth`.
        out_intensity: uint8 [H, W], overwritten; other memory than `intensity`.
        depth: uint16 [H, W] in `unit`, 0 where unknown; at least two rows and columns.
        intensity: uint8 [H, W].
        motion: of the camera.
        intrinsics: of the images.
        unit: of depth, m.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or a number out of range.

    Example:
        >>> depth = torch.full((3, 8), 2000, dtype=torch.uint16)
        >>> ramp = (30 * torch.arange(8)).to(torch.uint8).expand(3, 8).contiguous()
        >>> poses = torch.tensor([[1.0, 0, 0, 0, 0, 0, 0], [1.0, 0, 0, 0, 0.25, 0, 0]])
        >>> motion = ShutterMotion(poses[0], poses[1], 0.5, torch.tensor([0.25]))
        >>> moved = depth.clone(), ramp.clone()
        >>> rectify_shutter_images_(*moved, depth, ramp, motion, Intrinsics(16.0, 16.0, 3.5, 1.0), unit=1e-3)
        >>> moved[1][:, 3]  # the camera moves by a pixel from the first row to the last
        tensor([105,  90,  75], dtype=torch.uint8)
    """
    name = "rectify_shutter_images_"
    check_tensor(name, "depth", depth, ("H", "W"), torch.uint16)
    check(min(depth.shape) > 1, name, "depth", "have at least two rows and columns", tuple(depth.shape))
    check_tensor(name, "intensity", intensity, depth.shape, torch.uint8, like=depth)
    check_tensor(name, "out_depth", out_depth, depth.shape, torch.uint16, like=depth)
    check_tensor(name, "out_intensity", out_intensity, depth.shape, torch.uint8, like=depth)
    motion.check(name, like=depth)
    check_intrinsics(name, intrinsics)
    check(unit > 0, name, "unit", "be positive", unit)
    trusted.rectify_shutter_images_(out_depth, out_intensity, depth, intensity, motion, intrinsics, unit)
    changed_in_place(out_depth, out_intensity)


@torch.library.register_fake("spslam::rectify_shutter_records_")
def _(out, records, *_):
    return None


@torch.library.register_fake("spslam::rectify_shutter_images_")
def _(out_depth, out_intensity, *_):
    return None
