"""Parameters of the two decoders, as the flat vectors that `spslam.ops.mlp` takes.

Both are in -> hidden -> hidden -> out with ReLU inside: the paper's "2-layer MLP with 32 nodes", as ESLAM's code
counts.
"""

import math
from dataclasses import dataclass

import torch

from spslam import ops


@dataclass(frozen=True)
class MlpShape:
    """Widths of an in -> hidden -> hidden -> out network."""

    inputs: int
    hidden: int
    outputs: int

    @property
    def layers(self) -> tuple[tuple[int, int], ...]:
        """(outputs, inputs) of each linear layer."""
        return (self.hidden, self.inputs), (self.hidden, self.hidden), (self.outputs, self.hidden)

    @property
    def parameters(self) -> int:
        """Length of the flat parameter vector."""
        return sum(rows * columns + rows for rows, columns in self.layers)


GEOMETRY_DECODER = MlpShape(inputs=11, hidden=32, outputs=1)  # scaled position (3), embedding (8) -> SDF / truncation
COLOR_DECODER = MlpShape(inputs=32, hidden=32, outputs=3)  # tri-plane feature (32) -> RGB


def random_parameters(shape: MlpShape, seed: int, purpose: int) -> torch.Tensor:
    """Uniform initialization in +-1/sqrt(inputs) of each layer, weights and biases alike (torch.nn.Linear's).

    Args:
        shape: the network.
        seed: the run's seed.
        purpose: tells networks of one seed apart.

    Returns:
        float32 [shape.parameters], the same on every machine.
    """
    uniform = ops.philox_uniform(seed, ops.Stream.INITIALIZATION, 0, purpose, shape.parameters)
    bounds = torch.cat([torch.full((rows * columns + rows,), 1 / math.sqrt(columns)) for rows, columns in shape.layers])
    return (2 * uniform - 1) * bounds
