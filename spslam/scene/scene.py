"""The map: sparse volume, tri-planes and the two decoders, saved to and loaded from one file."""

import math
import operator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from spslam import ops
from spslam.errors import SpslamError, brief
from spslam.options import SceneOptions
from spslam.scene import sparse_volume, tri_planes
from spslam.scene.decoders import COLOR_DECODER, GEOMETRY_DECODER, random_parameters
from spslam.scene.device import usable_device
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
    """Settings of a map; stored in its file.

    Attributes:
        voxel_size_m: edge length of a voxel, m.
        truncation_m: truncation distance of the SDF, m.
        plane_cell_m: edge length of a tri-plane cell, m.
        position_scale: scale of positions (m) at the input of the geometry decoder, 1/m.
        max_voxels: largest number of voxel vertices; more raise an error.
        max_texels: largest number of texels of the planes; more raise an error. None is no limit.

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
    """Geometry and appearance of the observed space.

    Attributes:
        settings: sizes and scales.
        seed: seed of the random initial values.
        device: where the tensors are.
        origin: float64 [3] world point (m) that decoder positions are relative to: the center of the first camera.
        volume: embeddings at the vertices of allocated voxels.
        planes: color features on three planes.
        geometry_decoder: flat parameters of the network (position, embedding) -> SDF / truncation.
        color_decoder: flat parameters of the network tri-plane feature -> RGB.
    """

    def __init__(
        self,
        settings: SceneSettings,
        seed: int,
        origin: torch.Tensor | None = None,
        geometry_decoder: torch.Tensor | None = None,
        device: torch.device | str = "cpu",
    ):
        """Creates an empty map.

        Args:
            settings: sizes and scales.
            seed: seed of the random initial values.
            origin: float [3], m; the world origin by default.
            geometry_decoder: trained parameters to start from; random by default.
            device: where the tensors are.

        Raises:
            DeviceError: the device is not available.
        """
        self.settings = settings
        self.seed = seed
        # Each frame asks for the view, and few change it: the last one, and the objects that it was made of.
        self._view: ops.SceneView | None = None
        self._view_parts: tuple[object, ...] = ()
        self.device = usable_device(device)
        self.origin = torch.zeros(3, dtype=torch.float64) if origin is None else origin.to("cpu", torch.float64)
        self.volume = self._empty_volume()
        self.planes = self._empty_planes()
        if geometry_decoder is None:
            geometry_decoder = random_parameters(GEOMETRY_DECODER, seed, _GEOMETRY)
        self.geometry_decoder = geometry_decoder.to(self.device, torch.float32).clone()
        self.color_decoder = random_parameters(COLOR_DECODER, seed, _COLOR).to(self.device)

    def view(self) -> ops.SceneView:
        """The tensors as input of the fused ops. Valid until the scene grows."""
        planes = self.planes
        parts = *self.volume.parts, planes.texels, planes.layout, self.geometry_decoder, self.color_decoder, self.origin
        if self._view is None or any(map(operator.is_not, parts, self._view_parts)):
            self._view, self._view_parts = self._new_view(), parts
        return self._view

    def _new_view(self) -> ops.SceneView:
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
        """RGB at world points (eq. 3, 4).

        Args:
            points: float32 [N, 3], m.

        Returns:
            float32 [N, 3] in [0, 1].
        """
        return ops.query_color(self.view(), points)

    @property
    def nbytes(self) -> int:
        """Size of the learnable parameters in bytes: the model size of the paper."""
        parameters = (self.volume.embeddings, self.planes.texels, self.geometry_decoder, self.color_decoder)
        return sum(p.numel() * p.element_size() for p in parameters)

    def tensors(self) -> dict[str, torch.Tensor]:
        """All map tensors by name, on their device. They are views: clone what must not change."""
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
        """`tensors()` on the CPU and contiguous; still views where they already are."""
        return {name: tensor.detach().cpu().contiguous() for name, tensor in self.tensors().items()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Replaces the content by a `state_dict()`.

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
        """Writes one safetensors file, atomically; the same scene gives the same bytes.

        Raises:
            OutputError: the file cannot be written.
        """
        header = {"format": FORMAT, "seed": self.seed, "settings": vars(self.settings)}
        save_tensors(path, self.state_dict(), header)

    @classmethod
    def load(cls, path: str | Path, device: torch.device | str = "cpu") -> "Scene":
        """Reads a file written by `save`.

        Raises:
            SpslamError: no such file, not a map, truncated, or with tensors of another shape.
            DeviceError: the device is not available.
        """
        device = usable_device(device)
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
