"""Compiled functions on images, poses and meshes, without torch, which is still being loaded when data is looked at.

There is a library for each instruction set, of which the best that this processor has is loaded at the first call;
`SPSLAM_CPU_ISA` (baseline, avx2 or avx512) overrides the choice, as it does for `spslam.ops`.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
from collections.abc import Iterator
from functools import cache
from pathlib import Path

_FOLDER = Path(__file__).resolve().parent
# The best first.
_LIBRARY_OF_ISA = {"avx512": "_images_cpu_avx512.so", "avx2": "_images_cpu_avx2.so", "baseline": "_images_cpu.so"}


@cache
def image_library() -> ctypes.CDLL:
    """The library for this processor; csrc/bindings/plain declares its functions.

    Raises:
        ImportError: there is none.
    """
    chosen = os.environ.get("SPSLAM_CPU_ISA")
    names = list(_LIBRARY_OF_ISA) if not chosen else [chosen]
    for name in names:
        path = _FOLDER / _LIBRARY_OF_ISA.get(name, f"no instruction set {name}")
        if path.exists():
            library = ctypes.CDLL(str(path))
            if chosen or library.spslam_runs_here():
                _declare(library)
                library.spslam_set_threads(1)
                return library
    raise ImportError(
        f"spslam: no compiled image functions for {' or '.join(names)} in {_FOLDER}; install the wheel, "
        "or build in place with `make dev`"
    )


@contextlib.contextmanager
def images_shared(threads: int) -> Iterator[None]:
    """Has so many threads share an image, where frames come one at a time; else each is its thread's own."""
    image_library().spslam_set_threads(threads)
    try:
        yield
    finally:
        image_library().spslam_set_threads(1)


def check_memory(result: int) -> int:
    """What a function returned that returns -1 where there was not enough memory.

    Raises:
        MemoryError: there was not enough.
    """
    if result < 0:
        raise MemoryError("spslam: not enough memory for this mesh or image")
    return result


def _declare(library: ctypes.CDLL) -> None:
    pointer, integer, count = ctypes.c_void_p, ctypes.c_int, ctypes.c_int64
    library.spslam_set_threads.argtypes = [integer]
    library.spslam_set_threads.restype = None
    library.spslam_register_color.argtypes = [pointer] * 7
    library.spslam_unfilter_png.argtypes = [ctypes.c_char_p, pointer, integer, pointer]
    library.spslam_orb_features.argtypes = [pointer] * 5
    library.spslam_orb_features.restype = count
    number = ctypes.c_double
    library.spslam_point_equations.argtypes = [pointer, count, pointer, pointer, number, pointer]
    library.spslam_point_equations.restype = count
    library.spslam_agreeing_points.argtypes = [pointer, count, pointer, pointer, number, pointer]
    library.spslam_agreeing_points.restype = None
    library.spslam_ray_equations.argtypes = [pointer, count, pointer, pointer, number, count, pointer]
    library.spslam_ray_equations.restype = count
    library.spslam_hold_pose.argtypes = [pointer, pointer, count, pointer, count, pointer]
    library.spslam_hold_pose.restype = count
    library.spslam_rectify_features.argtypes = [pointer, pointer, count, *[pointer] * 4]
    library.spslam_rectify_features.restype = None
    library.spslam_least_eigenvalue.argtypes = [ctypes.c_char_p]
    library.spslam_least_eigenvalue.restype = number
    library.spslam_rasterize.argtypes = [pointer, pointer, count, pointer, pointer, integer, pointer, pointer]
    library.spslam_rastered_surface.argtypes = [pointer, pointer, count, *[pointer] * 7]
    library.spslam_light_pixels.argtypes = [pointer, count, *[pointer] * 3, integer, pointer]
    library.spslam_vertex_normals.argtypes = [pointer, count, count, pointer, pointer]
    library.spslam_vertex_normals.restype = count
    library.spslam_component_areas.argtypes = [pointer, count, count, pointer, pointer, pointer]
    library.spslam_component_areas.restype = count
    library.spslam_mesh_edges.argtypes = [pointer, count, count, pointer, pointer]
    library.spslam_mesh_edges.restype = count
    library.spslam_edge_middles.argtypes = [count, *[pointer] * 5]
    library.spslam_divide_faces.argtypes = [pointer, count, count, *[pointer] * 3]
