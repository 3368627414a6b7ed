"""Marching cubes over sparse cells: a welded triangle mesh of a level set. Not differentiable."""

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._checks import check, check_tensor
from spslam.ops._public import public_op

_MAX_SAMPLES = 1025  # an axis: a cell's samples are counted in 32 bits
_OUT_OF_RANGE = 1  # kCoordOutOfRange in csrc/include/spslam/marching_cubes.h


@public_op()
def marching_cubes(
    cell_coords: torch.Tensor, values: torch.Tensor, level: float = 0.0
) -> tuple[torch.Tensor, torch.Tensor]:
    """Triangle mesh of the surface where a sampled field equals `level` (Lorensen and Cline 1987).

    Space is cut into unit cells; M of them are given, each cut into n x n x n cubes with samples at their corners.
    Sample (i, j, k) of a cell lies at its coordinates plus (i, j, k) / n. Cells that touch share samples, edges and
    vertices: the mesh has no seams between them, and where the cells around the surface are complete it is a closed
    manifold. A shared sample's value is that of the cell on its upper side (of the first other cell, where that one is
    not given), so that differences between the cells' copies do no harm. On a face with two inside corners diagonally
    opposite the surface separates these, seen from either side.

    Args:
        cell_coords: int32 [M, 3], distinct, in [-2^20, 2^20 - 1].
        values: float32 [M, n + 1, n + 1, n + 1], indexed x, y, z; below the level is inside. NaN or infinity is
            unknown: the cubes that touch such a sample have no faces.
        level: the value on the surface.

    Returns:
        vertices: float32 [K, 3] in cell units, one for each edge crossed, placed by linear interpolation.
        faces: int64 [L, 3], indices of vertices, counter-clockwise seen from where values are above the level.
        Every vertex has a face. Order: by cell as given, then within it; the same bits for any number of threads.
        M = 0 or no crossing gives empty tensors. On CUDA this waits for the device, which counts before it writes.

    Raises:
        TypeError: a tensor of another dtype.
        ValueError: shapes or devices that do not fit, less than 2 or more than 1025 samples an axis, coordinates out of
            range or repeated.

    Example:
        >>> axis = torch.linspace(-1, 1, 9)
        >>> x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
        >>> ball = (x**2 + y**2 + z**2).sqrt() - 0.6
        >>> vertices, faces = marching_cubes(torch.zeros(1, 3, dtype=torch.int32), ball[None])
        >>> len(vertices) - 3 * len(faces) // 2 + len(faces)  # Euler's number of a closed surface without holes
        2
    """
    name = "marching_cubes"
    check_tensor(name, "values", values, ("M", "n + 1", "n + 1", "n + 1"), torch.float32)
    cells, side = values.shape[:2]
    check_tensor(name, "values", values, (cells, side, side, side), torch.float32)
    check(side >= 2, name, "values", "have at least 2 samples an axis", side)
    check(side <= _MAX_SAMPLES, name, "values", f"have at most {_MAX_SAMPLES} samples an axis", side)
    check_tensor(name, "cell_coords", cell_coords, (cells, 3), torch.int32, like=values)
    with torch.no_grad():
        vertices, faces, faults = torch.ops.spslam.marching_cubes(cell_coords, values, level)
    if faults & _OUT_OF_RANGE:
        span = f"{cell_coords.min().item()} to {cell_coords.max().item()}"
        check(False, name, "cell_coords", "be in [-2^20, 2^20 - 1]", span)
    check(not faults, name, "cell_coords", "be distinct", "a row more than once")
    return vertices, faces


@torch.library.register_fake("spslam::marching_cubes")
def _(cell_coords, values, level):
    context = torch.library.get_ctx()
    vertices, faces = context.new_dynamic_size(), context.new_dynamic_size()
    return values.new_empty(vertices, 3), values.new_empty(faces, 3, dtype=torch.int64), 0
