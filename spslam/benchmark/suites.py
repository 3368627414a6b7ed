"""What is run: suites of sequences and variants, read from `data/suites/*.yaml`.

Each study of a suite runs every variant over every sequence. The suite of a dataset has one study, whose variants are
presets and the baselines; the ablation has one study per question.
"""

from __future__ import annotations

import importlib.resources
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from spslam.errors import ConfigError

GICP = "gicp"
ORB_SLAM3 = "orb_slam3"
SPSLAM = "spslam"
PAPER_SEEDS = 5
DATASET_COLUMNS = (
    "frames", "ate_rmse_cm", "ate_live_cm", "rpe_cm", "rpe_deg", "lost_frames", "fps", "tracking_ms_per_iteration",
    "tracking_iterations", "mapping_ms_per_iteration", "mapping_iterations", "model_mb", "peak_gpu_mb", "peak_rss_mb",
    "accuracy_cm", "completeness_cm", "accuracy_5cm", "completeness_5cm", "f1_5cm", "f1_1cm", "depth_l1_cm",
    "psnr_db", "ssim",
)  # fmt: skip


@dataclass(frozen=True)
class Sequence:
    """Frames to run over.

    Attributes:
        name: of the sequence.
        config: name of a shipped configuration.
        folders: where the data may be below the data root, in order of preference; empty for generated data.
        meshes: where the ground-truth surface may be, relative to the root; `{folder}` stands for the folder found.
        options: changes to the configuration, pairs of `section.key` and value.
        frames: `START:STOP[:STEP]`; None for all.
    """

    name: str
    config: str
    folders: tuple[str, ...] = ()
    meshes: tuple[str, ...] = ()
    options: tuple[tuple[str, Any], ...] = ()
    frames: str | None = None


@dataclass(frozen=True)
class Variant:
    """A way to run a sequence: a preset with changed options, or a baseline.

    Attributes:
        name: of the variant.
        method: `SPSLAM`, `GICP` or `ORB_SLAM3`.
        preset: name of a preset; None for the default one.
        options: changes to the configuration, or the baseline's options.
        series: line of the plot that the variant belongs to.
        x: its place on the plot's axis; None in a study without plots.
    """

    name: str
    method: str = SPSLAM
    preset: str | None = None
    options: tuple[tuple[str, Any], ...] = ()
    series: str = ""
    x: float | None = None


@dataclass(frozen=True)
class Study:
    """One question to the data: every variant is run over every sequence.

    Attributes:
        name: of the study.
        title: of its table.
        note: printed above the table.
        sequences: what is run over.
        variants: how it is run.
        columns: figures in the table.
        x_label: label of the plots' axis.
        x_log: whether that axis is logarithmic.
        plots: figures to plot over it.
    """

    name: str
    title: str
    note: str
    sequences: tuple[Sequence, ...]
    variants: tuple[Variant, ...]
    columns: tuple[str, ...]
    x_label: str = ""
    x_log: bool = False
    plots: tuple[str, ...] = ()


@dataclass(frozen=True)
class Suite:
    """A named set of studies.

    Attributes:
        name: of the suite.
        title: of its report.
        seeds: number of runs of each variant, with seeds 0, 1, ...
        studies: the studies.
        published: key of the paper's figures; None where the paper has none.
    """

    name: str
    title: str
    seeds: int
    studies: tuple[Study, ...]
    published: str | None = None


def suite_names() -> list[str]:
    """Names of the suites."""
    return sorted(path.stem for path in _folder().glob("*.yaml"))


