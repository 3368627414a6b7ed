"""Triangle meshes: extraction from a map or a signed distance field, cleaning, rendering and export."""

from spslam.meshing.export import FORMATS, save_mesh
from spslam.meshing.extract import cubes_per_cell, extract_mesh, extract_surface
from spslam.meshing.load import Mesh, load_mesh
from spslam.meshing.mesh import TriangleMesh

__all__ = [
    "FORMATS",
    "Mesh",
    "TriangleMesh",
    "cubes_per_cell",
    "extract_mesh",
    "extract_surface",
    "load_mesh",
    "save_mesh",
]
