"""What else speaks for a pose or against it, where its fit to the map leaves doubt."""

import math
from dataclasses import replace

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.scene import Scene
from spslam.slam.likeness import POINTS, brightness_sums, likeness
from spslam.slam.loss_decision import JUDGING_KERNEL_M, Fit
from spslam.slam.past import Past, surface_shares
from spslam.slam.rescue import IcpAlignment


class Verifier:
    """Holds poses against other frames' surface, the map's holes and its colours.

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
        past: Past,
        records: torch.Tensor | None = None,
    ) -> Fit:
        """The fit with `conflict`, `hidden` and `coverage`; with `likeness` too where pixel records are given.

        Args:
            fit: of the pose to the map.
            pose: float32 [7].
            scene: the map.
            alignment: with the frame's surface maps.
            past: the frames before.
            records: int32 [P, 3] the frame's packed pixels in random order.
        """
        counts = past.surface_counts(alignment.vertices, alignment.intrinsics, pose)
        looks = [] if records is None else [brightness_sums(scene, records[:POINTS], pose, self._camera)]
        # A doubtful frame's second wait for the device.
        numbers = torch.cat([counts, self._coverage(scene, past), *looks]).tolist()
        conflict, hidden = surface_shares(*numbers[:3])
        alike = likeness(*numbers[4:]) if looks else math.nan
        return replace(fit, conflict=conflict, hidden=hidden, coverage=numbers[3], likeness=alike)

    def _coverage(self, scene: Scene, past: Past) -> torch.Tensor:
        """Share of the last trusted frame's pixels on mapped surface, float32 [1]; NaN where there is no such frame."""
        last = past.last()
        if last is None:
            return torch.full((1,), math.nan, device=scene.device)
        _, _, _, inlier_share = ops.gauss_newton_poses(
            scene.view(),
            last.records[None, : self._config.tracking.pixels],
            last.pose[None],
            self._intrinsics,
            truncation=scene.settings.truncation_m,
            kernel=JUDGING_KERNEL_M,
        )
        return inlier_share
