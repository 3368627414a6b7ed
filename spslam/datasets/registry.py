"""The kinds of dataset by name, and how each takes its options from a configuration."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from spslam.datasets.base import RgbdDataset, Subset
from spslam.datasets.folder import open_folder
from spslam.datasets.generated import GeneratedDataset
from spslam.datasets.places import Capture, PlacesDataset
from spslam.datasets.replica import open_replica
from spslam.datasets.scannet import open_scannet
from spslam.datasets.seven_scenes import SPLITS, list_sequences, open_seven_scenes
from spslam.datasets.synthetic_rgbd import open_synthetic_rgbd
from spslam.datasets.tum import open_tum
from spslam.errors import DatasetError
from spslam.options import DatasetOptions


def open_dataset(config: Any, data_dir: str | os.PathLike | None = None) -> RgbdDataset:
    """The dataset that a configuration's `dataset` section names.

    Args:
        config: any object with the attribute `type` (one of `dataset_types()`) and, each optional or None: `path`,
            `stride` (every n-th frame), `min_depth_m`, `max_depth_m` (depth outside comes as 0), `border_px` (so does
            depth this close to the image's border), and the options of the kind: `sequence` (7scenes), `depth_variant`
            (synthetic_rgbd), `depth_scale` (folder), `frames`, `width`, `height`, `noise`, `seed` (generated), and
            the arguments of `PlacesDataset` and its `Capture` (places).
        data_dir: the data's folder; overrides `config.path`. Not needed by `generated` and `places`.

    Raises:
        DatasetError: an unknown type, no folder given, or whatever is wrong with the data.
    """
    opener = _OPENERS.get(config.type)
    if opener is None:
        raise DatasetError(f"dataset.type must be one of {', '.join(dataset_types())}, got {config.type}")
    dataset = opener(config, _option(config, "path") if data_dir is None else data_dir)
    dataset.depth_range = (_option(config, "min_depth_m", 0.0), _option(config, "max_depth_m", float("inf")))
    dataset.border_px = _option(config, "border_px", 0)
    stride = _option(config, "stride", 1)
    return dataset if stride == 1 else Subset(dataset, step=stride)


def open_sequence(config: Any, data_dir: str | os.PathLike | None = None, frames: slice | None = None) -> RgbdDataset:
    """The frames that a run is over.

    Frames are read until one is usable, so that data without any is refused before anything is written.

    Args:
        config: see `open_dataset`.
        data_dir: see `open_dataset`.
        frames: which of the dataset's frames; all where None.

    Raises:
        DatasetError: as `open_dataset`, and when no frame is selected or none can be read.
    """
    dataset = open_dataset(config, data_dir)
    if frames is not None:
        dataset = Subset(dataset, frames.start or 0, frames.stop, frames.step or 1)
    fault = None
    for index in range(len(dataset)):
        try:
            dataset[index]
            return dataset
        except DatasetError as error:
            fault = fault or error
    raise DatasetError(f"{dataset.name}: no frame can be read; the first: {fault}")


def sequence_options(options: DatasetOptions) -> list[DatasetOptions]:
    """One section of options for each sequence of the data, where `options` leaves open which one is meant.

    Args:
        options: of a dataset.

    Returns:
        For a 7-Scenes scene of several sequences one section for each; for `sequence: train` or `test` one for each in
        TrainSplit.txt or TestSplit.txt. Everything else gives the options as they are.

    Raises:
        DatasetError: a missing folder, or a missing or malformed split file.
    """
    split = options.sequence if options.sequence in SPLITS else None
    if options.type != "7scenes" or options.path is None or (options.sequence is not None and split is None):
        return [options]
    names = list_sequences(Path(options.path), str(split) if split else None)
    return [options.model_copy(update={"sequence": name}) for name in names] or [options]


def dataset_types() -> list[str]:
    """Names that `dataset.type` may have."""
    return list(_OPENERS)


def _open_seven_scenes(config: Any, path: str | os.PathLike | None) -> RgbdDataset:
    return open_seven_scenes(_folder(config, path), _option(config, "sequence"))


def _open_synthetic_rgbd(config: Any, path: str | os.PathLike | None) -> RgbdDataset:
    return open_synthetic_rgbd(_folder(config, path), _option(config, "depth_variant"))


def _open_tum(config: Any, path: str | os.PathLike | None) -> RgbdDataset:
    return open_tum(_folder(config, path))


def _open_replica(config: Any, path: str | os.PathLike | None) -> RgbdDataset:
    return open_replica(_folder(config, path))


def _open_scannet(config: Any, path: str | os.PathLike | None) -> RgbdDataset:
    return open_scannet(_folder(config, path))


def _open_folder(config: Any, path: str | os.PathLike | None) -> RgbdDataset:
    return open_folder(_folder(config, path), _option(config, "depth_scale"))


def _open_generated(config: Any, path: str | os.PathLike | None) -> RgbdDataset:
    return GeneratedDataset(**_given(config, ("frames", "width", "height", "noise", "seed")))


def _open_places(config: Any, path: str | os.PathLike | None) -> RgbdDataset:
    capture = Capture(**_given(config, [field.name for field in fields(Capture)]))
    names = ("place", "motion", "sensor", "frames", "seed", "texture")
    return PlacesDataset(**_given(config, names), capture=capture)


_OPENERS: dict[str, Callable[[Any, str | os.PathLike | None], RgbdDataset]] = {
    "7scenes": _open_seven_scenes,
    "synthetic_rgbd": _open_synthetic_rgbd,
    "tum": _open_tum,
    "replica": _open_replica,
    "scannet": _open_scannet,
    "folder": _open_folder,
    "generated": _open_generated,
    "places": _open_places,
}


def _given(config: Any, names: Sequence[str]) -> dict[str, Any]:
    options = {name: _option(config, name) for name in names}
    return {name: value for name, value in options.items() if value is not None}


def _folder(config: Any, path: str | os.PathLike | None) -> Path:
    if path is None or str(path) == "":
        raise DatasetError(f"dataset.path must name the folder of the {config.type} data (--data), got none")
    return Path(path)


def _option(config: Any, name: str, default: Any = None) -> Any:
    value = getattr(config, name, None)
    return default if value is None else value
