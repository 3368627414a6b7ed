"""Independent formulas in plain torch and NumPy that the kernels are tested against: one module per family."""

from tests.reference import alpha_composite, grids, interpolation, ray_sampling, volume_rendering
from tests.reference.ray_sampling import philox4x32

__all__ = ["alpha_composite", "grids", "interpolation", "philox4x32", "ray_sampling", "volume_rendering"]
