"""The ops that each frame of a run calls, without the checks of their arguments, which take as long as the calls.

They are for callers whose arguments come from objects that are right by construction, as `spslam.slam` has them; the
public op of the same name, where there is one, says what arguments must be, and calls these once it has checked them.
The bindings still refuse dtypes and shapes that would have a kernel read or write where nothing is, but tell no device
from another. Nothing is cast in an autocast
region, and autograd is not told of what is changed in place.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch

from spslam.ops import _library  # noqa: F401

if TYPE_CHECKING:
    from spslam.ops.capture_timing import CaptureTiming
    from spslam.ops.earlier_frames import DepthKeyframes, ReferenceImage
    from spslam.ops.gauss_newton import GaussNewtonOptions
    from spslam.ops.launch_graph import LaunchGraph
    from spslam.ops.optimize_map import MapMoments
    from spslam.ops.render_step import RenderOptions
    from spslam.ops.rolling_shutter import ShutterMotion
    from spslam.ops.scene_view import Intrinsics, SceneView
    from spslam.ops.sensor_noise import SensorNoise
# Of the tensors that tracking returns: numbers of a pose and H, of the statistics of an iteration (kFrameStatSize of
# csrc/include/spslam/gauss_newton.h), and of what stands before both in `track_frame`.
FOUND_NUMBERS, STATISTICS, FOLLOWED_HEAD = 43, 7, 9
_POSE = 7
DESCRIPTOR_GROUPS = 16  # kMaxDescriptorGroups of csrc/include/spslam/descriptors.h


class MovingFrame(NamedTuple):
    """What `track_frame` takes of a frame.

    Attributes:
        records: int32 [P, 3], P >= 1.
        depth, intensity: uint16 in `unit` m and uint8 [h, w].
        poses: float32 [2, 7] of the two frames before, the last one second.
        readout: float32 [1] s.
        seconds: from the last frame to this one.
        steps: the same time, in times from the first of the two frames to the last one.
        size: rows and columns of the images that the records are of.
        image_intrinsics: of `depth` and `intensity`.
        unit: m.
    """

    records: torch.Tensor
    depth: torch.Tensor
    intensity: torch.Tensor
    poses: torch.Tensor
    readout: torch.Tensor
    seconds: float
    steps: float
    size: tuple[int, int]
    image_intrinsics: Intrinsics
    unit: float


class FollowedParts(NamedTuple):
    """Views of the numbers that `track_frame` returns, float32.

    Attributes:
        predicted, first_pose, pose: [7], predicted, by the first pass and by the last.
        readout: [1] s.
        gain: [2] of the frame at the last pose.
        last_size: how many of the numbers, at the end, are of the last pass.
    """

    predicted: torch.Tensor
    readout: torch.Tensor
    first_pose: torch.Tensor
    pose: torch.Tensor
    gain: torch.Tensor
    last_size: int


def followed_parts(found: torch.Tensor, again_iterations: int) -> FollowedParts:
    """The parts of what `track_frame` returns, by one call: each slice for itself takes as long as all."""
    last = FOUND_NUMBERS + STATISTICS * again_iterations
    between = len(found) - FOLLOWED_HEAD - _POSE - last
    sizes = [1, _POSE, 1, _POSE, between, _POSE, last - _POSE - 2, 2]
    _, predicted, readout, first_pose, _, pose, _, gain = found.split_with_sizes(sizes)
    return FollowedParts(predicted, readout, first_pose, pose, gain, last)


_NO_REFERENCE: tuple[list, list] = ([], [])
_NO_KEYFRAMES: tuple[list, list, list] = ([], [], [])


def predict_pose(before: torch.Tensor, last: torch.Tensor, steps: float) -> torch.Tensor:
    """See `spslam.ops.predict_pose`."""
    return torch.ops.spslam.predict_pose(before, last, steps)


def predict_frame(
    poses: torch.Tensor,
    last: int,
    readout: torch.Tensor,
    seconds: float,
    steps: float,
    records: torch.Tensor,
    intrinsics: Intrinsics,
    size: tuple[int, int],
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """What `predict_pose` and `rectify_shutter_records_` find of the next frame, in one call.

    Args:
        poses: float32 [F, 7], the last of them in row `last`, at least 1.
        last: that row.
        readout: float32 [1] s.
        seconds: from the last frame to the next one.
        steps: as of `predict_pose`.
        records: int32 [P, 3] of the next frame, not changed.
        intrinsics: of the images that the records are of.
        size: rows and columns of these.

    Returns:
        float32 [7] the pose; float32 [1] the readout, a copy; int32 [P, 3] the records, rectified by the motion from
        the last pose to this one.
    """
    return torch.ops.spslam.predict_frame(poses, last, readout, records, [*intrinsics, seconds], *size, steps)


def track_gauss_newton(
    scene: SceneView,
    pixels: torch.Tensor,
    pose: torch.Tensor,
    intrinsics: Intrinsics,
    options: GaussNewtonOptions,
    noise: torch.Tensor | None,
    reference: ReferenceImage | None,
    depth_keyframes: DepthKeyframes | None,
) -> torch.Tensor:
    """See `spslam.ops.track_gauss_newton`.

    Returns:
        float32 [50 + 7 iterations], so that the host reads all in one go: the pose that tracking started from, the pose
        that it found, H and the statistics of each iteration.
    """
    return torch.ops.spslam.track_gauss_newton(
        *scene.arguments(),
        [pixels, pose] if noise is None else [pixels, pose, noise],
        *options.arguments(intrinsics),
        *(_NO_REFERENCE if reference is None else reference.arguments()),
        *(_NO_KEYFRAMES if depth_keyframes is None else depth_keyframes.arguments()),
    )


def track_frame(
    scene: SceneView,
    frame: MovingFrame,
    limits: tuple[float, float, float],
    again_iterations: int,
    intrinsics: Intrinsics,
    options: GaussNewtonOptions,
    noise: torch.Tensor | None,
    reference: ReferenceImage | None,
    depth_keyframes: DepthKeyframes | None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """A frame of a moving camera in one call: `predict_frame`, `track_gauss_newton` from that pose, and
    `rectify_shutter_frame` by the pose found.

    Where that pose has turned from the predicted one by more than `limits` allow, predicted motion has bent the frame:
    its records are rectified by the pose found, and it is tracked again from there. A frame that is found far from the
    prediction is not, as it may have to be looked for elsewhere first.

    Args:
        scene, intrinsics, options, noise, reference, depth_keyframes: as of `track_gauss_newton`, for the first pass.
        frame: as it was read.
        limits: by how much the pose may differ from the prediction: rad during the time of the readout, more of which
            bends the frame; m and rad, more of which is far.
        again_iterations: A of the second pass, which begins near: with the last kernel, and keyframes from the start.

    Returns:
        float32 [95 + 7 (iterations + A)], so that the host reads all in one go: the outcome (0 settled, 1 bent and
        tracked again, 2 far), the predicted pose, the readout that counted (s), and twice the pose, H and the
        statistics of each iteration: what was found at first, and in the end (the last statistics A times, where
        nothing was tracked again); int32 [P, 3] the records as the predicted motion
        rectifies them; int32 [P, 3], uint16 [h, w] and uint8 [h, w] records and images as that of the pose found does.
    """
    tensors = frame.records, frame.depth, frame.intensity, frame.poses, frame.readout
    return torch.ops.spslam.track_frame(
        *scene.arguments(),
        [*tensors] if noise is None else [*tensors, noise],
        *options.arguments(intrinsics),
        *(_NO_REFERENCE if reference is None else reference.arguments()),
        *(_NO_KEYFRAMES if depth_keyframes is None else depth_keyframes.arguments()),
        # The enum MotionScalar in csrc/bindings/track_frame.cpp.
        [*frame.image_intrinsics, *frame.size, frame.seconds, frame.steps, frame.unit, *limits, again_iterations],
    )


def rectify_shutter_records_(
    out: torch.Tensor, records: torch.Tensor, motion: ShutterMotion, intrinsics: Intrinsics, height: int, width: int
) -> None:
    """See `spslam.ops.rectify_shutter_records_`."""
    torch.ops.spslam.rectify_shutter_records_(
        out, records, motion.before, motion.pose, motion.readout, [*intrinsics, motion.seconds], height, width
    )


def rectify_shutter_images_(
    out_depth: torch.Tensor,
    out_intensity: torch.Tensor,
    depth: torch.Tensor,
    intensity: torch.Tensor,
    motion: ShutterMotion,
    intrinsics: Intrinsics,
    unit: float,
) -> None:
    """See `spslam.ops.rectify_shutter_images_`."""
    torch.ops.spslam.rectify_shutter_images_(
        out_depth, out_intensity, depth, intensity, motion.before, motion.pose, motion.readout,
        [*intrinsics, motion.seconds, unit],
    )  # fmt: skip


def rectify_shutter_frame(
    records: torch.Tensor,
    depth: torch.Tensor,
    intensity: torch.Tensor,
    motion: ShutterMotion,
    intrinsics: Intrinsics,
    size: tuple[int, int],
    image_intrinsics: Intrinsics,
    unit: float,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Records and images of a frame as `rectify_shutter_records_` and `rectify_shutter_images_` write them, new ones.

    Args:
        records, depth, intensity, motion, unit: as there.
        intrinsics: of the images that the records are of.
        size: rows and columns of these.
        image_intrinsics: of `depth` and `intensity`.
    """
    return torch.ops.spslam.rectify_shutter_frame(
        records, depth, intensity, motion.before, motion.pose, motion.readout,
        [*intrinsics, *image_intrinsics, motion.seconds, unit], *size,
    )  # fmt: skip


