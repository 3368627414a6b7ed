"""A few runs are killed at random moments and resumed to the same bytes; `python -m tests.kills` kills a thousand."""

import pytest

from tests.kills.trial import measure, try_kills

SEEDS = range(6)


@pytest.mark.slow
def test_killed_runs_are_resumed_to_the_same_bytes(tmp_path):
    reference = measure(tmp_path)
    outcomes = [try_kills(tmp_path / "run", seed, reference) for seed in SEEDS]
    assert [error for _, errors in outcomes for error in errors] == []
    assert sum(kills for kills, _ in outcomes) >= len(SEEDS) // 2