def load_suite(
    name: str,
    presets: Iterable[str] | None = None,
    sequences: Iterable[str] | None = None,
    studies: Iterable[str] | None = None,
    frames: str | None = None,
    seeds: int | None = None,
    baseline: bool = True,
) -> Suite:
    """Loads a suite, or a part of it.

    Args:
        name: one of `suite_names`.
        presets: instead of the suite's own. No effect on the ablation, whose variants name theirs.
        sequences: names of the sequences to run; None for all.
        studies: names of the studies to run; None for all.
        frames: `START:STOP[:STEP]` instead of the sequences' own.
        seeds: number of runs of each variant; None for the suite's own number (5 by default, as in the paper).
        baseline: whether to run the baselines, ORB-SLAM3 and GICP odometry.

    Raises:
        ConfigError: a name is unknown; the message lists the known ones.
    """
    if name not in suite_names():
        raise ConfigError(f"suite must be one of {', '.join(suite_names())}, got {name}")
    content = yaml.safe_load((_folder() / f"{name}.yaml").read_text(encoding="utf-8"))
    chosen = _choose("sequence", sequences, {key: _sequence(key, item, content) for key, item in _sequences(content)})
    if frames is not None:
        chosen = [replace(sequence, frames=frames) for sequence in chosen]
    return Suite(
        name,
        content["title"],
        seeds or content.get("seeds", PAPER_SEEDS),
        tuple(_studies(content, tuple(chosen), presets, studies, baseline)),
        content.get("published"),
    )


def _folder() -> Path:
    return Path(str(importlib.resources.files("spslam.benchmark"))) / "data" / "suites"


def _sequences(content: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    return list(content["sequences"].items())


def _sequence(name: str, item: dict[str, Any], content: dict[str, Any]) -> Sequence:
    named = {key: tuple(text.replace("{name}", name) for text in item.get(key, ())) for key in ("folders", "meshes")}
    return Sequence(
        name,
        item["config"] if "config" in item else content["config"],
        named["folders"],
        named["meshes"],
        tuple(item.get("options", {}).items()),
        item.get("frames"),
    )


def _choose(what: str, wanted: Iterable[str] | None, known: dict[str, Any]) -> list[Any]:
    if wanted is None:
        return list(known.values())
    wanted = list(wanted)
    for name in wanted:
        if name not in known:
            raise ConfigError(f"{what} must be one of {', '.join(known)}, got {name}")
    return [item for name, item in known.items() if name in wanted]


def _studies(
    content: dict[str, Any],
    sequences: tuple[Sequence, ...],
    presets: Iterable[str] | None,
    wanted: Iterable[str] | None,
    baseline: bool,
) -> Iterator[Study]:
    if "studies" in content:
        for name, item in _choose("study", wanted, {key: (key, item) for key, item in content["studies"].items()}):
            yield _study(name, item, sequences)
        return
    if wanted is not None:
        _choose("study", wanted, {"all": None})
    variants = [Variant(f"spslam {preset}", preset=preset) for preset in presets or content["presets"]]
    if baseline:
        variants.append(Variant("ORB-SLAM3", ORB_SLAM3))
        variants += [_gicp(voxel_m) for voxel_m in content["baseline_voxels_m"]]
    yield Study("all", content["title"], "", sequences, tuple(variants), DATASET_COLUMNS)


def _gicp(voxel_m: float) -> Variant:
    return Variant(f"GICP odometry, {100 * voxel_m:g} cm", GICP, options=(("voxel_m", voxel_m),))


def _study(name: str, item: dict[str, Any], sequences: tuple[Sequence, ...]) -> Study:
    axis = item.get("x", {})
    return Study(
        name,
        item["title"],
        item.get("note", ""),
        sequences,
        tuple(_variants(item["variants"], axis)),
        tuple(item["columns"]),
        axis.get("label", ""),
        axis.get("log", False),
        tuple(item.get("plots", ())),
    )


def _variants(items: dict[str, dict[str, Any]], axis: dict[str, Any]) -> Iterator[Variant]:
    for series, item in items.items():
        changes = dict(item)
        preset = changes.pop("preset", None)
        if not axis:
            yield Variant(series, preset=preset, options=tuple(changes.items()), series=series)
        for value in axis.get("values", ()):
            options = {**changes, **dict.fromkeys(axis["options"], value)}
            name = f"{series}, {axis['label']} {value:g}"
            yield Variant(name, preset=preset, options=tuple(options.items()), series=series, x=float(value))
