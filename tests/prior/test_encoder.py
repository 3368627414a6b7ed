"""Loading the weights file of the prior."""

import json

import pytest
import torch
from safetensors.torch import save_file

from spslam import ops
from spslam.errors import WeightsError
from spslam.prior import load_prior
from spslam.prior.encoder import DECODER_WIDTHS, ENCODER_WIDTHS, SHIPPED, parameter_count

GOOD = {"encoder": torch.zeros(5128), "geometry_decoder": torch.zeros(1473)}
SETTINGS = {"settings": {"neighborhood": 64}}


def write(path, tensors=GOOD, metadata=SETTINGS):
    save_file(tensors, path, metadata=None if metadata is None else {"prior": json.dumps(metadata)})
    return path


def test_the_shipped_prior_has_the_shapes_of_the_networks():
    prior = load_prior()
    assert prior.encoder_params.shape == (ops.ENCODER_PARAMETERS,) == (parameter_count(ENCODER_WIDTHS),)
    inputs, hidden, outputs = DECODER_WIDTHS[0], DECODER_WIDTHS[1], DECODER_WIDTHS[3]
    assert prior.decoder_params.shape == (ops.mlp_num_params(inputs, hidden, outputs),)
    assert prior.neighborhood == 64
    assert {"script_version", "settings", "training_kinds"} <= prior.metadata.keys()


def test_the_shipped_decoder_ignores_the_position():
    first = load_prior().decoder_params[: 32 * 11].view(32, 11)
    assert not first[:, :3].any()
    assert first[:, 3:].any()


def test_a_weights_file_of_a_user_is_loaded(tmp_path):
    prior = load_prior(write(tmp_path / "own.safetensors"))
    assert prior.encoder_params.shape == (5128,)
    assert prior.neighborhood == 64
    assert prior.metadata == SETTINGS
    assert load_prior(str(tmp_path / "own.safetensors")).neighborhood == 64


def refused(path, message):
    with pytest.raises(WeightsError, match=message) as error:
        load_prior(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


def test_a_missing_file_and_a_folder_are_refused(tmp_path):
    refused(tmp_path / "none.safetensors", "no such prior file")
    refused(tmp_path, "no such prior file")


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.99])
def test_a_truncated_file_is_refused(tmp_path, share):
    whole = SHIPPED.read_bytes()
    path = tmp_path / "cut.safetensors"
    path.write_bytes(whole[: int(share * len(whole))])
    refused(path, r"not a readable prior \(")


def test_another_format_is_refused(tmp_path):
    path = tmp_path / "weights.pt"
    torch.save({"encoder": torch.zeros(5128)}, path)
    refused(path, r"not a readable prior \(")


@pytest.mark.parametrize(
    "change, message",
    [
        ({"encoder": torch.zeros(5127)}, r"tensor encoder must be float32 \[5128\], got float32 \[5127\]"),
        ({"encoder": torch.zeros(8, 641)}, r"tensor encoder must be float32 \[5128\], got float32 \[8, 641\]"),
        (
            {"geometry_decoder": torch.zeros(1473, dtype=torch.float64)},
            r"tensor geometry_decoder must be float32 \[1473\], got float64 \[1473\]",
        ),
        ({"encoder": torch.full((5128,), float("nan"))}, "tensor encoder must be finite, got NaN or infinity"),
    ],
)
def test_other_networks_are_refused(tmp_path, change, message):
    refused(write(tmp_path / "w.safetensors", {**GOOD, **change}), message)


def test_a_missing_tensor_is_named(tmp_path):
    refused(write(tmp_path / "w.safetensors", {"encoder": GOOD["encoder"]}), "tensor geometry_decoder is missing")


@pytest.mark.parametrize("metadata", [None, {}, {"settings": 3}, {"settings": {"neighborhood": [64]}}])
def test_provenance_must_say_the_neighborhood(tmp_path, metadata):
    message = "metadata prior must say settings.neighborhood, 8 or 64"
    refused(write(tmp_path / "w.safetensors", metadata=metadata), message)


def test_provenance_must_be_json(tmp_path):
    path = tmp_path / "w.safetensors"
    save_file(GOOD, path, metadata={"prior": "{"})
    refused(path, r"not a readable prior \(")
