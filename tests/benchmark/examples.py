"""Small suites and synthetic outcomes for the tests of the benchmark."""

from __future__ import annotations

from spslam.benchmark.jobs import Job, Plan
from spslam.benchmark.records import Outcome
from spslam.benchmark.suites import SPSLAM, Sequence, Study, Suite, Variant
from spslam.benchmark.summary import Summary, summarize

ENVIRONMENT = {
    "device": "cpu",
    "device_name": "A processor",
    "kernel_threads": 2,
    "runs_at_a_time": 1,
    "spslam": "1.0",
    "torch": "2.13",
    "commit": "abc",
}


def tiny_job(method: str = SPSLAM, seed: int = 0, **changes) -> Job:
    """Four small frames of the generated room."""
    values = {
        "sequence": "room",
        "config": "demo",
        "preset": "fast",
        "options": (("dataset.width", 80), ("dataset.height", 60), ("mapping.first_iterations", 2)),
        "method": method,
        "method_options": () if method == SPSLAM else (("voxel_m", 0.08),),
        "seed": seed,
        "frames": "0:4",
        "device": "cpu",
        "data": None,
        "mesh": None,
        "thorough": False,
    }
    return Job(**{**values, **changes})


def study(**changes) -> Study:
    """Two series with two numbers of iterations over two sequences, with a plot."""
    variants = tuple(
        Variant(f"{series} {x}", options=(("mapping.iterations", x),), series=series, x=float(x))
        for series in ("with", "without")
        for x in (1, 10)
    )
    values = {
        "name": "prior",
        "title": "With & without",
        "note": "A note.",
        "sequences": tuple(Sequence(name, "demo") for name in ("room", "hall")),
        "variants": variants,
        "columns": ("ate_rmse_cm", "f1_1cm"),
        "x_label": "iterations",
        "x_log": True,
        "plots": ("ate_rmse_cm",),
    }
    return Study(**{**values, **changes})


def made_up_summary(suite: Suite, figures, seeds: int = 1) -> Summary:
    """Results by `figures(sequence, variant name, seed)`, which returns None for a failed run."""
    cells, outcomes = {}, {}
    for part in suite.studies:
        for sequence in part.sequences:
            for variant in part.variants:
                keys = tuple(f"{part.name}/{sequence.name}/{variant.name}/{seed}" for seed in range(seeds))
                cells[part.name, sequence.name, variant.name] = keys
                for seed, key in enumerate(keys):
                    found = figures(sequence.name, variant.name, seed)
                    record = None if found is None else {"figures": found, "environment": ENVIRONMENT}
                    outcomes[key] = Outcome(key, tiny_job(seed=seed), record, "" if found else "it broke")
    return summarize(suite, Plan({}, cells, {"absent": "no --data given"}), outcomes)


def ablation(**changes) -> Suite:
    """A suite of one study."""
    return Suite("ablation", "Parts & pieces", 1, (study(**changes),))
