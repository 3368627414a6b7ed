"""The same seed gives the same bytes, on any number of threads."""

import pytest
import torch

from tests.system.sequences import Recorded, results, run_on

FRAMES = 12


@pytest.fixture
def kernel_threads():
    """Sets the kernels' number of threads, and puts it back."""
    before = torch.ops.spslam.get_num_threads()
    yield torch.ops.spslam.set_num_threads
    torch.ops.spslam.set_num_threads(before)


@pytest.mark.parametrize("preset", ["balanced", "fast", "paper"])
def test_same_seed_gives_the_same_bytes(monkeypatch, tmp_path, preset):
    for name in ("one", "two"):
        run_on(monkeypatch, Recorded(FRAMES), tmp_path / name, preset=preset)
    assert results(tmp_path / "one") == results(tmp_path / "two")


def test_threads_do_not_matter(monkeypatch, tmp_path, kernel_threads):
    for threads in (1, 2, 3):
        kernel_threads(threads)
        run_on(monkeypatch, Recorded(FRAMES), tmp_path / str(threads), f"run.prefetch_workers={threads}")
    assert results(tmp_path / "1") == results(tmp_path / "2") == results(tmp_path / "3")


def test_another_seed_gives_other_bytes(monkeypatch, tmp_path):
    for seed in (0, 1):
        run_on(monkeypatch, Recorded(6), tmp_path / str(seed), f"seed={seed}")
    first, second = results(tmp_path / "0"), results(tmp_path / "1")
    assert first[0] != second[0]
    assert first[1] != second[1]


def test_another_seed_draws_other_embeddings_without_prior(monkeypatch, tmp_path):
    for seed in (0, 1):
        run_on(
            monkeypatch,
            Recorded(1),
            tmp_path / str(seed),
            f"seed={seed}",
            "prior.enabled=false",
            "mapping.first_iterations=0",
        )
    assert results(tmp_path / "0")[1] != results(tmp_path / "1")[1]
