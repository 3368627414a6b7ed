"""Keyframes of generated places at their exact poses."""

from __future__ import annotations

import functools

import numpy as np
import torch

from spslam.config import Config, load_config
from spslam.datasets import open_sequence
from spslam.datasets.base import RgbdDataset
from spslam.geometry import compose, inverse
from spslam.slam.graph.keyframe import Keyframe
from spslam.slam.graph.keyframe_store import KeyframeStore
from spslam.slam.graph.registration import Registrar
from spslam.slam.pixels import sample_frame
from spslam.slam.state import SlamState

NOISE = torch.tensor([9e-6, 1e-6, 4e-4, 1e-2])  # 3 mm and 1 mm/m2; brightness of 2 % and a tenth of a pixel


@functools.cache
def place(name: str, frames: int, motion: str = "walking", *more: str) -> tuple[Config, RgbdDataset]:
    overrides = [f"dataset.place={name}", f"dataset.motion={motion}", f"dataset.frames={frames}", *more]
    config = load_config("places", None, overrides)
    return config, open_sequence(config.dataset)


def state_of(name: str, frames: int) -> SlamState:
    config, dataset = place(name, frames)
    return SlamState.start(config, dataset.camera, np.eye(4), None, torch.device("cpu"))


def store_of(name: str, frames: int) -> KeyframeStore:
    store = state_of(name, frames).graph
    assert store is not None
    return store


@functools.cache
def keyframes(name: str, frames: int, numbers: tuple[int, ...]) -> tuple[list[Keyframe], np.ndarray]:
    """Keyframes of these frames and their poses."""
    config, dataset = place(name, frames)
    camera = store_of(name, frames).camera
    made = [Keyframe.of(i, sample_frame(dataset[i], dataset.camera, config), camera) for i in numbers]
    return made, dataset.poses()[list(numbers)]


def registrar(keyframe: Keyframe) -> Registrar:
    return Registrar({keyframe.camera: NOISE}, 0)


def relative(poses: np.ndarray, source: int, target: int) -> np.ndarray:
    return compose(inverse(poses[target]), poses[source])
