"""Options of the map, of the prior that fills it, and of its mesh."""

from __future__ import annotations

from typing import Literal

from spslam.options.needs import is_, need
from spslam.options.section import Section, option

_ENABLED = is_("prior.enabled", True)
_PRIOR = need(_ENABLED)

TRUNCATION_VOXELS = 2  # the truncation in voxels that the shipped prior was trained for


class SceneOptions(Section):
    """The map: sparse volume, tri-planes and world frame."""

    voxel_size_m: float = option("edge length of a voxel of the sparse volume", "m", gt=0, le=1)
    truncation_m: float | None = option(
        "truncation distance tr of the signed distance; null is two voxels, which the pretrained decoder needs",
        "m",
        gt=0,
        le=4,
    )
    plane_cell_m: float = option("edge length of a tri-plane cell", "m", gt=0, le=4)
    position_scale: float = option("scale of the position that the geometry decoder takes as input", "1/m", gt=0)
    first_pose: Literal["dataset", "identity"] = option(
        "pose of the frame that the map begins with: the dataset's ground truth if there is one, or the identity"
    )
    max_voxels: int = option("maximum number of voxel vertices in the volume", "vertices", ge=1000)
    max_texels: int = option("maximum number of texels in the tri-planes", "texels", ge=1000)

    @property
    def truncation(self) -> float:
        """The truncation distance in use, m."""
        return TRUNCATION_VOXELS * self.voxel_size_m if self.truncation_m is None else self.truncation_m

    def check(self) -> None:
        if self.truncation < self.voxel_size_m:
            raise ValueError(f"scene.truncation_m must be at least scene.voxel_size_m, got {self.truncation_m}")


class PriorOptions(Section):
    """The depth encoder and its fusion into the volume (section III.A)."""

    enabled: bool = option("encode and fuse each mapped frame; false initializes new vertices with random embeddings")
    fusion: bool = option("fuse into existing vertices by eq. (1); false only initializes new ones", needs=(_PRIOR,))
    weights: str | None = option(
        "file of encoder and decoder weights (safetensors); null is the shipped one for the neighborhood",
        needs=(need(_ENABLED, is_("prior.decoder", "pretrained")),),
    )
    decoder: Literal["pretrained", "random"] = option(
        "initial geometry decoder: the one trained with the encoder, or random weights"
    )
    neighborhood: Literal[8, 64] = option("number of voxel vertices around a point that it is encoded at", "vertices")
    points_per_frame: int = option("maximum number of points encoded per frame", "points", ge=1)
    min_weight: float = option("minimum sum of point weights at which a vertex is allocated", ge=0)
    kappa: float = option("sum of point weights at which a vertex's weight W_m reaches 1", needs=(_PRIOR,), gt=0)
    max_weight: float = option("upper limit of the fused weight W_g", needs=(_PRIOR,), gt=0)
    normal_step_px: int = option("step of the depth differences that surface normals are computed from", "px", ge=1)
    max_jump: float = option(
        "relative depth difference to a pixel `normal_step_px` away from which on it is a depth discontinuity without "
        "normal",
        gt=0,
    )


class MeshOptions(Section):
    """The mesh written at the end."""

    source: Literal["tsdf", "neural"] = option(
        "`tsdf` reads all frames again and fuses them at their final poses into a truncated signed distance field, the "
        "map filling in where no frame measured anything; `neural` extracts the map alone, which needs no frames"
    )
    resolution_m: float = option(
        "edge length of a voxel of `tsdf`, or of a marching-cubes cell of `neural`", "m", gt=0, le=1
    )
    max_memory_mb: int = option(
        "memory of the voxels; where they would need more, voxels 1.5 times as large are taken",
        "MB",
        needs=(need(is_("mesh.source", "tsdf")),),
        ge=1,
    )
    color_subdivisions: int = option(
        "how many times edges of faces are divided in two for finer colors where images vary between their ends; 0 "
        "divides none",
        needs=(need(is_("mesh.source", "tsdf")),),
        ge=0,
        le=3,
    )