def measure_frame_(
    noise: SensorNoise,
    timing: CaptureTiming,
    pixels: torch.Tensor,
    pose: torch.Tensor,
    intrinsics: Intrinsics,
    depth_keyframes: DepthKeyframes,
    pixel_counts: tuple[int, int],
) -> None:
    """`measure_capture_timing_` where the keyframes have a timing, and then `measure_noise_`.

    Args:
        noise, timing, pose, intrinsics, depth_keyframes: as there.
        pixels: int32 [P, 3] all of the frame.
        pixel_counts: of how many of these at most times and noise are measured.
    """
    torch.ops.spslam.measure_frame_(
        noise.counts, noise.model, timing.state, timing.seconds, pixels, pose, list(intrinsics), list(pixel_counts),
        *depth_keyframes.arguments(),
    )  # fmt: skip


def measure_capture_timing_(
    timing: CaptureTiming,
    pixels: torch.Tensor,
    pose: torch.Tensor,
    intrinsics: Intrinsics,
    noise: torch.Tensor,
    depth_keyframes: DepthKeyframes,
) -> None:
    """See `spslam.ops.measure_capture_timing_`."""
    torch.ops.spslam.measure_capture_timing_(
        timing.state, timing.seconds, pixels, pose, noise, list(intrinsics), *depth_keyframes.arguments()
    )


