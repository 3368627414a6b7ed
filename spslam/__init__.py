"""spslam: dense RGB-D SLAM with scene priors.

The names in `__all__` are imported when they are first used, so that `import spslam` costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from spslam.camera import Camera
    from spslam.config import Config, load_config
    from spslam.datasets.base import RgbdFrame
    from spslam.errors import SpslamError
    from spslam.slam.frame_report import FrameReport
    from spslam.slam.system import SlamSystem
    from spslam.trajectory import Trajectory

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "Config",
    "FrameReport",
    "RgbdFrame",
    "SlamSystem",
    "SpslamError",
    "Trajectory",
    "load_config",
]

_MODULES = {
    "Camera": "spslam.camera",
    "Config": "spslam.config",
    "FrameReport": "spslam.slam.frame_report",
    "RgbdFrame": "spslam.datasets.base",
    "SlamSystem": "spslam.slam.system",
    "SpslamError": "spslam.errors",
    "Trajectory": "spslam.trajectory",
    "load_config": "spslam.config",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'spslam' has no attribute {name!r}")
    value = getattr(importlib.import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
