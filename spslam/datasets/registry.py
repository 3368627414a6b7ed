"""The kinds of dataset by name, and how each takes its options from a configuration.

A kind's module is imported when a dataset of it is opened: a run needs one of twenty.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from spslam.datasets.base import RgbdDataset, Subset
from spslam.datasets.mask import apply_mask
from spslam.errors import DatasetError
from spslam.options import DatasetOptions


def open_dataset(config: Any, data_dir: str | os.PathLike | None = None) -> RgbdDataset:
    """The dataset that a configuration's `dataset` section names.

    Args:
        config: any object with the attribute `type` (one of `dataset_types()`) and, each optional or None: `path`,
            `stride` (every n-th frame), `min_depth_m`, `max_depth_m` (depth outside comes as 0), `border_px` (so does
            depth this close to the image's border), `mask` (so does depth where this image is black), and the options
            of the kind: `sequence` and `registered` (7scenes), `depth_variant` (synthetic_rgbd), `depth_scale`,
            `min_confidence`, `pair_tolerance_s` and `register_to` (recordings of one's own), the fields of `RosOptions`
            (rosbag), `frames`, `width`, `height`, `noise`, `seed` (generated), and the arguments of `PlacesDataset` and
            its `Capture` (places).
        data_dir: the data's folder or file; overrides `config.path`. Not needed by `generated` and `places`.

    Raises:
        DatasetError: an unknown type, no folder given, or whatever is wrong with the data.
    """
    if config.type in _RENDERED:
        dataset = _RENDERED[config.type](config)
    elif config.type in _OPENERS:
        dataset = _OPENERS[config.type](
            config, _path(config, _option(config, "path") if data_dir is None else data_dir)
        )
    else:
        raise DatasetError(f"dataset.type must be one of {', '.join(dataset_types())}, got {config.type}")
    dataset.depth_range = (_option(config, "min_depth_m", 0.0), _option(config, "max_depth_m", float("inf")))
    dataset.border_px = _option(config, "border_px", 0)
    camera = dataset.camera
    if 2 * dataset.border_px >= min(camera.width, camera.height):
        raise DatasetError(
            f"dataset.border_px must leave some of images of {camera.width}x{camera.height}, got {dataset.border_px}"
        )
    apply_mask(dataset, _option(config, "mask"))
    dataset.scale_remedy = _SCALE_REMEDIES.get(config.type, _FIXED_SCALE.format(config.type))
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
    from spslam.datasets.seven_scenes import SPLITS, list_sequences

    split = options.sequence if options.sequence in SPLITS else None
    if options.type != "7scenes" or options.path is None or (options.sequence is not None and split is None):
        return [options]
    names = list_sequences(Path(options.path), str(split) if split else None)
    return [options.model_copy(update={"sequence": name}) for name in names] or [options]


def dataset_types() -> list[str]:
    """Names that `dataset.type` may have."""
    return [*_OPENERS, *_RENDERED]


def _open_with(module: str, opener: str, *names: str, **renamed: str) -> _Opener:
    """An opener of a module of this package, which takes options by their names, or by those of its own."""

    def open_path(config: Any, path: Path) -> RgbdDataset:
        return _load(module, opener)(path, **_given(config, names), **_given_as(config, **renamed))

    return open_path


def _open_ros_with(opener: str) -> _Opener:
    """An opener of ROS bags, which takes options as one object."""

    def open_path(config: Any, path: Path) -> RgbdDataset:
        options = _load("rosbag", "RosOptions")
        given = _given(config, [field.name for field in fields(options)])
        return _load("rosbag", opener)(path, options(**given, **_given_as(config, view="register_to")))

    return open_path


def _open_generated(config: Any) -> RgbdDataset:
    return _load("generated", "GeneratedDataset")(**_given(config, ("frames", "width", "height", "noise", "seed")))


def _open_places(config: Any) -> RgbdDataset:
    capture = _load("places", "Capture")
    captured = capture(**_given(config, [field.name for field in fields(capture)]))
    names = ("place", "motion", "sensor", "frames", "seed", "texture", "people")
    return _load("places", "PlacesDataset")(**_given(config, names), capture=captured)


def _load(module: str, name: str) -> Any:
    return getattr(importlib.import_module(f"spslam.datasets.{module}"), name)


_Opener = Callable[[Any, Path], RgbdDataset]
_OPENERS: dict[str, _Opener] = {
    "7scenes": _open_with("seven_scenes", "open_seven_scenes", "sequence", "registered"),
    "synthetic_rgbd": _open_with("synthetic_rgbd", "open_synthetic_rgbd", "depth_variant"),
    "tum": _open_with("tum", "open_tum"),
    "replica": _open_with("replica", "open_replica"),
    "scannet": _open_with("scannet", "open_scannet"),
    "folder": _open_with("folder", "open_folder", "depth_scale", "min_confidence", view="register_to"),
    "rosbag": _open_ros_with("open_rosbag"),
    "realsense": _open_ros_with("open_realsense"),
    "azure_kinect": _open_with("azure_kinect", "open_azure_kinect", tolerance_s="pair_tolerance_s", view="register_to"),
    "stray_scanner": _open_with("stray_scanner", "open_stray_scanner", "min_confidence", view="register_to"),
    "record3d": _open_with("record3d", "open_record3d", "min_confidence", view="register_to"),
    "scannetpp": _open_with("scannetpp", "open_scannetpp", view="register_to"),
    "arkitscenes": _open_with(
        "arkitscenes", "open_arkitscenes", "min_confidence", tolerance_s="pair_tolerance_s", view="register_to"
    ),
    "open3d": _open_with("open3d_recording", "open_open3d", "depth_scale", view="register_to"),
    "video": _open_with(
        "video_recording", "open_video_recording", "depth_scale", tolerance_s="pair_tolerance_s", view="register_to"
    ),
    "bonn": _open_with("tum", "open_bonn"),
    "icl_nuim": _open_with("icl_nuim", "open_icl_nuim"),
}
_RENDERED: dict[str, Callable[[Any], RgbdDataset]] = {"generated": _open_generated, "places": _open_places}


_SET_SCALE = "set dataset.depth_scale (units per meter)"
_SET_SCALE_OR_FILE = "set dataset.depth_scale (units per meter), or depth_scale in the JSON file of the intrinsics"
_TUM_SCALE = (
    "convert the depth images to 5000 units per meter, as this layout has it, or lay them out as a folder recording, "
    "which has dataset.depth_scale"
)
# Of kinds whose depth has a unit that can be set or changed; that of the others is their format's.
_SCALE_REMEDIES = {
    **dict.fromkeys(("folder", "video", "open3d"), _SET_SCALE_OR_FILE),
    **dict.fromkeys(("rosbag", "realsense"), _SET_SCALE),
    **dict.fromkeys(("tum", "bonn", "icl_nuim"), _TUM_SCALE),
    "replica": "correct camera.scale (units per meter) in cam_params.json",
}
_FIXED_SCALE = "convert the depth images to the unit that the format has ({})"


def _given(config: Any, names: Sequence[str]) -> dict[str, Any]:
    options = {name: _option(config, name) for name in names}
    return {name: value for name, value in options.items() if value is not None}


def _given_as(config: Any, **renamed: str) -> dict[str, Any]:
    """The options that are given, under the names of an opener's arguments."""
    given = _given(config, list(renamed.values()))
    return {name: given[option] for name, option in renamed.items() if option in given}


def _path(config: Any, path: str | os.PathLike | None) -> Path:
    if path is None or str(path) == "":
        raise DatasetError(f"dataset.path must name the folder of the {config.type} data (--data), got none")
    return Path(path)


def _option(config: Any, name: str, default: Any = None) -> Any:
    value = getattr(config, name, None)
    return default if value is None else value