def measure_noise_(
    noise: SensorNoise,
    pixels: torch.Tensor,
    pose: torch.Tensor,
    intrinsics: Intrinsics,
    depth_keyframes: DepthKeyframes,
) -> None:
    """See `spslam.ops.measure_noise_`."""
    torch.ops.spslam.measure_noise_(
        noise.counts, noise.model, pixels, pose, list(intrinsics), *depth_keyframes.arguments()
    )


def copy_rows_(tables: Sequence[torch.Tensor], rows: Sequence[int], values: Sequence[torch.Tensor]) -> None:
    """See `spslam.ops.copy_rows_`; there must be a table."""
    torch.ops.spslam.copy_rows_(tables, rows, values)


def unproject_pixels(
    records: torch.Tensor, normals: torch.Tensor, pose: torch.Tensor, intrinsics: Intrinsics
) -> tuple[torch.Tensor, torch.Tensor]:
    """See `spslam.ops.unproject_pixels`."""
    return torch.ops.spslam.unproject_pixels(records, normals, pose, *intrinsics)


def nearest_in_groups(descriptors: torch.Tensor, others: torch.Tensor, sizes: Sequence[int]) -> torch.Tensor:
    """`nearest_descriptors` in each of several groups, in one call.

    Args:
        descriptors: uint8 [N, B], as there.
        others: uint8 [M, B] of all groups, one after the other, on the same device.
        sizes: how many each of the G groups has, M in all; G is at most `DESCRIPTOR_GROUPS`.

    Returns:
        int64 [2, G, N], so that the host reads all in one go: the rows in the groups, and the two distances, of 32 bits
        each, the one to the nearest in the lower half.
    """
    return torch.ops.spslam.nearest_in_groups(descriptors, others, sizes)


def optimize_map_(
    scene: SceneView,
    records: torch.Tensor,
    poses: torch.Tensor,
    frames: torch.Tensor,
    intrinsics: Intrinsics,
    options: RenderOptions,
    moments: MapMoments,
    integers: Sequence[int],
    graph: LaunchGraph | None,
) -> torch.Tensor:
    """See `spslam.ops.optimize_map_`.

    Args:
        scene, records, poses, frames, intrinsics, options, moments, graph: as there.
        integers: `pixel_stream`, `num_pixels`, `iterations`, `fixed_frame`, `first_step`, `first_color_step` and
            `first_stamp`.
    """
    losses = poses.new_empty(integers[2], 5)
    with torch.no_grad():
        torch.ops.spslam.optimize_map_(
            *scene.arguments(),
            records,
            poses,
            frames,
            *options.arguments(intrinsics),
            *moments.arguments(),
            # The enum Integer in csrc/bindings/optimize_map.cpp.
            [*integers, 0 if graph is None else graph.number(poses.device)],
            losses,
        )
    return losses


@torch.library.register_fake("spslam::rectify_shutter_frame")
def _(records, depth, intensity, *_):
    return torch.empty_like(records), torch.empty_like(depth), torch.empty_like(intensity)


@torch.library.register_fake("spslam::track_frame")
def _(scene, scene_scalars, plane_layout, frame, scalars, integers, *others):
    records, depth, intensity, poses = frame[:4]
    outputs = torch.empty_like(records), torch.empty_like(records), torch.empty_like(depth), torch.empty_like(intensity)
    return poses.new_empty(FOLLOWED_HEAD + 2 * FOUND_NUMBERS + STATISTICS * int(integers[1] + others[-1][-1])), *outputs


@torch.library.register_fake("spslam::predict_frame")
def _(poses, last, readout, records, *_):
    return poses.new_empty(7), torch.empty_like(readout), torch.empty_like(records)


@torch.library.register_fake("spslam::nearest_in_groups")
def _(descriptors, _, sizes):
    return descriptors.new_empty(2, len(sizes), len(descriptors), dtype=torch.int64)


@torch.library.register_fake("spslam::measure_frame_")
def _(counts, noise, state, timing, *_):
    return None
