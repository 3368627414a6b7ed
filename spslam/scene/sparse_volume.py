"""The sparse feature volume: voxel vertices with an embedding each, allocated as the camera moves."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from spslam import ops
from spslam.errors import SpslamError
from spslam.scene.device import usable_device

FEATURES = 8


def resize_rows(tensor: torch.Tensor, rows: int) -> torch.Tensor:
    """Changes the number of rows of a tensor, such as an optimizer's buffer: new rows are 0.

    Args:
        tensor: any dtype, [V, ...].
        rows: new number of rows.

    Returns:
        A new tensor [rows, ...], or `tensor` itself if it already has as many rows.
    """
    if tensor.shape[0] == rows:
        return tensor
    resized = tensor.new_zeros((rows, *tensor.shape[1:]))
    common = min(rows, tensor.shape[0])
    resized[:common] = tensor[:common]
    return resized


class SparseVolume:
    """Voxel vertices at integer coordinates, `world = coords * voxel_size_m`, each with an 8-d embedding.

    An `ops.VoxelHash`, `cells`, with an embedding and a weight for each of its vertices. Tensors of V = `num_voxels`
    rows are views of buffers of `capacity` rows, whose memory is not reallocated until `capacity` changes.

    Args:
        voxel_size_m: edge length of a voxel, meters.
        max_voxels: largest number of vertices; None is no limit.
        device: where the tensors are.
        capacity: initial number of rows to reserve.

    Raises:
        ValueError: a number out of range.
        DeviceError: the device is not available.
    """

    def __init__(
        self,
        voxel_size_m: float,
        max_voxels: int | None = None,
        device: torch.device | str = "cpu",
        capacity: int = 1 << 16,
    ):
        if not voxel_size_m > 0:
            raise ValueError(f"SparseVolume: voxel_size_m must be positive, got {voxel_size_m}")
        if max_voxels is not None and max_voxels < 1:
            raise ValueError(f"SparseVolume: max_voxels must be at least 1, got {max_voxels}")
        if capacity < 1:
            raise ValueError(f"SparseVolume: capacity must be at least 1, got {capacity}")
        self.voxel_size_m = float(voxel_size_m)
        self.device = usable_device(device)
        self.cells = ops.VoxelHash(capacity, self.device, max_voxels)
        self._embeddings = torch.zeros((self.capacity, FEATURES), dtype=torch.float32, device=self.device)
        self._weights = torch.zeros(self.capacity, dtype=torch.float32, device=self.device)

    @property
    def num_voxels(self) -> int:
        """V, the number of allocated vertices."""
        return self.cells.num_voxels

    @property
    def capacity(self) -> int:
        """Number of reserved rows; optimizer buffers with as many rows are valid until it changes."""
        return self.cells.capacity

    @property
    def hash_keys(self) -> torch.Tensor:
        """int64 [2 capacity], see `spslam.ops.voxel_hash`."""
        return self.cells.hash_keys

    @property
    def hash_values(self) -> torch.Tensor:
        """int32 [2 capacity]."""
        return self.cells.hash_values

    @property
    def voxel_coords(self) -> torch.Tensor:
        """int32 [V, 3], the coordinates of voxel id i in row i."""
        return self.cells.voxel_coords

    @property
    def corner_ids(self) -> torch.Tensor:
        """int32 [V, 8], ids of the corners of the cell whose lowest vertex is voxel i; all -1 if one is missing."""
        return self.cells.corner_ids

    @property
    def embeddings(self) -> torch.Tensor:
        """float32 [V, 8], a view: writing to it changes the volume."""
        return self._embeddings[: self.num_voxels]

    @property
    def weights(self) -> torch.Tensor:
        """float32 [V], the accumulated fusion weight (W of equation 1), a view."""
        return self._weights[: self.num_voxels]

    @property
    def buffers(self) -> ops.VolumeBuffers:
        """All rows, including unused ones, as input of `ops.encode_frame_`."""
        cells = self.cells
        return ops.VolumeBuffers(
            cells.hash_keys,
            cells.hash_values,
            cells.coords_buffer,
            cells.corners_buffer,
            self._embeddings,
            self._weights,
        )

    @property
    def parts(self) -> tuple[object, ...]:
        """What the views of V rows are made of: where one of these is another object, they are others too."""
        cells = self.cells
        return cells.hash_keys, cells.hash_values, cells.corners_buffer, self._embeddings, cells.num_voxels

    def insert(self, voxel_coords: torch.Tensor) -> torch.Tensor:
        """Allocates missing vertices; their embeddings and weights are 0.

        Args:
            voxel_coords: int32 [N, 3], repetitions allowed; N = 0 changes nothing.

        Returns:
            voxel_ids int32 [N]. New ids follow the order of (x, y, z).

        Raises:
            SpslamError: more than `max_voxels` vertices are needed. The volume is not changed then.
        """
        with self._growth("insert"):
            return self.cells.insert(voxel_coords)

    def fuse(
        self, voxel_coords: torch.Tensor, features: torch.Tensor, feature_weights: torch.Tensor, max_weight: float
    ) -> torch.Tensor:
        """Allocates vertices and fuses features into them, equation (1) of SP-SLAM.

        Args:
            voxel_coords: int32 [M, 3], distinct.
            features: float32 [M, 8].
            feature_weights: float32 [M], at least 0.
            max_weight: upper limit of the accumulated weight of a vertex.

        Returns:
            voxel_ids int32 [M].

        Raises:
            SpslamError: more than `max_voxels` vertices are needed. The volume is not changed then.
        """
        voxel_ids = self.insert(voxel_coords)
        ops.fuse_prior_(self.embeddings, self.weights, voxel_ids, features, feature_weights, max_weight)
        return voxel_ids

    def encode(
        self,
        points: torch.Tensor,
        normals: torch.Tensor,
        encoder_params: torch.Tensor,
        fusion: ops.FrameFusion,
        tf32: bool = True,
    ) -> ops.EncodedFrame:
        """Allocates the vertices around a frame's points and fuses the encoded points, see `ops.encode_frame_`.

        Args:
            points: float32 [N, 3], world, meters.
            normals: float32 [N, 3], world, unit; 0 = unknown.
            encoder_params: float32 [5128], on the device of the volume.
            fusion: settings, with the voxel size of this volume.
            tf32: see `ops.encode_points`.

        Returns:
            See `ops.EncodedFrame`.

        Raises:
            SpslamError: more than `max_voxels` vertices are needed. The volume is not changed then.
        """
        while True:
            known, limit = self.num_voxels, self.cells.max_voxels
            room = self.capacity if limit is None else min(self.capacity, limit)
            encoded = ops.encode_frame_(self.buffers, known, room, points, normals, encoder_params, fusion, tf32)
            if encoded.fits:
                self.cells.num_voxels = known + encoded.new_voxels
                return encoded
            with self._growth("encode"):
                self.cells.reserve(known + encoded.new_voxels)

    def lookup(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Finds the cell that contains each point.

        Args:
            points: float32 or float64 [N, 3], world, meters.

        Returns:
            corner_ids int32 [N, 8], local_coords [N, 3] in [0, 1], and valid bool [N], whether all eight corners exist.
        """
        corner_ids, local_coords = self.cells.lookup(points, self.voxel_size_m)
        return corner_ids, local_coords, corner_ids[:, 0] >= 0

    def interpolate(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Trilinearly interpolated features at points, equation (2) of SP-SLAM; differentiable.

        Args:
            points: float32 [N, 3], world, meters.

        Returns:
            features float32 [N, 8], 0 outside the allocated cells, and valid bool [N].
        """
        corner_ids, local_coords, valid = self.lookup(points)
        return ops.trilinear_interpolate(self.embeddings, corner_ids, local_coords), valid

    def restore(self, voxel_coords: torch.Tensor, embeddings: torch.Tensor, weights: torch.Tensor) -> None:
        """Replaces the content by the `voxel_coords`, `embeddings` and `weights` of another volume.

        Voxel ids are kept: row i is voxel i. The hash table and the corner ids are rebuilt from the coordinates. On an
        error the volume is not changed.

        Args:
            voxel_coords: int32 [V, 3], distinct.
            embeddings: float32 [V, 8].
            weights: float32 [V].

        Raises:
            ValueError: inconsistent shapes, or a coordinate that is out of range or occurs twice.
            SpslamError: V is above `max_voxels`.
        """
        rows = voxel_coords.shape[0]
        _check_rows("voxel_coords", voxel_coords, (rows, 3))
        _check_rows("embeddings", embeddings, (rows, FEATURES))
        _check_rows("weights", weights, (rows,))
        with self._growth("restore"):
            self.cells.build(voxel_coords.to(self.device))
        for buffer, values in ((self._embeddings, embeddings), (self._weights, weights)):
            buffer[:rows] = values
            buffer[rows:] = 0

    @contextmanager
    def _growth(self, function: str) -> Iterator[None]:
        """Resizes embeddings and weights after the cells grew; a reached limit is reported with its option."""
        try:
            yield
        except ops.VoxelLimitError as error:
            raise SpslamError(
                f"SparseVolume.{function}: voxels must stay within scene.max_voxels = {error.max_voxels}, "
                f"got {error.wanted}; raise it or choose a larger scene.voxel_size_m"
            ) from None
        finally:
            self._embeddings = resize_rows(self._embeddings, self.capacity)
            self._weights = resize_rows(self._weights, self.capacity)


def _check_rows(argument: str, tensor: torch.Tensor, shape: tuple[int, ...]) -> None:
    if tuple(tensor.shape) != shape:
        raise ValueError(f"SparseVolume.restore: {argument} must have shape {list(shape)}, got {list(tensor.shape)}")
