"""spslam's CPU kernels for NumPy arrays, without torch.

The functions are those of `spslam.ops` that need no gradient tape, with the same names, arguments and results, to the
bit; differentiable ones have their derivative beside them as `<name>_backward`. Contiguous arrays are not copied, and
Python's lock is released while a kernel runs. Errors: TypeError for another dtype, ValueError for another shape.

    >>> import numpy as np
    >>> keys, values = new_voxel_hash(16)
    >>> voxel_hash_insert(keys, values, np.array([[2, 0, 0], [1, 0, 0]], np.int32), 0).tolist()
    [[1, 0, 0], [2, 0, 0]]

`VoxelHash` is the object that grows, `Activation` and `RandomStream` name what functions take as numbers.

`SPSLAM_CPU_ISA` (baseline, avx2 or avx512) overrides the choice of the instruction set.
"""

from spslam_numpy._enums import Activation, RandomStream
from spslam_numpy._hash_table import VoxelHash, VoxelLimitError
from spslam_numpy._library import CPU_ISA, kernels

__version__ = "0.1.0"

__all__ = ["CPU_ISA", "Activation", "RandomStream", "VoxelHash", "VoxelLimitError"]

# What the kernels export; __init__.pyi has their signatures.
_compiled = sorted(name for name in vars(kernels) if not name.startswith("_"))
__all__ += _compiled
globals().update({name: getattr(kernels, name) for name in _compiled})
