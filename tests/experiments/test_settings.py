"""The script that compares settings: its arguments, and that a failed run does not end the others."""

import json
import subprocess
import sys

import pytest

from experiments.settings import parse_job, print_table, read_settings
from tests.cli.command import ROOT

SMALL = ["width=96", "height=72"]
LIGHT = "fast,pixels.per_frame=2000,mapping.first_iterations=5,mapping.iterations=2"


def test_sequence_argument_has_frames_and_options():
    job = parse_job("gray=synthetic_rgbd:some/room:10:110:2,dataset.depth_variant=exact,seed=4", "balanced", 3)
    assert (job.name, job.config, job.folder, job.start, job.stop, job.step) == (
        *("gray", "synthetic_rgbd", "some/room"),
        *(10, 110, 2),
    )
    assert job.overrides == ("dataset.depth_variant=exact", "seed=4")
    assert parse_job("room=demo::0:", "fast", 0).stop is None


def test_settings_come_from_a_file(tmp_path):
    path = tmp_path / "settings.txt"
    path.write_text("# remark\nbalanced\n\nbalanced,mapping.every=2\n")
    assert read_settings(path) == ["balanced", "balanced,mapping.every=2"]


@pytest.mark.slow
def test_rows_are_written_as_runs_finish_and_are_not_run_again(tmp_path):
    rows = tmp_path / "rows.jsonl"
    sequence = "room=demo::0:3," + ",".join(f"dataset.{option}" for option in SMALL)
    command = [sys.executable, "-m", "experiments.settings", "--sequence", sequence, "--seeds", "2", "--workers", "2"]
    command += ["--threads", "1", "--setting", LIGHT, "--setting", "fast,no.such=1", "--jsonl", str(rows)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=True)
    written = [json.loads(line) for line in rows.read_text().splitlines()]
    good = [row for row in written if "error" not in row]
    assert sorted(row["seed"] for row in good) == [0, 1]
    assert all(row["frames"] == 3 and row["fps"] > 0 for row in good)
    assert "no is not an option" in done.stdout
    subprocess.run(command, cwd=ROOT, capture_output=True, timeout=120, check=True)
    again = [json.loads(line) for line in rows.read_text().splitlines()]
    assert sum("error" not in row for row in again) == 2


def test_table_has_means_over_seeds(capsys):
    row = {"setting": "a", "name": "b", "rpe_cm": 1.0, "rpe_deg": 1.0, "lost": 0, "fps": 9.0}
    print_table([{**row, "seed": 0, "ate_rmse_cm": 1.0}, {**row, "seed": 1, "ate_rmse_cm": 2.0}])
    last = capsys.readouterr().out.splitlines()[-1].split()
    assert last[:5] == ["a", "b", "2", "1.500", "1.000"]
