"""The system's whole state, as one explicit object that can be checkpointed."""

from dataclasses import dataclass, field

import numpy as np
import torch

from spslam.camera import Camera
from spslam.config import Config
from spslam.geometry import matrix_to_pose7, pose7_to_matrix
from spslam.scene import Scene, SceneSettings
from spslam.slam.pixel_database import PixelDatabase
from spslam.slam.pixels import LATTICE_STEP_PX


@dataclass
class FrameTable:
    """What is kept of every processed frame; rows are frames.

    Attributes:
        poses: float32 [F, 7] T_world_camera as unit quaternion (w, x, y, z) and translation (m), on the device.
        timestamps: float64 [F], s.
        indices: int64 [F] index in the data set.
        lost: bool [F] whether tracking failed there.
        lattices: float16 [F, h, w] coarse depth (m), on the device.
    """

    poses: torch.Tensor
    timestamps: torch.Tensor
    indices: torch.Tensor
    lost: torch.Tensor
    lattices: torch.Tensor

    @classmethod
    def empty(cls, camera: Camera, device: torch.device) -> "FrameTable":
        """A table without rows for images of that camera."""
        offset = LATTICE_STEP_PX // 2
        rows = len(range(offset, camera.height, LATTICE_STEP_PX))
        columns = len(range(offset, camera.width, LATTICE_STEP_PX))
        return cls(
            poses=torch.zeros(0, 7, device=device),
            timestamps=torch.zeros(0, dtype=torch.float64),
            indices=torch.zeros(0, dtype=torch.int64),
            lost=torch.zeros(0, dtype=torch.bool),
            lattices=torch.zeros(0, rows, columns, dtype=torch.float16, device=device),
        )

    def append(self, pose: torch.Tensor, timestamp: float, index: int, lost: bool, lattice: torch.Tensor) -> None:
        """Adds a row."""
        row = (pose, timestamp, index, lost, lattice)
        for name, value in zip(("poses", "timestamps", "indices", "lost", "lattices"), row, strict=True):
            column = getattr(self, name)
            value = torch.as_tensor(value, dtype=column.dtype, device=column.device)
            setattr(self, name, torch.cat([column, value[None]]))

    def matrices(self) -> np.ndarray:
        """float64 [F, 4, 4] T_world_camera."""
        return pose7_to_matrix(self.poses.cpu().numpy().astype(np.float64))

    def __len__(self) -> int:
        return len(self.poses)


@dataclass
class Moments:
    """Adam's running moments of one parameter tensor [rows, columns], and how many steps were taken."""

    first: torch.Tensor
    second: torch.Tensor
    gradient: torch.Tensor
    stamps: torch.Tensor

    @classmethod
    def like(cls, parameter: torch.Tensor) -> "Moments":
        """Zero moments for a parameter [rows, columns]."""
        rows = torch.zeros(len(parameter), dtype=torch.int32, device=parameter.device)
        return cls(*(torch.zeros_like(parameter) for _ in range(3)), rows)

    def fit(self, rows: int) -> None:
        """Appends zero rows up to `rows`, with spare capacity so that growth is amortised."""
        if rows <= len(self.stamps):
            return
        capacity = max(rows, len(self.stamps) * 3 // 2)
        for name in ("first", "second", "gradient", "stamps"):
            old = getattr(self, name)
            grown = old.new_zeros((capacity, *old.shape[1:]))
            grown[: len(old)] = old
            setattr(self, name, grown)

    def move_rows(self, rows: torch.Tensor, count: int) -> None:
        """Moves row i to row `rows[i]` of `count` rows, the others zero; for a parameter whose rows moved."""
        for name in ("first", "second", "gradient", "stamps"):
            old = getattr(self, name)
            moved = old.new_zeros((count, *old.shape[1:]))
            moved[rows] = old[: len(rows)]
            setattr(self, name, moved)

    def reset(self) -> None:
        """Forgets the past steps."""
        self.first.zero_()
        self.second.zero_()


@dataclass
class SlamState:
    """Everything the system knows between two frames.

    Attributes:
        scene: the map.
        frames: poses and bookkeeping of every frame.
        pixels: pixel records of every frame.
        moments: optimiser state by parameter name.
        steps: Adam steps since the moments were last reset.
        stamp: number of mapping iterations ever done; marks rows touched by the current one.
    """

    scene: Scene
    frames: FrameTable
    pixels: PixelDatabase
    moments: dict[str, Moments] = field(default_factory=dict)
    steps: int = 0
    stamp: int = 0

    @classmethod
    def start(
        cls,
        config: Config,
        camera: Camera,
        first_pose: np.ndarray,
        geometry_decoder: torch.Tensor | None,
        device: torch.device,
    ) -> "SlamState":
        """The state before the first frame, which will be at `first_pose` (float64 [4, 4])."""
        settings = SceneSettings(
            voxel_size_m=config.scene.voxel_size_m,
            truncation_m=config.scene.truncation_m,
            plane_cell_m=config.scene.plane_cell_m,
            position_scale=config.scene.position_scale,
            max_voxels=config.scene.max_voxels,
        )
        origin = torch.from_numpy(np.asarray(first_pose)[:3, 3].copy())
        scene = Scene(settings, config.seed, origin, geometry_decoder, device)
        pixels = PixelDatabase(config.pixels.per_frame, config.pixels.budget_mb, device)
        return cls(scene, FrameTable.empty(camera, device), pixels)


def pose_tensor(matrix: np.ndarray, device: torch.device) -> torch.Tensor:
    """float32 [7] of a float64 [4, 4] pose."""
    return torch.from_numpy(matrix_to_pose7(matrix)).to(device, torch.float32)
