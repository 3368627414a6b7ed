"""What else speaks for a pose or against it, where its fit to the map leaves doubt."""

import math
from dataclasses import replace

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.scene import Scene
from spslam.slam.frame_history import FrameHistory, surface_shares
from spslam.slam.recovery.appearance import POINTS, brightness_correlation, brightness_sums
from spslam.slam.recovery.icp_alignment import IcpAlignment
from spslam.slam.recovery.pose_confidence import SCORE_KERNEL_M, Fit


class Verifier:
    """Holds poses against other frames' surface, the map's holes and its colors.

    Args:
        config: settings.
        camera: of all frames.
    """

    def __init__(self, config: Config, camera: Camera):
        self._config, self._camera = config, camera
        self._intrinsics = ops.Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy)

    def verified(
        self,
        fit: Fit,
        pose: torch.Tensor,
        scene: Scene,
        alignment: IcpAlignment,
        history: FrameHistory,
        records: torch.Tensor | None = None,
    ) -> Fit:
        """The fit with `free_space_violation`, `occluded_share` and `map_coverage`; with `brightness_correlation` too where pixel records are given.

        Args:
            fit: of the pose to the map.
            pose: float32 [7].
            scene: the map.
            alignment: with the frame's surface maps.
            history: the frames before.
            records: int32 [P, 3] the frame's packed pixels in random order.
        """
        counts = history.surface_counts(alignment.vertices, alignment.intrinsics, pose)
        looks = [] if records is None else [brightness_sums(scene, records[:POINTS], pose, self._camera)]
        # A doubtful frame's second wait for the device.
        numbers = torch.cat([counts, self._coverage(scene, history), *looks]).tolist()
        free_space_violation, occluded_share = surface_shares(*numbers[:3])
        alike = brightness_correlation(*numbers[4:]) if looks else math.nan
        return replace(
            fit,
            free_space_violation=free_space_violation,
            occluded_share=occluded_share,
            map_coverage=numbers[3],
            brightness_correlation=alike,
        )

    def _coverage(self, scene: Scene, history: FrameHistory) -> torch.Tensor:
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
            kernel=SCORE_KERNEL_M,
        )
        return inlier_share
