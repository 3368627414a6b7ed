"""Tests do not depend on whether ORB-SLAM3 is installed; those of the baseline have a stand-in for the library."""

from pathlib import Path

import pytest

from spslam.benchmark.orb_slam3 import VOCABULARY

FAKE = Path(__file__).parent / "fake_pyorbslam3"


@pytest.fixture(autouse=True)
def no_vocabulary(monkeypatch):
    """Whoever has ORB-SLAM3 gets the same plans as everyone else."""
    monkeypatch.delenv(VOCABULARY, raising=False)


@pytest.fixture
def fake_orb_slam3(monkeypatch, tmp_path):
    """A stand-in for pyorbslam3, in this process and in those it starts; returns the vocabulary."""
    vocabulary = tmp_path / "ORBvoc.txt"
    vocabulary.write_text("words")
    monkeypatch.setenv(VOCABULARY, str(vocabulary))
    monkeypatch.setenv("PYTHONPATH", str(FAKE))
    monkeypatch.syspath_prepend(FAKE)
    return vocabulary
