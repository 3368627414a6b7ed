"""What the C library does with memory that is freed."""

import ctypes

# Larger blocks are given back to the system at once, and so is what is free at a heap's end beyond this, bytes. Else
# each image would get its memory from the system anew, page by page, which takes as long as decoding it.
LARGEST_KEPT, MOST_KEPT = 32 << 20, 256 << 20
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h


def keep_freed_memory() -> None:
    """Has this process keep memory of freed images from now on; does nothing where the C library is not glibc."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, LARGEST_KEPT)
        mallopt(_M_TRIM_THRESHOLD, MOST_KEPT)
