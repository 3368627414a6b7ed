"""Parameters of the geometry and color decoders, as flat vectors in the layout of `spslam.ops.mlp`.

Both networks are in -> hidden -> hidden -> out with ReLU between the layers. This is the paper's "2-layer MLP with 32
nodes", counted as in the code of ESLAM.
"""

import math
from dataclasses import dataclass

import torch

from spslam import ops


@dataclass(frozen=True)
class MlpShape:
    """Layer widths of an in -> hidden -> hidden -> out network."""

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
    """Random initial parameters: weights and biases uniform in +-1/sqrt(inputs) of each layer, as torch.nn.Linear's.

    Args:
        shape: the network.
        seed: seed of the run.
        purpose: distinguishes the networks that are initialized from one seed.

    Returns:
        float32 [shape.parameters], the same on every machine.
    """
    uniform = ops.philox_uniform(seed, ops.RandomStream.INITIALIZATION, 0, purpose, shape.parameters)
    bounds = [uniform.new_full((rows * columns + rows,), 1 / math.sqrt(columns)) for rows, columns in shape.layers]
    return (2 * uniform - 1) * torch.cat(bounds)
