"""A system in one file: its state as a checkpoint has it, and the options and camera that make the system again."""

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spslam.camera import Camera
from spslam.config import Config, restore_config
from spslam.errors import ConfigError, OutputError, brief
from spslam.slam.checkpoint import load_checkpoint, read_source, take_snapshot, write_snapshot
from spslam.slam.state import SlamState

_KEY = "system"


@dataclass(frozen=True)
class SystemSettings:
    """What a system is made with.

    Attributes:
        config: its options.
        camera: of its frames.
        first_pose: float64 [4, 4] T_world_camera of its first frame.
    """

    config: Config
    camera: Camera
    first_pose: np.ndarray


def save_system(path: Path, state: SlamState, settings: SystemSettings) -> None:
    """Writes the file; raises OutputError where it can't be written, and leaves what was there."""
    frames = state.frames.processed
    source: dict[str, Any] = {
        "data": {"frames": frames},
        "next": frames,
        "clock": {"frames": frames, "wall_s": 0.0, "decode_s": 0.0},
        _KEY: {
            "config": settings.config.model_dump(mode="json"),
            "camera": asdict(settings.camera),
            "first_pose": settings.first_pose.tolist(),
        },
    }
    write_snapshot(path, take_snapshot(state, settings.config, source, copy=False))


def read_settings(path: Path) -> SystemSettings:
    """What the saved system was made with; raises OutputError where the file is missing, damaged or something else."""
    saved = read_source(path).get(_KEY)
    if not isinstance(saved, dict):
        raise OutputError(f"{path}: must be a file of SlamSystem.save, but it has no settings of a system")
    try:
        config = restore_config(saved["config"])
        camera = Camera(**saved["camera"])
        first_pose = np.array(saved["first_pose"], dtype=np.float64)
        if first_pose.shape != (4, 4) or not math.isfinite(float(first_pose.sum())):
            raise ValueError("first_pose must be 16 finite numbers")
    except (ConfigError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise OutputError(f"{path}: a damaged file of SlamSystem.save ({brief(str(error), 300)})") from None
    return SystemSettings(config, camera, first_pose)


def load_state(path: Path, state: SlamState, config: Config) -> None:
    """Restores a new system's state in place; raises OutputError where the file is damaged."""
    load_checkpoint(path, state, config)
