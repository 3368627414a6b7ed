"""The sparse feature volume: voxel vertices with an embedding each, growing as the camera moves."""

import torch

from spslam import ops
from spslam.errors import SpslamError

FEATURES = 8
_CORNERS = 8
_NO_VOXEL = -1


def resize_rows(tensor: torch.Tensor, rows: int) -> torch.Tensor:
    """`tensor` with another number of rows: the common ones copied, new ones zero. For the optimiser's buffers.

    Args:
        tensor: any dtype, [V, ...].
        rows: number of rows wanted.

    Returns:
        A new tensor [rows, ...], or `tensor` itself where it already has that many.
    """
    if tensor.shape[0] == rows:
        return tensor
    resized = tensor.new_zeros((rows, *tensor.shape[1:]))
    common = min(rows, tensor.shape[0])
    resized[:common] = tensor[:common]
    return resized


class SparseVolume:
    """Voxel vertices at integer coordinates, `world = coords * voxel_size_m`, each with an 8-d embedding.

    Tensors of V = `num_voxels` rows are views of buffers of `capacity` rows that double when they are full, so growth
    is amortised and a view's memory stays where it is until `capacity` changes.

    Args:
        voxel_size_m: edge of a voxel, metres.
        max_voxels: most vertices allowed; None for as many as memory holds.
        device: where the volume lives.
        capacity: rows to reserve at first.
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
        self.max_voxels = max_voxels
        self.device = torch.device(device)
        self.num_voxels = 0
        capacity = _power_of_two(capacity)
        self.hash_keys, self.hash_values = ops.new_voxel_hash(2 * capacity, self.device)
        self._voxel_coords = torch.zeros((capacity, 3), dtype=torch.int32, device=self.device)
        self._corner_ids = torch.full((capacity, _CORNERS), _NO_VOXEL, dtype=torch.int32, device=self.device)
        self._embeddings = torch.zeros((capacity, FEATURES), device=self.device)
        self._weights = torch.zeros(capacity, device=self.device)

    @property
    def capacity(self) -> int:
        """Rows reserved; optimiser buffers of as many rows stay valid until it changes."""
        return self._voxel_coords.shape[0]

    @property
    def voxel_coords(self) -> torch.Tensor:
        """int32 [V, 3], row i the coordinates of voxel id i."""
        return self._voxel_coords[: self.num_voxels]

    @property
    def corner_ids(self) -> torch.Tensor:
        """int32 [V, 8], the ids of the cell above each vertex, all -1 where one is missing."""
        return self._corner_ids[: self.num_voxels]

    @property
    def embeddings(self) -> torch.Tensor:
        """float32 [V, 8], a view: writing to it changes the volume."""
        return self._embeddings[: self.num_voxels]

    @property
    def weights(self) -> torch.Tensor:
        """float32 [V], the fusion weight gathered so far (W of equation 1), a view."""
        return self._weights[: self.num_voxels]

    def insert(self, voxel_coords: torch.Tensor) -> torch.Tensor:
        """Allocates the vertices that are missing; their embeddings and weights start at 0.

        Args:
            voxel_coords: int32 [N, 3], repetitions allowed; N = 0 changes nothing.

        Returns:
            voxel_ids int32 [N]. New ids follow the order of (x, y, z).

        Raises:
            SpslamError: more than `max_voxels` would exist. The volume is then as before.
        """
        voxel_ids = ops.voxel_hash_find(self.hash_keys, self.hash_values, voxel_coords)
        absent = voxel_coords[voxel_ids < 0]
        if absent.shape[0] == 0:
            return voxel_ids
        self._make_room(absent)
        first_new = self.num_voxels
        new_coords = ops.voxel_hash_insert(self.hash_keys, self.hash_values, absent, first_new)
        self.num_voxels = first_new + new_coords.shape[0]
        self._voxel_coords[first_new : self.num_voxels] = new_coords
        ops.voxel_hash_update_corner_ids(
            self.hash_keys, self.hash_values, self.voxel_coords, self.corner_ids, first_new
        )
        return ops.voxel_hash_find(self.hash_keys, self.hash_values, voxel_coords)

    def fuse(
        self, voxel_coords: torch.Tensor, features: torch.Tensor, feature_weights: torch.Tensor, max_weight: float
    ) -> torch.Tensor:
        """Allocates vertices and fuses features into them, equation (1) of SP-SLAM.

        Args:
            voxel_coords: int32 [M, 3], distinct.
            features: float32 [M, 8].
            feature_weights: float32 [M], at least 0.
            max_weight: cap of the total weight of a vertex.

        Returns:
            voxel_ids int32 [M].

        Raises:
            SpslamError: more than `max_voxels` would exist. The volume is then as before.
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
        """Allocates the vertices around a frame's points and fuses their encoding, see `ops.encode_frame_`.

        Args:
            points: float32 [N, 3], world, metres.
            normals: float32 [N, 3], world, unit; 0 = unknown.
            encoder_params: float32 [5128], on the volume's device.
            fusion: settings; of this volume's voxel size.
            tf32: see `ops.encode_points`.

        Raises:
            SpslamError: more than `max_voxels` would exist. The volume is then as before.
        """
        while True:
            buffers = ops.VolumeBuffers(
                self.hash_keys, self.hash_values, self._voxel_coords, self._corner_ids, self._embeddings, self._weights
            )
            room = self.capacity if self.max_voxels is None else min(self.capacity, self.max_voxels)
            encoded = ops.encode_frame_(buffers, self.num_voxels, room, points, normals, encoder_params, fusion, tf32)
            wanted = self.num_voxels + encoded.new_voxels
            if encoded.fits:
                self.num_voxels = wanted
                return encoded
            self._check_limit("encode", wanted)
            self._reserve(wanted)

    def lookup(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """The cell around each point.

        Args:
            points: float32 or float64 [N, 3], world, metres.

        Returns:
            corner_ids int32 [N, 8], local_coords [N, 3] in [0, 1], and valid bool [N]: all eight corners exist.
        """
        corner_ids, local_coords = ops.voxel_hash_lookup(
            self.hash_keys, self.hash_values, self.corner_ids, points, self.voxel_size_m
        )
        return corner_ids, local_coords, corner_ids[:, 0] >= 0

    def interpolate(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Trilinearly interpolated features at points, equation (2) of SP-SLAM; differentiable.

        Args:
            points: float32 [N, 3], world, metres.

        Returns:
            features float32 [N, 8], 0 outside the allocated cells, and valid bool [N].
        """
        corner_ids, local_coords, valid = self.lookup(points)
        return ops.trilinear_interpolate(self.embeddings, corner_ids, local_coords), valid

    def restore(self, voxel_coords: torch.Tensor, embeddings: torch.Tensor, weights: torch.Tensor) -> None:
        """Replaces the content by what `voxel_coords`, `embeddings` and `weights` of another volume were.

        Voxel ids are kept: row i is voxel i again. The hash table and the rows of corner ids follow from the
        coordinates.

        Args:
            voxel_coords: int32 [V, 3], distinct.
            embeddings: float32 [V, 8].
            weights: float32 [V].

        Raises:
            ValueError: shapes that don't fit each other, or a coordinate out of range.
            SpslamError: a coordinate occurs twice, or V is above `max_voxels`.
        """
        rows = voxel_coords.shape[0]
        _check_rows("voxel_coords", voxel_coords, (rows, 3))
        _check_rows("embeddings", embeddings, (rows, FEATURES))
        _check_rows("weights", weights, (rows,))
        self._check_limit("restore", rows)
        self.num_voxels = 0
        self._reserve(rows)
        self._voxel_coords[:rows] = voxel_coords
        ops.voxel_hash_build_(self.hash_keys, self.hash_values, self._voxel_coords[:rows])
        found = ops.voxel_hash_find(self.hash_keys, self.hash_values, self._voxel_coords[:rows])
        if not torch.equal(found, torch.arange(rows, dtype=torch.int32, device=self.device)):
            self.hash_keys.fill_(-1)
            raise SpslamError("SparseVolume.restore: voxel_coords must be distinct, got a repeated row")
        self.num_voxels = rows
        for buffer, values in ((self._embeddings, embeddings), (self._weights, weights)):
            buffer[:rows] = values
            buffer[rows:] = 0
        self._corner_ids.fill_(_NO_VOXEL)
        ops.voxel_hash_update_corner_ids(self.hash_keys, self.hash_values, self.voxel_coords, self.corner_ids, 0)

    def _make_room(self, absent: torch.Tensor) -> None:
        """Reserves rows for the distinct ones of `absent`, counted only where the simple bound is not enough."""
        wanted = self.num_voxels + absent.shape[0]
        if wanted > self.capacity or (self.max_voxels is not None and wanted > self.max_voxels):
            wanted = self.num_voxels + torch.unique(absent, dim=0).shape[0]
        self._check_limit("insert", wanted)
        self._reserve(wanted)

    def _check_limit(self, function: str, wanted: int) -> None:
        if self.max_voxels is not None and wanted > self.max_voxels:
            raise SpslamError(
                f"SparseVolume.{function}: voxels must stay within scene.max_voxels = {self.max_voxels}, "
                f"got {wanted}; raise it or choose a larger scene.voxel_size_m"
            )

    def _reserve(self, rows: int) -> None:
        if rows <= self.capacity:
            return
        capacity = _power_of_two(rows)
        self._voxel_coords = resize_rows(self._voxel_coords, capacity)
        self._embeddings = resize_rows(self._embeddings, capacity)
        self._weights = resize_rows(self._weights, capacity)
        self._corner_ids = resize_rows(self._corner_ids, capacity)
        self._corner_ids[self.num_voxels :] = _NO_VOXEL
        self.hash_keys, self.hash_values = ops.new_voxel_hash(2 * capacity, self.device)
        ops.voxel_hash_build_(self.hash_keys, self.hash_values, self.voxel_coords)


def _power_of_two(rows: int) -> int:
    return 1 << max(rows - 1, 0).bit_length()


def _check_rows(argument: str, tensor: torch.Tensor, shape: tuple[int, ...]) -> None:
    if tuple(tensor.shape) != shape:
        raise ValueError(f"SparseVolume.restore: {argument} must have shape {list(shape)}, got {list(tensor.shape)}")
