"""Number of threads, as the public ops see it, and libraries that don't load."""

import pytest
import torch

from spslam import ops
from spslam.ops import _library


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


def test_a_library_that_does_not_load_is_explained(monkeypatch, tmp_path):
    """A torch that is too old lacks symbols."""

    def fail(path):
        raise OSError("undefined symbol: x")

    monkeypatch.setattr(torch.ops, "load_library", fail)
    with pytest.raises(ImportError, match=r"torch must be 2.11 or later, got .*: undefined symbol: x"):
        _library._load_cpu()
    monkeypatch.setattr(_library, "_FOLDER", tmp_path)
    monkeypatch.setattr(torch.version, "cuda", None)
    assert _library._load_cuda() == "the installed torch is a CPU build"
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    assert _library._load_cuda().startswith("spslam was built without CUDA; install it again with SPSLAM_CUDA=ON")
    (tmp_path / "_ops_cuda.so").touch()
    assert _library._load_cuda() == "_ops_cuda.so does not load: undefined symbol: x"
