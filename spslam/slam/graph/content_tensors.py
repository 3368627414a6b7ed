"""The graph's content as tensors: how checkpoints store it, and processes send it."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from spslam.slam.graph.keyframe_graph import GraphContent
from spslam.slam.graph.keyframe_tensors import edge_tensors, edges_of, pair_tensor, pairs_of, stacked
from spslam.slam.graph.loops import Proposal


def content_tensors(content: GraphContent) -> dict[str, torch.Tensor]:
    """All but how many keyframes have their edges."""
    return {
        **edge_tensors("edge_", content.edges),
        **edge_tensors("waiting_", [proposal.edge for proposal in content.waiting]),
        "waiting_correction": stacked([proposal.correction for proposal in content.waiting], 4),
        "tried": pair_tensor(content.tried),
    }


def content_of(tensors: Mapping[str, torch.Tensor], done: int) -> GraphContent:
    """What `content_tensors` made tensors of; `done` keyframes have their edges."""
    corrections = tensors["waiting_correction"].cpu().numpy().copy()
    waiting = [Proposal(*each) for each in zip(edges_of("waiting_", tensors), corrections, strict=True)]
    return GraphContent(edges_of("edge_", tensors), pairs_of(tensors["tried"]), done, waiting)
