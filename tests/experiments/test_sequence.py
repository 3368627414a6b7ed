"""The script that measures whole runs, on a few small frames."""

import argparse
import json
import subprocess
import sys

import torch

from experiments import reading, sequence
from spslam.config import load_config
from spslam.datasets import open_sequence
from tests.cli.command import ROOT

SMALL = [
    "dataset.width=96",
    "dataset.height=72",
    "pixels.per_frame=2000",
    "mapping.first_iterations=5",
    "mapping.iterations=2",
]


def test_runs_with_one_seed_are_identical():
    args = argparse.Namespace(config="demo", data=None, frames="0:4", device="cpu", repeats=2, set=SMALL)
    runs = sequence.run_preset(args, "fast")
    row = sequence.summarize("fast", runs)
    assert (len(runs), row["results"]) == (2, 1)
    assert row["fps_least"] <= row["fps"]
    stages = sum(row[f"{name}_ms"] for name in ("wait", "tracking", "encode", "mapping", "other"))
    assert 0 < stages < 1.01e3 / row["fps_least"]


def test_different_results_are_an_error(tmp_path):
    """Seeds that differ stand in for a kernel that does not repeat itself."""
    code = (
        "import sys\nfrom experiments import sequence\n"
        "rows = iter('ab')\n"
        "sequence._in_own_process = lambda preset: [{'digest': d, 'fps': 1.0} for d in rows]\n"
        f"sys.argv = ['sequence', '--preset', 'fast', '--device', 'cpu', '--json', {str(tmp_path / 'out.json')!r}]\n"
        "sequence.main()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert "runs with the same seed differ" in done.stderr
    assert json.loads((tmp_path / "out.json").read_text())["rows"][0]["results"] == 2


def test_reading_is_timed():
    config = load_config("demo", None, [*SMALL, "run.prefetch_workers=2"])
    dataset = open_sequence(config.dataset, None, slice(0, 3))
    figures = reading.read_all(dataset, config, torch.device("cpu"))
    assert figures["frames_s"] > 0
    assert figures["thread_ms"] > 0
