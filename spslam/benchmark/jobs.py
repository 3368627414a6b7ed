"""From a suite and a folder of data to single runs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from spslam.benchmark.gicp import gicp_off_reason
from spslam.benchmark.suites import GICP, SPSLAM, Sequence, Suite, Variant
from spslam.config import Config, config_names, load_config
from spslam.prior.encoder import shipped_weights
from spslam.slam.checkpoint import fingerprint

GENERATED = "generated"


@dataclass(frozen=True)
class Job:
    """One run of one variant over one sequence, as plain values.

    Attributes
    ----------
    sequence : short name.
    config, preset, options : of the run; ``options`` are pairs of ``section.key`` and value.
    method, method_options : ``spslam``, or ``gicp`` with its own options.
    seed : of the run.
    frames : ``START:STOP[:STEP]`` or None for all.
    device : ``cpu`` or ``cuda``.
    data, mesh : folder of the data and file of the true surface, None where there is none.
    thorough : evaluate as in the paper, with depth from novel views and pictures of the map, which takes longer than a
        short run does; else a fifth of the points are compared, and no views.
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

    def key(self) -> str:
        """Name of the run's record: what decides on its figures, readable first, then a hash of all of it.

        Settings count as resolved and weights by content, so that a changed preset or retrained prior is another run;
        where the data lies doesn't count.
        """
        content = {
            "settings": fingerprint(self.load_config()),
            "options": self.method_options,
            "weights": _weights_hash(self.load_config()) if self.method == SPSLAM else "",
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
        """As `from_json` reads it."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Job:
        """What `to_json` wrote."""
        values = json.loads(text)
        pairs = {name: tuple((key, value) for key, value in values[name]) for name in ("options", "method_options")}
        return cls(**{**values, **pairs})


@dataclass(frozen=True)
class Plan:
    """What a suite asks for on a machine.

    Attributes
    ----------
    jobs : every run by its key; runs that several studies ask for are there once.
    cells : keys of the runs behind (study, sequence, variant).
    skipped : sequences and variants that aren't run, and why.
    """

    jobs: dict[str, Job]
    cells: dict[tuple[str, str, str], tuple[str, ...]]
    skipped: dict[str, str]


def make_plan(suite: Suite, data: Path | None, device: str) -> Plan:
    """The runs of a suite over the data that is there.

    Parameters
    ----------
    suite : what to run.
    data : folder that holds the data sets; None if only generated data is wanted.
    device : ``cpu`` or ``cuda``.

    Raises
    ------
    ConfigError
        An option of a variant isn't one.
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
                if variant.method == GICP and (reason := gicp_off_reason()):
                    skipped[variant.name] = reason
                    continue
                job = replace(_job(sequence, variant, folder, data, device), thorough="psnr_db" in study.columns)
                wanted = {seeded.key(): seeded for seeded in _seeded(job, suite.seeds)}
                jobs |= wanted
                cells[study.name, sequence.name, variant.name] = tuple(wanted)
    return Plan(jobs, cells, skipped)


def _job(sequence: Sequence, variant: Variant, folder: Path | None, data: Path | None, device: str) -> Job:
    mesh, ours = _find_mesh(sequence, folder, data), variant.method == SPSLAM
    return Job(
        sequence=sequence.name,
        config=sequence.config,
        preset=variant.preset,
        options=(*sequence.options, *variant.options) if ours else sequence.options,
        method=variant.method,
        method_options=() if ours else variant.options,
        seed=0,
        frames=sequence.frames,
        device=device if ours else "cpu",
        data=None if folder is None else str(folder),
        mesh=None if mesh is None else str(mesh),
        thorough=False,
    )


def _seeded(job: Job, seeds: int) -> Iterator[Job]:
    """The job with each seed; a baseline draws nothing, and is run once."""
    for seed in range(seeds if job.method == SPSLAM else 1):
        yield replace(job, seed=seed)


def _locate(sequence: Sequence, data: Path | None) -> tuple[Path | None, str]:
    """The sequence's folder, or why it can't be run."""
    if sequence.config not in config_names():
        return None, f"there is no configuration {sequence.config}"
    if not sequence.folders:
        return None, ""
    if data is None:
        return None, "no --data given"
    for candidate in sequence.folders:
        if (data / candidate).is_dir():
            return (data / candidate).resolve(), ""
    return None, f"none of {', '.join(sequence.folders)} in {data}"


def _find_mesh(sequence: Sequence, folder: Path | None, data: Path | None) -> Path | None:
    if folder is None or data is None:
        return None
    for candidate in sequence.meshes:
        # An absolute path stays as it is.
        path = data / candidate.replace("{folder}", str(folder))
        if path.is_file():
            return path.resolve()
    return None


def _weights_hash(config: Config) -> str:
    path = Path(config.prior.weights) if config.prior.weights else shipped_weights(config.prior.neighborhood)
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16] if path.is_file() else ""
