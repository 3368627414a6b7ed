"""The weights of the scene prior: a point encoder and the geometry decoder that was trained with it."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from spslam.errors import WeightsError
from spslam.tensor_file import TensorFile, load_header, load_tensors
from spslam.tensor_schema import PRIOR

_DATA = Path(__file__).parent / "data"
SHIPPED = _DATA / "prior.safetensors"

# Layer widths; parameters are flat vectors in the layout of `spslam.ops.mlp`.
ENCODER_WIDTHS = (6, 64, 64, 8)  # position relative to the vertex (3), normal (3) -> feature
DECODER_WIDTHS = (11, 32, 32, 1)  # scaled position (3), feature (8) -> SDF / truncation before tanh
_NEIGHBORHOODS = (8, 64)
_METADATA_KEY = "prior"


def parameter_count(widths: tuple[int, ...]) -> int:
    """Length of the flat parameter vector of a network with these layer widths."""
    return sum(outputs * (inputs + 1) for inputs, outputs in zip(widths, widths[1:], strict=False))


_FILE = TensorFile("prior", PRIOR, header=_METADATA_KEY, error=WeightsError)
# What `spslam.tensor_schema.PRIOR` leaves open.
_SIZES = {
    "encoder_parameters": parameter_count(ENCODER_WIDTHS),
    "geometry_parameters": parameter_count(DECODER_WIDTHS),
}


@dataclass(frozen=True)
class Prior:
    """A trained encoder and the decoder trained with it.

    Attributes:
        encoder_params: float32 [5128], see `spslam.ops.encode_points`.
        decoder_params: float32 [1473], see `spslam.ops.mlp`; the inputs are position and feature.
        neighborhood: number of vertices around a point that the encoder was trained for, 64 or 8.
        metadata: provenance, as in the file.
    """

    encoder_params: torch.Tensor
    decoder_params: torch.Tensor
    neighborhood: int
    metadata: dict

    def to(self, device: torch.device) -> Prior:
        """The prior with its tensors on another device."""
        if self.encoder_params.device == device:
            return self
        return replace(
            self, encoder_params=self.encoder_params.to(device), decoder_params=self.decoder_params.to(device)
        )


def shipped_weights(neighborhood: int = 64) -> Path:
    """Path of the shipped weights that were trained for a neighborhood of 64 or 8 vertices."""
    return SHIPPED if neighborhood == 64 else _DATA / f"prior-{neighborhood}.safetensors"


def load_prior(path: str | os.PathLike | None = None, neighborhood: int = 64) -> Prior:
    """Reads a weights file as written by `spslam pretrain`: safetensors with `encoder` and `geometry_decoder`.

    Args:
        path: the file; None is the shipped file for the neighborhood.
        neighborhood: 64 or 8; only used without a path, as the file contains the value it was trained for.

    Raises:
        WeightsError: the file is missing or damaged, or has no weights of these networks. One line that names it.
    """
    path = shipped_weights(neighborhood) if path is None else Path(path)
    metadata = load_header(path, _FILE)
    tensors = load_tensors(path, _FILE, _SIZES)
    # Copies: reading on in a mapped file that somebody overwrites would kill the process.
    encoder, decoder = tensors["encoder"].clone(), tensors["geometry_decoder"].clone()
    return Prior(encoder, decoder, _neighborhood(path, metadata), metadata)


def _neighborhood(path: Path, metadata: dict) -> int:
    settings = metadata.get("settings")
    if not isinstance(settings, dict) or settings.get("neighborhood") not in _NEIGHBORHOODS:
        raise WeightsError(f"{path}: metadata {_METADATA_KEY} must say settings.neighborhood, 8 or 64")
    return int(settings["neighborhood"])
