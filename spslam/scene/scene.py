"""The map: sparse volume, tri-planes and the two decoders, with one file to save to and load from."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from spslam import ops
from spslam.errors import SpslamError, brief
from spslam.options import SceneOptions
from spslam.scene import sparse_volume, tri_planes
from spslam.scene.decoders import COLOR_DECODER, GEOMETRY_DECODER, random_parameters
from spslam.scene.sparse_volume import SparseVolume
from spslam.scene.tri_planes import TriPlanes
from spslam.tensor_file import TensorFile, load_header, load_tensors, save_tensors, whole_number
from spslam.tensor_schema import MAP

FORMAT = "spslam-map-1"
_FILE = TensorFile("map", MAP, FORMAT)
# Sizes that `spslam.tensor_schema.MAP` leaves open.
TENSOR_SIZES = {
    "embedding": sparse_volume.FEATURES,
    "features": tri_planes.FEATURES,
    "geometry_parameters": GEOMETRY_DECODER.parameters,
    "color_parameters": COLOR_DECODER.parameters,
}
_GEOMETRY, _COLOR = 1, 2  # `purpose` of the decoders' initialization


@dataclass(frozen=True)
class SceneSettings:
    """What the map is made of; stored with it.

    Attributes:
        voxel_size_m: edge of a voxel.
        truncation_m: distance at which the SDF saturates.
        plane_cell_m: edge of a tri-plane cell.
        position_scale: factor on positions (m) entering the geometry decoder.
        max_voxels: vertices above which the volume refuses to grow.
        max_texels: texels above which the planes refuse to grow; None for never.

    Raises:
        ValueError: a length outside the range that `spslam.options.SceneOptions` has for it, a truncation distance
            below a voxel's edge, or a limit that is no whole number of at least 1.
    """

    voxel_size_m: float
    truncation_m: float
    plane_cell_m: float
    position_scale: float
    max_voxels: int
    max_texels: int | None = None

    def __post_init__(self) -> None:
        for name in ("voxel_size_m", "truncation_m", "plane_cell_m", "position_scale"):
            _check_within_option(name, getattr(self, name))
        if self.truncation_m < self.voxel_size_m:
            raise ValueError(f"SceneSettings: truncation_m must be at least voxel_size_m, got {self.truncation_m}")
        whole_number(vars(self), "max_voxels", low=1)
        if self.max_texels is not None:
            whole_number(vars(self), "max_texels", low=1)


class Scene:
    """Geometry and appearance of what was seen.

    Attributes:
        settings: sizes and scales.
        origin: float64 [3] world point (m) that decoder positions are relative to, the first camera's center.
        volume: embeddings at the vertices of allocated voxels.
        planes: color features on three planes.
        geometry_decoder: flat parameters of position, embedding -> SDF / truncation.
        color_decoder: flat parameters of tri-plane feature -> RGB.
    """

    def __init__(
        self,
        settings: SceneSettings,
        seed: int,
        origin: torch.Tensor | None = None,
        geometry_decoder: torch.Tensor | None = None,
        device: torch.device | str = "cpu",
    ):
        """An empty map.

        Args:
            settings: sizes and scales.
            seed: of the random initial values.
            origin: float [3]; the world's origin where not given.
            geometry_decoder: trained parameters to start from; random ones where not given.
            device: where the tensors live.
        """
        self.settings = settings
        self.seed = seed
        self.device = torch.device(device)
        self.origin = torch.zeros(3, dtype=torch.float64) if origin is None else origin.to("cpu", torch.float64)
        self.volume = self._empty_volume()
        self.planes = self._empty_planes()
        if geometry_decoder is None:
            geometry_decoder = random_parameters(GEOMETRY_DECODER, seed, _GEOMETRY)
        self.geometry_decoder = geometry_decoder.to(self.device, torch.float32).clone()
        self.color_decoder = random_parameters(COLOR_DECODER, seed, _COLOR).to(self.device)

    def view(self) -> ops.SceneView:
        """The tensors as the fused ops take them. Valid until the scene grows."""
        return ops.SceneView(
            hash_keys=self.volume.hash_keys,
            hash_values=self.volume.hash_values,
            corner_ids=self.volume.corner_ids,
            embeddings=self.volume.embeddings,
            geometry_params=self.geometry_decoder,
            texels=self.planes.texels,
            color_params=self.color_decoder,
            voxel_size=self.settings.voxel_size_m,
            origin=self.origin.tolist(),
            position_scale=self.settings.position_scale,
            plane_cell_size=self.settings.plane_cell_m,
            plane_layout=self.planes.layout,
        )

    def sdf(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Signed distance / truncation at world points (eq. 2).

        Args:
            points: float32 [N, 3], m.

        Returns:
            float32 [N] in [-1, 1], 1 outside the allocated voxels; bool [N], whether the point is inside them.
        """
        return ops.query_sdf(self.view(), points)

    def color(self, points: torch.Tensor) -> torch.Tensor:
        """RGB at world points (eq. 3, 4): float32 [N, 3] in [0, 1] of float32 [N, 3] points (m)."""
        return ops.query_color(self.view(), points)

    @property
    def nbytes(self) -> int:
        """Bytes of the learnable parameters, the paper's model size."""
        parameters = (self.volume.embeddings, self.planes.texels, self.geometry_decoder, self.color_decoder)
        return sum(p.numel() * p.element_size() for p in parameters)

    def tensors(self) -> dict[str, torch.Tensor]:
        """Everything learnt, where it is; views, so clone what must stay as it is."""
        return {
            "origin": self.origin,
            "volume.voxel_coords": self.volume.voxel_coords,
            "volume.embeddings": self.volume.embeddings,
            "volume.weights": self.volume.weights,
            "planes.texels": self.planes.texels,
            "planes.layout": torch.tensor(self.planes.layout, dtype=torch.int64),
            "geometry_decoder": self.geometry_decoder,
            "color_decoder": self.color_decoder,
        }

    def state_dict(self) -> dict[str, torch.Tensor]:
        """`tensors()` on the CPU and contiguous; views where they are so already."""
        return {name: tensor.detach().cpu().contiguous() for name, tensor in self.tensors().items()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Replaces the content by that of `state_dict()`.

        Raises:
            SpslamError: a tensor is missing, or not what `spslam.tensor_schema.MAP` says.
        """
        MAP.check(state, TENSOR_SIZES)
        self.origin = state["origin"].to("cpu", copy=True)
        self.volume = self._empty_volume()
        volume = (state[f"volume.{name}"].to(self.device) for name in ("voxel_coords", "embeddings", "weights"))
        self.volume.restore(*volume)
        self.planes = self._empty_planes()
        self.planes.restore(state["planes.texels"], state["planes.layout"].tolist())
        self.geometry_decoder = state["geometry_decoder"].to(self.device, copy=True)
        self.color_decoder = state["color_decoder"].to(self.device, copy=True)

    def save(self, path: str | Path) -> None:
        """Writes one safetensors file, atomically; the same scene gives the same bytes. Raises OutputError."""
        header = {"format": FORMAT, "seed": self.seed, "settings": vars(self.settings)}
        save_tensors(path, self.state_dict(), header)

    @classmethod
    def load(cls, path: str | Path, device: torch.device | str = "cpu") -> "Scene":
        """Reads a file written by `save`.

        Raises:
            SpslamError: no such file, not a map, truncated, or of another shape.
        """
        header = load_header(path, _FILE)
        state = load_tensors(path, _FILE, TENSOR_SIZES)
        try:
            scene = cls(SceneSettings(**header["settings"]), whole_number(header, "seed"), device=device)
            scene.load_state_dict(state)
        except (SpslamError, KeyError, TypeError, ValueError) as error:
            raise SpslamError(f"{path}: a damaged map ({brief(str(error), 300)})") from None
        return scene

    def _empty_volume(self) -> SparseVolume:
        return SparseVolume(self.settings.voxel_size_m, max_voxels=self.settings.max_voxels, device=self.device)

    def _empty_planes(self) -> TriPlanes:
        settings = self.settings
        return TriPlanes(settings.plane_cell_m, self.seed, self.device, settings.max_texels)


def _check_within_option(name: str, value: Any) -> None:
    """Raises ValueError where a length is outside the range of the option of that name."""
    limits = SceneOptions.model_fields[name].metadata
    low = next(limit.gt for limit in limits if hasattr(limit, "gt"))
    high = next((limit.le for limit in limits if hasattr(limit, "le")), math.inf)
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not is_number or not low < value <= high or not math.isfinite(value):
        raise ValueError(f"SceneSettings: {name} must be above {low:g} and at most {high:g}, got {brief(repr(value))}")
