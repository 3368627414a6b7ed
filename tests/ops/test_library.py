"""Number of threads, as the public ops see it."""

import pytest

from spslam import ops


def test_number_of_threads_is_kept():
    before = ops.get_num_threads()
    try:
        ops.set_num_threads(3)
        assert ops.get_num_threads() == 3
    finally:
        ops.set_num_threads(before)


def test_no_thread_is_refused():
    with pytest.raises(ValueError, match="set_num_threads: count must be at least 1, got 0"):
        ops.set_num_threads(0)
