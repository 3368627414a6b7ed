"""Every option of a run: type, unit, range, what it does, and what other options it needs to have an effect.

Values are not defined here. `configs/defaults.yaml` holds a value for every option, a preset, a configuration file
and `--set` override some of them, and `spslam.config.load_config` merges them.
"""

from __future__ import annotations

from typing import Literal, get_args

from spslam.options.graph import GraphOptions
from spslam.options.mapping import LossOptions, MappingOptions, PixelOptions, SamplingOptions
from spslam.options.reading import DATASET_TYPES, DatasetOptions, RunOptions
from spslam.options.scene import MeshOptions, PriorOptions, SceneOptions
from spslam.options.section import Section, option
from spslam.options.tracking import TrackingOptions

PresetName = Literal["paper", "balanced", "fast"]
PRESETS: tuple[str, ...] = get_args(PresetName)

__all__ = [
    "DATASET_TYPES",
    "PRESETS",
    "Config",
    "DatasetOptions",
    "GraphOptions",
    "LossOptions",
    "MappingOptions",
    "MeshOptions",
    "PixelOptions",
    "PriorOptions",
    "RunOptions",
    "SamplingOptions",
    "SceneOptions",
    "Section",
    "TrackingOptions",
]


class Config(Section):
    """All options of a run, resolved: every one has a value."""

    preset: PresetName = option("the preset that was merged in")
    seed: int = option("seed of all random draws", ge=0, lt=2**63)
    device: str = option(
        "`cpu`, `cuda`, `cuda:N`, or `auto`: the GPU if there is one", pattern=r"^(auto|cpu|cuda(:\d+)?)$"
    )
    precision: Literal["tf32", "fp32"] = option(
        "precision of the networks' matrix products on CUDA in tracking, encoding and mapping: `tf32` uses tensor "
        "cores; the CPU always computes in `fp32`"
    )
    dataset: DatasetOptions
    scene: SceneOptions
    sampling: SamplingOptions
    loss: LossOptions
    tracking: TrackingOptions
    mapping: MappingOptions
    pixels: PixelOptions
    prior: PriorOptions
    graph: GraphOptions
    mesh: MeshOptions
    run: RunOptions
