"""What goes between the loop's process and the one that solves the graph; numbers are arrays, which take no time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from spslam.config import Config
from spslam.slam.graph.content_tensors import content_of, content_tensors
from spslam.slam.graph.keyframe import Keyframe, KeyframeCamera
from spslam.slam.graph.keyframe_graph import GraphContent, GraphUpdate
from spslam.slam.graph.keyframe_tensors import keyframe_tensors, keyframes_of, link_tensors, links_of
from spslam.slam.graph.solver import GraphProblem, GraphSolution
from spslam.slam.image_features import ImageFeatures

Arrays = dict[str, np.ndarray]


class SentContent(NamedTuple):
    """A graph's content: arrays, and how many keyframes have their edges."""

    arrays: Arrays
    done: int

    @classmethod
    def of(cls, content: GraphContent) -> SentContent:
        """That of a content."""
        return cls(_arrays(content_tensors(content)), content.done)

    def content(self) -> GraphContent:
        """What was sent."""
        return content_of(_tensors(self.arrays), self.done)


@dataclass(frozen=True)
class Request:
    """A graph to be solved.

    Attributes:
        config: options of the run.
        known: how many keyframes the process has from before: those of its last solution that it did not leave out.
        keyframes: those after them.
        cameras: of keyframes.
        links: of all of them.
        poses: see `GraphProblem`.
        content: see `GraphProblem`.
        noises: float32 [4] of each camera's sensor.
    """

    config: Config
    known: int
    keyframes: Arrays
    cameras: list[KeyframeCamera]
    links: Arrays
    poses: np.ndarray
    content: SentContent
    noises: dict[KeyframeCamera, np.ndarray]

    @classmethod
    def of(cls, config: Config, known: int, keyframes: Iterable[Keyframe], problem: GraphProblem) -> Request:
        """That of a problem, of whose keyframes the process knows the first ones; the others are given."""
        new = list(keyframes)
        cameras = list(dict.fromkeys(keyframe.camera for keyframe in new))
        noises = {camera: noise.numpy() for camera, noise in problem.noises.items()}
        sent, links = _arrays(keyframe_tensors(new, cameras)), _arrays(link_tensors(problem.links))
        return cls(config, known, sent, cameras, links, problem.poses, SentContent.of(problem.content), noises)

    def new_keyframes(self) -> list[Keyframe]:
        """Those that were sent."""
        return list(keyframes_of(_tensors(self.keyframes), self.cameras))

    def problem(self) -> GraphProblem:
        """What was sent beside keyframes."""
        noises = {camera: torch.from_numpy(noise) for camera, noise in self.noises.items()}
        return GraphProblem(links_of(_tensors(self.links)), self.poses, self.content.content(), noises)


class Answer(NamedTuple):
    """A solution, or what failed.

    Attributes:
        content: of the graph.
        update: see `GraphUpdate`.
        features: of keyframes, by their numbers, that were looked for: nobody need do it again.
        failure: traceback of an exception; content and update are then None.
    """

    content: SentContent | None = None
    update: GraphUpdate | None = None
    features: dict[int, ImageFeatures] = {}
    failure: str | None = None

    @classmethod
    def of(cls, solution: GraphSolution, features: dict[int, ImageFeatures]) -> Answer:
        """That of a solution."""
        return cls(SentContent.of(solution.content), solution.update, features)


def _arrays(tensors: Mapping[str, torch.Tensor]) -> Arrays:
    return {name: tensor.numpy() for name, tensor in tensors.items()}


def _tensors(arrays: Arrays) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(array) for name, array in arrays.items()}
