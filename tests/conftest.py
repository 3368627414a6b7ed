"""Fixtures shared by all tests."""

import gc

import pytest
import torch

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]


def pytest_collection_modifyitems(items):
    if torch.cuda.is_available():
        return
    skip = pytest.mark.skip(reason="no CUDA device")
    for item in items:
        if "cuda" in item.keywords:
            item.add_marker(skip)


def pytest_collection_finish():
    # Thousands of tests and torch's modules stay to the end: the collector need not look at them again and again.
    gc.collect()
    gc.freeze()


@pytest.fixture(params=DEVICES)
def device(request) -> torch.device:
    """Each device that ops are tested on."""
    return torch.device(request.param)


@pytest.fixture
def generator() -> torch.Generator:
    """A CPU generator of fixed seed, for test inputs."""
    return torch.Generator().manual_seed(0)
