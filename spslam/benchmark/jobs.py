"""The single runs of a suite, over the data that is there."""

from __future__ import annotations

import functools
import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from spslam.benchmark.gicp import gicp_off_reason
from spslam.benchmark.orb_slam3 import orb_slam3_off_reason, orb_vocabulary
from spslam.benchmark.suites import GICP, ORB_SLAM3, SPSLAM, Sequence, Suite, Variant
from spslam.config import Config, config_names, load_config
from spslam.prior.encoder import shipped_weights
from spslam.slam.checkpoint import fingerprint


@dataclass(frozen=True)
class Job:
    """One run of one variant over one sequence, as plain values.

    Attributes:
        sequence: name of the sequence.
        config: name of the configuration.
        preset: name of the preset; None for the default one.
        options: changes to the configuration, pairs of `section.key` and value.
        method: `spslam`, `gicp` or `orb_slam3`.
        method_options: options of the baseline, pairs of name and value.
        seed: of the run.
        frames: `START:STOP[:STEP]`; None for all.
        device: `cpu` or `cuda`.
        data: folder of the data; None for generated data.
        mesh: file of the ground-truth surface; None where there is none.
        thorough: evaluate as in the paper, with depth from novel views and rendered views of the map, which takes
            longer than a short run. Otherwise a fifth of the surface points is compared, and no views.
    """

    sequence: str
    config: str
    preset: str | None
    options: tuple[tuple[str, Any], ...]
    method: str
    method_options: tuple[tuple[str, Any], ...]
    seed: int
    frames: str | None
    device: str
    data: str | None
    mesh: str | None
    thorough: bool

    def load_config(self) -> Config:
        """The resolved configuration; raises ConfigError."""
        changes = [*self.options, ("seed", self.seed), ("device", self.device)]
        if self.data is not None:
            changes.append(("dataset.path", self.data))
        return load_config(self.config, self.preset, changes)

    def weights(self) -> str | None:
        """Absolute path of `prior.weights`, if the method reads them; None for the shipped ones."""
        weights = self.load_config().prior.weights if self.method == SPSLAM else None
        return None if weights is None else str(Path(weights).resolve())

    def key(self) -> str:
        """Name of the run's record: readable words, then a hash of all that its figures depend on.

        The hash is over resolved options and the content of the prior's weights, so a changed preset or a retrained
        prior gives another key, as does another vocabulary of ORB-SLAM3. Where the data is stored does not count.
        """
        config = self.load_config()
        content = {
            "settings": fingerprint(config),
            # Left out of the fingerprint, as trajectories do not depend on them; meshes, times and memory do.
            "outputs": {name: getattr(config, name).model_dump(mode="json") for name in ("mesh", "run", "scene")},
            "options": self.method_options,
            "weights": _weights_hash(self),
            "sequence": self.sequence,
            "method": self.method,
            "frames": self.frames,
            "device": self.device,
            "mesh": self.mesh is not None,
            "thorough": self.thorough,
        }
        digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:12]
        words = (self.sequence, self.method if self.method != SPSLAM else self.preset or "balanced")
        return f"{'-'.join(words)}-seed{self.seed}-{digest}".replace("/", "_").replace(" ", "_")

    def to_json(self) -> str:
        """The job as text."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Job:
        """The job of a text by `to_json`."""
        values = json.loads(text)
        pairs = {name: tuple((key, value) for key, value in values[name]) for name in ("options", "method_options")}
        return cls(**{**values, **pairs})


@dataclass(frozen=True)
class Plan:
    """The runs of a suite on this machine.

    Attributes:
        jobs: all runs by key; a run that several studies need is listed once.
        cells: keys of the runs of each (study, sequence, variant).
        skipped: sequences and variants that can't be run, and why.
    """

    jobs: dict[str, Job]
    cells: dict[tuple[str, str, str], tuple[str, ...]]
    skipped: dict[str, str]


def make_plan(suite: Suite, data: Path | None, device: str) -> Plan:
    """Plans the runs of a suite over the data that is there.

    Args:
        suite: what to run.
        data: folder that holds the datasets; None to run over generated data only.
        device: `cpu` or `cuda`.

    Raises:
        ConfigError: an option of a variant does not exist.
    """
    jobs: dict[str, Job] = {}
    cells: dict[tuple[str, str, str], tuple[str, ...]] = {}
    skipped: dict[str, str] = {}
    for study in suite.studies:
        for sequence in study.sequences:
            folder, reason = _locate(sequence, data)
            if reason:
                skipped[sequence.name] = reason
                continue
            for variant in study.variants:
                if reason := _off_reason(variant.method):
                    skipped[variant.name] = reason
                    continue
                job = replace(_job(sequence, variant, folder, data, device), thorough="psnr_db" in study.columns)
                wanted = {seeded.key(): seeded for seeded in _seeded(job, suite.seeds)}
                jobs |= wanted
                cells[study.name, sequence.name, variant.name] = tuple(wanted)
    return Plan(jobs, cells, skipped)


def _job(sequence: Sequence, variant: Variant, folder: Path | None, data: Path | None, device: str) -> Job:
    mesh, is_spslam = _find_mesh(sequence, folder, data), variant.method == SPSLAM
    return Job(
        sequence=sequence.name,
        config=sequence.config,
        preset=variant.preset,
        options=(*sequence.options, *variant.options) if is_spslam else sequence.options,
        method=variant.method,
        method_options=() if is_spslam else variant.options,
        seed=0,
        frames=sequence.frames,
        device=device if is_spslam else "cpu",
        data=None if folder is None else str(folder),
        mesh=None if mesh is None else str(mesh),
        thorough=False,
    )


def _seeded(job: Job, seeds: int) -> Iterator[Job]:
    """The job with each seed; GICP is deterministic and run once, ORB-SLAM3 has no seed but differs from run to run."""
    for seed in range(1 if job.method == GICP else seeds):
        yield replace(job, seed=seed)


def _locate(sequence: Sequence, data: Path | None) -> tuple[Path | None, str]:
    """The sequence's folder (None for generated data), or why it can't be run."""
    if sequence.config not in config_names():
        return None, f"there is no configuration {sequence.config}"
    if not sequence.folders:
        return None, ""
    if data is None:
        return None, "no --data given"
    for candidate in sequence.folders:
        if (data / candidate).is_dir():
            return Path(os.path.abspath(data / candidate)), ""  # not what a link leads to: its name may tell the camera
    return None, f"none of {', '.join(sequence.folders)} in {data}; --folders FILE names other folders"


def _find_mesh(sequence: Sequence, folder: Path | None, data: Path | None) -> Path | None:
    if folder is None or data is None:
        return None
    for candidate in sequence.meshes:
        # An absolute path stays as it is.
        path = data / candidate.replace("{folder}", str(folder))
        if path.is_file():
            return path.resolve()
    return None


def _off_reason(method: str) -> str:
    reasons = {GICP: gicp_off_reason, ORB_SLAM3: orb_slam3_off_reason}
    return reasons[method]() if method in reasons else ""


def _weights_hash(job: Job) -> str:
    """Hash of the file with what a method learned from other data; empty without one."""
    if job.method == SPSLAM:
        prior = job.load_config().prior
        return _file_hash(Path(prior.weights) if prior.weights else shipped_weights(prior.neighborhood))
    vocabulary = orb_vocabulary() if job.method == ORB_SLAM3 else None
    return _vocabulary_hash(vocabulary) if vocabulary else ""


def _file_hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16] if path.is_file() else ""


# The official vocabulary has 139 MB, and every run of a plan asks.
_vocabulary_hash = functools.cache(_file_hash)
