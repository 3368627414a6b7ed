"""Marching cubes on sparse cells: an indexed triangle mesh of a level set, without seams. Not differentiable."""

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

    Input is M unit cells, each divided into n x n x n cubes with samples at their corners. Sample (i, j, k) of a cell
    is at the cell coordinates plus (i, j, k) / n. Adjacent cells share samples, edges and vertices, so the mesh has no
    seams between them. It is a closed manifold where all cells around the surface are given. The value of a shared
    sample is taken from the cell on its upper side, or from the first other cell if that one is not given, so the
    copies of the cells may differ. On a face with two diagonally opposite inside corners, the surface separates them,
    in both cubes that share the face.

    Args:
        cell_coords: int32 [M, 3], distinct, in [-2^20, 2^20 - 1].
        values: float32 [M, n + 1, n + 1, n + 1], indexed x, y, z; values below the level are inside. NaN and infinity
            are unknown: cubes with such a sample have no faces.
        level: the value on the surface.

    Returns:
        vertices: float32 [K, 3] in cell units, one per edge with a crossing, placed by linear interpolation.
        faces: int64 [L, 3], indices of vertices, counter-clockwise seen from the side with values above the level.
        Every vertex belongs to a face. Vertices and faces are in the order of the cells. The same bits for any number
        of threads. M = 0 or no crossing gives empty tensors. On CUDA the call synchronizes, to get the sizes of the
        output.

    Raises:
        TypeError: a tensor of another dtype.
        ValueError: shapes or devices that do not fit, less than 2 or more than 1025 samples per axis, coordinates out
            of range or repeated.

    Example:
        >>> axis = torch.linspace(-1, 1, 9)
        >>> x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
        >>> ball = (x**2 + y**2 + z**2).sqrt() - 0.6
        >>> vertices, faces = marching_cubes(torch.zeros(1, 3, dtype=torch.int32), ball[None])
        >>> len(vertices) - 3 * len(faces) // 2 + len(faces)  # Euler characteristic of a sphere
        2
    """
    name = "marching_cubes"
    check_tensor(name, "values", values, ("M", "n + 1", "n + 1", "n + 1"), torch.float32)
    cells, side = values.shape[:2]
    check_tensor(name, "values", values, (cells, side, side, side), torch.float32)
    check(side >= 2, name, "values", "have at least 2 samples per axis", side)
    check(side <= _MAX_SAMPLES, name, "values", f"have at most {_MAX_SAMPLES} samples per axis", side)
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
