"""Verification of a pose where its fit to the map leaves doubt: free space, the map's holes and brightness."""

import math
import weakref
from dataclasses import replace

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.scene import Scene
from spslam.slam.fit import Fit
from spslam.slam.frame_history import FrameHistory
from spslam.slam.pixels import FramePixels
from spslam.slam.recovery.appearance import brightness_correlation, brightness_sums
from spslam.slam.recovery.free_space import surface_counts, surface_shares
from spslam.slam.recovery.pose_confidence import PoseConfidenceModel


class Verifier:
    """Compares poses with other frames' surface and brightness.

    Args:
        config: options of the run.
        camera: of all frames.
        confidence: provides the kernel width of the fit and the free-space violation assumed where none is measured.
    """

    def __init__(self, config: Config, camera: Camera, confidence: PoseConfidenceModel):
        self._config, self._camera, self._confidence = config, camera, confidence
        self._intrinsics = ops.Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy)
        # The coverage as the last frame found it, from which trusted frame; neither frame nor map is kept for it.
        self._covered: tuple[weakref.ref[FramePixels], weakref.ref[Scene], int | None, float] | None = None

    def verified(
        self,
        fit: Fit,
        pose: torch.Tensor,
        scene: Scene,
        pixels: FramePixels,
        history: FrameHistory,
        compares_brightness: bool = True,
    ) -> Fit:
        """The fit with free-space violation, occluded share and map coverage, and the correlation of brightness.

        Args:
            fit: of the pose to the map.
            pose: float32 [7].
            scene: the map.
            pixels: of the frame, with images where their brightness is compared.
            history: the frames before.
            compares_brightness: false leaves the correlation unknown (NaN).
        """
        rows = history.compared_rows()
        counts, best = surface_counts(pixels, pose, history.poses, history.depth_thumbnails, rows, self._camera)
        asked = [self._brightness_sums(pixels, pose, rows[best], history)] if compares_brightness else []
        coverage, last = self._known_coverage(scene, pixels, history), history.last_row()
        if coverage is None:
            asked.append(self._map_coverage(scene, history))
        # Waits for the device, once.
        seen, through, occluded, *numbers = torch.cat([counts, *asked]).tolist()
        if coverage is None:
            coverage = numbers.pop()
            self._covered = weakref.ref(pixels), weakref.ref(scene), last, coverage
        unknown = self._confidence.unknown_free_space_violation
        violation, occluded_share = surface_shares(seen, through, occluded, unknown)
        return replace(
            fit,
            free_space_violation=violation,
            occluded_share=occluded_share,
            map_coverage=coverage,
            brightness_correlation=brightness_correlation(*numbers) if compares_brightness else math.nan,
        )

    def _known_coverage(self, scene: Scene, pixels: FramePixels, history: FrameHistory) -> float | None:
        """The map coverage, if it was counted for another pose of the same frame."""
        if self._covered is None:
            return None
        counted_for, counted_in, last, coverage = self._covered
        is_same = counted_for() is pixels and counted_in() is scene and last == history.last_row()
        return coverage if is_same else None

    def _brightness_sums(
        self, pixels: FramePixels, pose: torch.Tensor, rows: torch.Tensor, history: FrameHistory
    ) -> torch.Tensor:
        max_depth_m = self._config.dataset.max_depth_m
        return brightness_sums(pixels, pose, history.records, history.poses, rows, self._camera, max_depth_m)

    def _map_coverage(self, scene: Scene, history: FrameHistory) -> torch.Tensor:
        """Share of the last trusted frame's pixels on mapped surface, float32 [1]; NaN where there is no such frame."""
        last = history.last()
        if last is None:
            return torch.full((1,), math.nan, device=scene.device)
        _, _, _, inlier_share = ops.gauss_newton_poses(
            scene.view(),
            last.records[None, : self._config.tracking.pixels],
            last.pose[None],
            self._intrinsics,
            truncation=scene.settings.truncation_m,
            kernel=self._confidence.score_kernel_m,
        )
        return inlier_share
