"""Training of the prior: it reduces the error, and is reproducible for any number of workers and interruptions."""

import json
from dataclasses import asdict, replace

import pytest
import torch
from safetensors.torch import save_file

from spslam.errors import WeightsError
from spslam.prior import load_prior
from spslam.prior import pretrain as pretraining
from spslam.prior.patches import PatchSettings
from spslam.prior.pretrain import pretrain, training_files
from spslam.prior.training import PretrainSettings, initial_networks, split_networks
from spslam.prior.training_state import load_state
from spslam.prior.validation import first_zero_crossing, validate

SMALL = PretrainSettings(steps=20, patches_per_kind=2, views=PatchSettings(rays=48))


@pytest.fixture(scope="module", autouse=True)
def often():
    """A log and a validation within the few steps of these tests."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(pretraining, "_LOG_EVERY", 5)
        monkeypatch.setattr(pretraining, "_VALIDATE_EVERY", 20)
        yield


@pytest.fixture(scope="module")
def trained(tmp_path_factory, often):
    output = tmp_path_factory.mktemp("trained") / "one.safetensors"
    pretrain(output, SMALL, workers=1)
    return output


def interrupted_after(steps):
    def progress(done, total, error_mm):
        if done == steps:
            raise KeyboardInterrupt

    return progress


def test_weights_load_with_their_provenance(trained):
    prior = load_prior(trained)
    assert prior.neighborhood == SMALL.neighborhood
    assert prior.metadata["settings"]["min_pair_weight"] == SMALL.min_pair_weight
    assert prior.metadata["settings"]["steps"] == 20
    assert prior.metadata["script_version"] == pretraining.SCRIPT_VERSION
    assert set(prior.metadata["validation"]) == {"torus", "wavy_sheet", "sphere_on_plane", "mean"}
    assert not (prior.decoder_params[: 32 * 11].view(32, 11)[:, :3]).any()


def test_result_does_not_depend_on_the_number_of_workers(trained, tmp_path):
    pretrain(tmp_path / "two.safetensors", SMALL, workers=2)
    assert (tmp_path / "two.safetensors").read_bytes() == trained.read_bytes()


def test_resumed_training_gives_the_same_bytes(trained, tmp_path):
    output = tmp_path / "resumed.safetensors"
    for stop in (7, 15):
        with pytest.raises(KeyboardInterrupt):
            pretrain(output, SMALL, resume=stop > 7, workers=2, progress=interrupted_after(stop))
    assert not output.exists()
    assert training_files(output).checkpoint.exists()
    pretrain(output, SMALL, resume=True)
    assert output.read_bytes() == trained.read_bytes()
    assert training_files(output).log.read_text() == training_files(trained).log.read_text()
    assert not training_files(output).checkpoint.exists()


def test_another_seed_gives_other_weights(trained, tmp_path):
    pretrain(tmp_path / "other.safetensors", replace(SMALL, seed=1))
    assert not torch.equal(
        load_prior(tmp_path / "other.safetensors").encoder_params, load_prior(trained).encoder_params
    )


def test_global_state_is_not_changed(tmp_path):
    threads, numbers = torch.get_num_threads(), torch.get_rng_state()
    pretrain(tmp_path / "prior.safetensors", replace(SMALL, steps=2))
    assert torch.get_num_threads() == threads
    assert torch.equal(torch.get_rng_state(), numbers)


def test_log_has_errors_and_validation(trained):
    entries = [json.loads(line) for line in training_files(trained).log.read_text().splitlines()]
    assert [entry["step"] for entry in entries] == [5, 10, 15, 20, 20]
    assert all(entry["error_mm"] > 0 for entry in entries[:4])
    assert "mean" in entries[-1]["validation"]


def test_checkpoint_of_other_settings_is_refused(tmp_path):
    output = tmp_path / "prior.safetensors"
    with pytest.raises(KeyboardInterrupt):
        pretrain(output, SMALL, progress=interrupted_after(3))
    with pytest.raises(WeightsError, match="must be resumed with seed = 0, got 4"):
        pretrain(output, replace(SMALL, seed=4), resume=True)


def test_damaged_checkpoint_gives_a_one_line_error(tmp_path):
    output = tmp_path / "prior.safetensors"
    training_files(output).checkpoint.write_bytes(b"no checkpoint")
    with pytest.raises(
        WeightsError, match=r"prior\.checkpoint\.safetensors: not a readable checkpoint of spslam pretrain \(.+\)"
    ):
        pretrain(output, SMALL, resume=True)


@pytest.mark.parametrize(
    ("tensors", "header", "message"),
    [
        ({"exp_avg": torch.zeros(7)}, {}, r"tensor exp_avg must be float32 \[6601\], got float32 \[7\]"),
        ({"exp_avg_sq": torch.full((6601,), -1.0)}, {}, "tensor exp_avg_sq must be at least 0, got -1"),
        ({"parameters": torch.full((6601,), torch.nan)}, {}, "tensor parameters must be finite"),
        ({}, {"step": 10**6}, "step must be a whole number from 0 to 4000, got 1000000"),
        ({}, {"step": "many"}, "step must be a whole number from 0 to 4000, got 'many'"),
        ({}, {"running_error": float("nan")}, "running_error must be a finite number of at least 0, got nan"),
        ({}, {"settings": []}, r"settings must be an object, got \[\]"),
    ],
)
def test_a_checkpoint_changed_from_outside_gives_one_line(tmp_path, tensors, header, message):
    path = tmp_path / "prior.checkpoint.safetensors"
    settings = asdict(PretrainSettings())
    header = {"settings": settings, "step": 5, "running_error": 0.5, **header}
    tensors = {**{name: torch.zeros(6601) for name in ("parameters", "exp_avg", "exp_avg_sq")}, **tensors}
    save_file(tensors, path, metadata={"pretraining": json.dumps(header)})
    with pytest.raises(WeightsError, match=f"a damaged checkpoint of spslam pretrain .{message}"):
        load_state(path, settings)


@pytest.mark.parametrize(
    "change", [{"steps": 0}, {"seed": -1}, {"patches_per_kind": 0}, {"warmup_steps": -1}, {"neighborhood": 27}]
)
def test_settings_out_of_range_are_refused(change):
    with pytest.raises(ValueError, match=f"PretrainSettings: {next(iter(change))} must be"):
        PretrainSettings(**change)


def test_learning_rate_warms_up_and_decays():
    settings = PretrainSettings(steps=1000)
    rates = [settings.learning_rate_at(step) for step in range(1000)]
    assert rates[0] < rates[10] < max(rates) <= settings.learning_rate
    assert rates[-1] == pytest.approx(settings.final_learning_rate, rel=0.1)
    assert PretrainSettings(warmup_steps=0).learning_rate_at(0) == settings.learning_rate


def test_first_zero_crossing():
    nan = torch.nan
    sdf = torch.tensor([[1.0, 0.5, -0.5, 1.0], [-1.0, 1.0, 1.0, -3.0], [1.0, nan, -1.0, -1.0], [1.0, 1.0, 0.0, -1.0]])
    depth = torch.tensor([0.0, 1.0, 2.0, 3.0]).expand(4, 4)
    where, found = first_zero_crossing(sdf, depth)
    assert found.tolist() == [True, True, False, True]
    assert where.tolist() == [1.5, 2.25, 0.0, 2.0]


def test_validation_is_reproducible():
    networks = split_networks(initial_networks(0))
    first, second = (validate(*networks, 64, 1e-3, ("torus",)) for _ in range(2))
    assert first == second
    assert first["mean"] == first["torus"]


@pytest.mark.sweep
def test_a_minute_of_training_reduces_the_error(tmp_path):
    provenance = pretrain(tmp_path / "prior.safetensors", PretrainSettings(steps=400))
    mean = provenance["validation"]["mean"]
    assert mean["zero_crossing_mm"] < 2.0
    assert mean["sign_accuracy"] > 0.99
