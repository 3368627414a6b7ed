"""Registration of pairs of keyframes: the relative pose, and how well it is determined.

The pose is that of `ops.align_depth_images`: signed distances from the surface that the target measured and differences
of brightness, weighted by the measured noise. Its covariance is that of the same residuals where they were left
(`ops.compare_depth_images`), and of what residuals do not tell: depth and images are off by the same amount for
neighboring pixels.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
import torch

from spslam import ops
from spslam.config import Config
from spslam.geometry import pose7_to_matrix
from spslam.slam.graph.keyframe import Keyframe, KeyframeCamera
from spslam.slam.recovery.feature_alignment import FeatureAlignment

PIXELS = 2048  # of the source
PIXELS_PER_ITERATION = 1024
ITERATIONS = 12  # of a stage
DAMPING = 1e-4
INDEPENDENT_PIXELS = 300  # as many a frame's pixels are worth, of which neighbors are wrong alike
# Deviations that are left however many pixels there are: of a distorted depth image.
FLOOR_M, FLOOR_RAD = 0.002, 0.001
ON_SURFACE_M, ON_SURFACE_DEVIATIONS = 0.01, 3.0  # a point that is no farther off is on the target's surface
CLEAR_TOLERANCES = 2.0  # a point so many times that far before the surface was clearly not there
# What two keyframes must have in common to show the same place. Chosen, not fitted.
MIN_OVERLAP, MIN_ON_SURFACE, MAX_THROUGH, MIN_CORRELATION = 0.3, 0.6, 0.15, 0.5
CACHED = 2048  # keyframes, of which the pixels are kept, 50 kB each
BATCH = 256  # pairs of a call
MIN_SEEN = 50  # points
MIN_AGREEING = 0.65  # of matched image features; with fewer another pose is looked for
MORE_AGREEING = 1.2  # times as many must agree with that one
MIN_DEVIATION = 0.02  # of brightness; below it is noise
MIN_INFORMATION = 1.0  # of a direction of which residuals say nothing: 1 m, 1 rad


@dataclass(frozen=True)
class _Stage:
    """How residuals are weighed: the first and last width of the robust kernel, m, and whether brightness counts."""

    kernel_start_m: float
    kernel_end_m: float
    brightness: bool


# Surface alone has the larger basin; brightness determines what it leaves free.
BY_SURFACE, WITH_BRIGHTNESS = _Stage(0.3, 0.025, False), _Stage(0.1, 0.01, True)


@dataclass(frozen=True)
class Registration:
    """Where a source is in a target's axes.

    Attributes:
        pose: float64 [4, 4] T_target_source.
        information: float64 [6, 6], inverse covariance of (translation m, rotation rad) in the target's axes.
        overlap: share of the source's points that fall on pixels with depth of the target.
        on_surface: share of these that lie on the surface there.
        through: share of these that lie clearly before it: the target looked through them.
        correlation: of the brightness of points on the surface; NaN where it is unknown.
    """

    pose: np.ndarray
    information: np.ndarray
    overlap: float
    on_surface: float
    through: float
    correlation: float

    def shortcoming(self) -> str | None:
        """Why it is no evidence that the two show the same place; None where it is."""
        if self.overlap < MIN_OVERLAP:
            return f"only {self.overlap:.0%} of the surface is shared"
        if self.on_surface < MIN_ON_SURFACE:
            return f"only {self.on_surface:.0%} of the shared surface fits"
        if self.through > MAX_THROUGH:
            return f"{self.through:.0%} of the surface was looked through"
        if self.correlation < MIN_CORRELATION:  # not where it is unknown
            return f"brightness correlates by {self.correlation:.2f} only"
        return None


@dataclass(frozen=True)
class _Sample:
    """Pixels of a keyframe: packed records int32 [P, 3] and normals float32 [P, 3]; P is 0 without depth."""

    records: torch.Tensor
    normals: torch.Tensor


class _Batch(NamedTuple):
    """Arguments of the ops: pairs of rows of sources and targets, and their poses."""

    sources: ops.DrawnPixels
    targets: ops.DepthImages
    rows: torch.Tensor
    poses: torch.Tensor
    noise: torch.Tensor


_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
Pair = tuple[Keyframe, Keyframe]  # source and target


class Registrar:
    """Registers keyframes, of one camera or of several.

    Args:
        noise: float32 [4] of each camera's sensor, see `ops.SensorNoise`.
        seed: of the draws.
        brightness: whether differences of brightness count.
        features: whether image features do.
        device: where pairs are aligned and compared; on CUDA on a stream of their own.
        pool: threads for what the host does of each keyframe and pair; None does it in the caller's.

    Attributes:
        features: see the argument.
    """

    def __init__(
        self,
        noise: Mapping[KeyframeCamera, torch.Tensor],
        seed: int,
        brightness: bool = True,
        features: bool = True,
        device: torch.device | str = "cpu",
        pool: ThreadPoolExecutor | None = None,
    ):
        # Errors of registration are in pixels of the frames' images.
        self._noise = {camera: one.cpu() * torch.tensor([1, 1, 1, 1 / camera.step**2]) for camera, one in noise.items()}
        self._seed, self._device, self._pool = seed, torch.device(device), pool
        self.features, self._brightness = features, brightness
        self._sampled = functools.lru_cache(CACHED)(self._sample)
        self._origin = torch.tensor([1.0, 0, 0, 0, 0, 0, 0])
        self._stream = torch.cuda.Stream(self._device) if self._device.type == "cuda" else None

    @classmethod
    def of_config(
        cls,
        config: Config,
        noise: Mapping[KeyframeCamera, torch.Tensor],
        device: torch.device | str = "cpu",
        pool: ThreadPoolExecutor | None = None,
    ) -> Registrar:
        """As the options of a run say: its seed, and whether it uses brightness and image features."""
        return cls(noise, config.seed, config.tracking.color, config.tracking.features, device, pool)

    def forget(self) -> None:
        """Gives back the memory of the pixels that it has drawn: dozens of MB."""
        self._sampled.cache_clear()

    def each(self, call: Callable[[_Item], _Result], items: Iterable[_Item]) -> list[_Result]:
        """What a call returns for each item; in the pool's threads, so it must not use them itself."""
        return list(map(call, items) if self._pool is None else self._pool.map(call, items))

    def register(self, source: Keyframe, target: Keyframe, start: torch.Tensor) -> Registration | None:
        """The registration found from an initial T_target_source float32 [7]; None where they share no surface."""
        return self.register_all([(source, target)], start[None])[0]

    def register_all(self, pairs: Sequence[Pair], starts: torch.Tensor) -> list[Registration | None]:
        """The registrations of pairs from initial T_target_source float32 [B, 7]."""
        poses = self._aligned(pairs, starts, BY_SURFACE)
        poses = self._aligned(pairs, poses, WITH_BRIGHTNESS)
        others: list[torch.Tensor | None] = []
        if self.features:
            self.each(lambda keyframe: keyframe.features, dict.fromkeys(itertools.chain(*pairs)))
            others = self.each(lambda row: self._by_features(*pairs[row], poses[row]), range(len(pairs)))
        again = [row for row, pose in enumerate(others) if pose is not None]
        if again:
            started = torch.stack([pose for pose in others if pose is not None])
            poses[again] = self._aligned([pairs[row] for row in again], started, WITH_BRIGHTNESS)
        return self.measure_all(pairs, poses)

    def measure(self, source: Keyframe, target: Keyframe, pose: torch.Tensor) -> Registration | None:
        """What a given T_target_source float32 [7] is worth; None where they share too little surface to say."""
        return self.measure_all([(source, target)], pose[None])[0]

    def measure_all(self, pairs: Sequence[Pair], poses: torch.Tensor) -> list[Registration | None]:
        """What given T_target_source float32 [B, 7] of pairs are worth; None where too little surface is shared."""

        def compare(batch: _Batch) -> ops.DepthImageComparison:
            compared = ops.compare_depth_images(
                batch.sources,
                batch.targets if self._brightness else batch.targets._replace(intensities=None),
                batch.rows,
                batch.poses,
                batch.noise,
                tolerance=ON_SURFACE_M,
                tolerance_deviations=ON_SURFACE_DEVIATIONS,
                clear_tolerances=CLEAR_TOLERANCES,
                least_deviation=MIN_DEVIATION,
            )
            return ops.DepthImageComparison(*(part.cpu() for part in compared))

        found: list[Registration | None] = [None] * len(pairs)
        for rows, compared in self._run(pairs, poses, compare):
            columns = zip(*(part.tolist() for part in compared[:4]), compared.information.numpy(), strict=True)
            for row, (seen, on_it, through, correlation, normal) in zip(rows, columns, strict=True):
                if min(seen, on_it) < MIN_SEEN or not bool(poses[row].isfinite().all()):
                    continue
                found[row] = Registration(
                    pose7_to_matrix(poses[row].double().numpy()),
                    _information(normal * (min(on_it, INDEPENDENT_PIXELS) / on_it)),
                    seen / PIXELS,
                    on_it / seen,
                    through / seen,
                    correlation,
                )
        return found

    def _by_features(self, source: Keyframe, target: Keyframe, pose: torch.Tensor) -> torch.Tensor | None:
        """The pose that image features agree on, if most of them disagree with `pose`: brightness has a small basin."""
        image = FeatureAlignment(source.features, source.camera.camera)
        matches = image.matches(target.features, self._origin)
        agreeing = image.inliers(matches, image.color_pose(pose))
        if agreeing > MIN_AGREEING * len(matches):
            return None
        found = image.pose(matches, pose.device)
        if found is None or image.inliers(matches, image.color_pose(found)) < MORE_AGREEING * agreeing:
            return None
        return found

    def _aligned(self, pairs: Sequence[Pair], starts: torch.Tensor, stage: _Stage) -> torch.Tensor:
        """T_target_source float32 [B, 7] after a stage."""
        options = ops.AlignmentOptions(
            num_pixels=PIXELS_PER_ITERATION,
            iterations=ITERATIONS,
            kernel_start=stage.kernel_start_m,
            kernel_end=stage.kernel_end_m,
            damping=DAMPING,
            seed=self._seed,
            stream=ops.RandomStream.TRACKING_PIXELS,
        )
        bright = stage.brightness and self._brightness

        def align(batch: _Batch) -> torch.Tensor:
            targets = batch.targets if bright else batch.targets._replace(intensities=None)
            found = ops.align_depth_images(batch.sources, targets, batch.rows, batch.poses, options, noise=batch.noise)
            return found.cpu()

        poses = starts.clone()
        for rows, found in self._run(pairs, starts, align):
            poses[rows] = found
        return poses

    def _run(
        self, pairs: Sequence[Pair], poses: torch.Tensor, call: Callable[[_Batch], _Result]
    ) -> Iterator[tuple[list[int], _Result]]:
        """Calls an op for all pairs of which the source has surface: rows of pairs, and what it returned for them."""
        by_cameras: dict[tuple[KeyframeCamera, KeyframeCamera], list[int]] = {}
        for row, (source, target) in enumerate(pairs):
            if len(self._sampled(source).records):
                by_cameras.setdefault((source.camera, target.camera), []).append(row)
        for rows in by_cameras.values():
            for begin in range(0, len(rows), BATCH):
                part = rows[begin : begin + BATCH]
                with nullcontext() if self._stream is None else torch.cuda.stream(self._stream):
                    result = call(self._batch([pairs[row] for row in part], poses[part]))
                yield part, result

    def _batch(self, pairs: Sequence[Pair], poses: torch.Tensor) -> _Batch:
        """Arguments of the ops for pairs whose sources have one camera, and whose targets have."""
        sources = list(dict.fromkeys(source for source, _ in pairs))
        targets = list(dict.fromkeys(target for _, target in pairs))
        numbered = [{keyframe: row for row, keyframe in enumerate(each)} for each in (sources, targets)]
        rows = torch.tensor([[numbered[0][source], numbered[1][target]] for source, target in pairs])
        samples, camera = [self._sampled(source) for source in sources], targets[0].camera
        device = self._device
        return _Batch(
            ops.DrawnPixels(
                torch.stack([sample.records for sample in samples]).to(device),
                torch.stack([sample.normals for sample in samples]).to(device),
                torch.tensor([source.frame for source in sources]).to(device),
                sources[0].camera.intrinsics,
            ),
            ops.DepthImages(
                torch.stack([target.depth for target in targets]).to(device),
                camera.unit,
                camera.intrinsics,
                torch.stack([target.intensity for target in targets]).to(device),
            ),
            rows.to(device),
            poses.to(device),
            self._noise_of(*pairs[0]).to(device),
        )

    def _noise_of(self, source: Keyframe, target: Keyframe) -> torch.Tensor:
        """float32 [4] of the noisier of two keyframes' sensors."""
        return torch.maximum(self._noise[source.camera], self._noise[target.camera])

    def _sample(self, keyframe: Keyframe) -> _Sample:
        return _Sample(*keyframe.sample(PIXELS, self._seed))


def _information(normal: np.ndarray) -> np.ndarray:
    """Information float64 [6, 6] of normal equations, with the floor added to the covariance."""
    values, vectors = np.linalg.eigh(normal)
    covariance = (vectors / np.maximum(values, MIN_INFORMATION)) @ vectors.T
    floor = np.diag([FLOOR_M**2] * 3 + [FLOOR_RAD**2] * 3)
    information = np.linalg.inv(covariance + floor)
    return (information + information.T) / 2
