"""`spslam pretrain`."""

import json

from spslam.prior import load_prior
from tests.cli.command import assert_refused, spslam


def test_pretrain_writes_weights_log_and_plot(tmp_path):
    result = spslam("pretrain", "--output", "new/prior.safetensors", "--steps", 3, "--seed", 5, "--plot", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    settings = load_prior(tmp_path / "new/prior.safetensors").metadata["settings"]
    assert (settings["steps"], settings["seed"]) == (3, 5)
    last = json.loads((tmp_path / "new/prior.log.jsonl").read_text().splitlines()[-1])
    assert last["step"] == 3
    assert (tmp_path / "new/prior.png").read_bytes().startswith(b"\x89PNG")
    assert "sphere_on_plane" in result.stdout
    assert "3/3 steps, mean error" in result.stderr


def test_quiet(tmp_path):
    result = spslam("pretrain", "--steps", 1, "--quiet", cwd=tmp_path)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
    assert (tmp_path / "prior.safetensors").is_file()


def test_wrong_options_give_a_one_line_error(tmp_path):
    assert_refused(spslam("pretrain", "--steps", 0, cwd=tmp_path), "--steps: must be a whole number of at least 1")
    assert_refused(spslam("pretrain", "--seed", -1, cwd=tmp_path), "seed must be in [0, 2^31), got -1")


def test_a_damaged_checkpoint_gives_a_one_line_error(tmp_path):
    (tmp_path / "prior.checkpoint.safetensors").write_bytes(b"damaged")
    result = spslam("pretrain", "--resume", cwd=tmp_path)
    assert_refused(result, "prior.checkpoint.safetensors: not a readable checkpoint of spslam pretrain")
