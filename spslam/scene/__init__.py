"""The map (`Scene`) and its parts: `SparseVolume` for geometry, `TriPlanes` for color, and their decoders."""

from spslam.scene.scene import Scene, SceneSettings
from spslam.scene.sparse_volume import SparseVolume
from spslam.scene.tri_planes import TriPlanes

__all__ = ["Scene", "SceneSettings", "SparseVolume", "TriPlanes"]
