"""Fixtures of the ops' tests."""

import pytest

from tests.ops.scenes import BACKENDS, Backend


@pytest.fixture(params=BACKENDS)
def backend(request) -> Backend:
    """Each way that a fused op runs."""
    return request.param
