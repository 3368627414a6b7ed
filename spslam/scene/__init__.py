"""The map and its parts: `SparseVolume` (geometry), `TriPlanes` (color), their decoders, and `Scene`, all of it."""

from spslam.scene.scene import Scene, SceneSettings
from spslam.scene.sparse_volume import SparseVolume
from spslam.scene.tri_planes import TriPlanes

__all__ = ["Scene", "SceneSettings", "SparseVolume", "TriPlanes"]
