"""Texture atlases of meshes: charts, the frames that saw them best, colors, and files."""

from spslam.meshing.texture.export import check_textured_format, save_textured_mesh
from spslam.meshing.texture.textured_mesh import TexturedMesh
from spslam.meshing.texture.texturing import TextureOptions, texture_mesh

__all__ = [
    "TextureOptions",
    "TexturedMesh",
    "check_textured_format",
    "save_textured_mesh",
    "texture_mesh",
]
