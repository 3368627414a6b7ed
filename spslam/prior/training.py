"""Multi-threaded training: observing solids ahead of time, and gradients of the shards of a batch.

The size of a task does not depend on the machine, each task runs on one thread, and results are combined in a fixed
order. So results are the same for any number of workers.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Generator, Tensor

from spslam.prior.encoder import DECODER_WIDTHS, ENCODER_WIDTHS, parameter_count
from spslam.prior.model import (
    decode,
    encode_patches,
    initial_parameters,
    without_position,
)
from spslam.prior.patches import Patches, PatchSettings, observe
from spslam.prior.shapes import TRAINING_KINDS

_BLOCK_STEPS = 8
_ENCODER_LENGTH = parameter_count(ENCODER_WIDTHS)


@dataclass(frozen=True)
class PretrainSettings:
    """Settings that determine the trained weights.

    Attributes:
        steps: number of optimization steps.
        seed: seed of all random numbers.
        patches_per_kind: solids of each kind per step.
        learning_rate: learning rate of Adam after the warm-up.
        final_learning_rate: learning rate at the end of the cosine decay.
        warmup_steps: steps of the linear warm-up; 0 for none.
        surface_emphasis: additional weight of a query on the surface; decreases over half a voxel.
        feature_penalty: weight of the mean norm of the interpolated features.
        neighborhood: see `spslam.ops.encode_points`.
        min_pair_weight: see `spslam.ops.encode_points`.
        views: settings of the simulated observations.

    Raises:
        ValueError: `steps`, `patches_per_kind`, `warmup_steps`, `seed` or `neighborhood` is out of range.
    """

    steps: int = 4000
    seed: int = 0
    patches_per_kind: int = 4
    learning_rate: float = 4e-3
    final_learning_rate: float = 1e-5
    warmup_steps: int = 50
    surface_emphasis: float = 1.0
    feature_penalty: float = 1e-3
    neighborhood: int = 64
    min_pair_weight: float = 0.0
    views: PatchSettings = field(default_factory=PatchSettings)

    def __post_init__(self) -> None:
        for name in ("steps", "patches_per_kind"):
            if getattr(self, name) < 1:
                raise ValueError(f"PretrainSettings: {name} must be at least 1, got {getattr(self, name)}")
        if self.warmup_steps < 0:
            raise ValueError(f"PretrainSettings: warmup_steps must be at least 0, got {self.warmup_steps}")
        if self.neighborhood not in (8, 64):
            raise ValueError(f"PretrainSettings: neighborhood must be 8 or 64, got {self.neighborhood}")
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"PretrainSettings: seed must be in [0, 2^31), got {self.seed}")

    def learning_rate_at(self, step: int) -> float:
        """The learning rate of a 0-based step: linear warm-up times cosine decay."""
        cosine = 0.5 + 0.5 * math.cos(math.pi * step / self.steps)
        warm = min(1.0, (step + 1) / max(self.warmup_steps, 1))
        return self.final_learning_rate + (self.learning_rate - self.final_learning_rate) * warm * cosine


def initial_networks(seed: int) -> Tensor:
    """Random encoder and decoder parameters as one vector; the decoder's weights of the position are 0."""
    generator = Generator().manual_seed(seed)
    encoder = initial_parameters(ENCODER_WIDTHS, generator)
    return torch.cat([encoder, without_position(initial_parameters(DECODER_WIDTHS, generator))])


def split_networks(parameters: Tensor) -> tuple[Tensor, Tensor]:
    """Splits the vector of all parameters into those of the encoder and those of the decoder."""
    return parameters[:_ENCODER_LENGTH], parameters[_ENCODER_LENGTH:]


@dataclass(frozen=True)
class BatchGradient:
    """Sums over the queries of a batch.

    Attributes:
        gradient: [P], gradient of the loss.
        error: absolute SDF error, in truncations.
        queries: number of queries.
    """

    gradient: Tensor
    error: float
    queries: int


class TrainingPool:
    """A thread pool that observes solids ahead of time and computes gradients of the shards of a batch."""

    def __init__(self, workers: int, settings: PretrainSettings) -> None:
        workers = max(1, min(workers, settings.patches_per_kind))
        self._settings = settings
        self._executor = ThreadPoolExecutor(workers, "pretrain", torch.set_num_threads, (1,))

    def __enter__(self) -> TrainingPool:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown(cancel_futures=True)

    def batches(self, first_step: int) -> Iterator[list[Patches]]:
        """Yields the batches from `first_step` on, each divided into shards with one patch of every kind."""
        ahead: deque[list[Future[Patches]]] = deque()
        last_block = (self._settings.steps - 1) // _BLOCK_STEPS
        blocks = iter(range(first_step // _BLOCK_STEPS, last_block + 1))
        for block in range(first_step // _BLOCK_STEPS, last_block + 1):
            while len(ahead) < 2 and (upcoming := next(blocks, None)) is not None:
                ahead.append(self._observe(upcoming))
            kinds = [future.result() for future in ahead.popleft()]
            for step in range(block * _BLOCK_STEPS, min((block + 1) * _BLOCK_STEPS, self._settings.steps)):
                if step >= first_step:
                    yield self._shards(kinds, step % _BLOCK_STEPS)

    def gradient(self, parameters: Tensor, shards: list[Patches]) -> BatchGradient:
        """The gradient of the loss over all shards, summed in their order."""
        tasks = [self._executor.submit(_shard_gradient, parameters, shard, self._settings) for shard in shards]
        parts = [task.result() for task in tasks]
        total = parts[0].gradient
        for part in parts[1:]:
            total = total + part.gradient
        return BatchGradient(total, math.fsum(part.error for part in parts), sum(part.queries for part in parts))

    def _observe(self, block: int) -> list[Future[Patches]]:
        count = _BLOCK_STEPS * self._settings.patches_per_kind
        return [
            self._executor.submit(
                observe, kind, count, _generator(self._settings.seed, block, index), self._settings.views
            )
            for index, kind in enumerate(TRAINING_KINDS)
        ]

    def _shards(self, kinds: list[Patches], step: int) -> list[Patches]:
        count = self._settings.patches_per_kind
        rows = range(step * count, (step + 1) * count)
        return [Patches.cat([patches[row : row + 1] for patches in kinds]) for row in rows]


def _generator(seed: int, block: int, kind: int) -> Generator:
    """The generator of a task. torch uses 32 bits of a seed; SeedSequence hashes the key into them."""
    key = np.random.SeedSequence((seed, block, kind)).generate_state(1)[0]
    return Generator().manual_seed(int(key))


def _shard_gradient(parameters: Tensor, patches: Patches, settings: PretrainSettings) -> BatchGradient:
    leaf = parameters.clone().requires_grad_()
    encoder_params, decoder_params = split_networks(leaf)
    fields = encode_patches(patches, encoder_params, settings.neighborhood, settings.min_pair_weight)
    patch, _ = patches.valid.nonzero().unbind(1)
    features, inside = fields.interpolate(patch, patches.queries[patches.valid])
    features, target = features[inside], patches.sdf[patches.valid][inside]
    error = (decode(features, decoder_params) - target).abs()
    emphasis = 1 + settings.surface_emphasis * torch.exp(-(settings.views.truncation * target / 0.5).square())
    loss = (error * emphasis).sum() + settings.feature_penalty * features.norm(dim=-1).sum()
    return BatchGradient(torch.autograd.grad(loss, leaf)[0], error.sum().item(), len(target))
