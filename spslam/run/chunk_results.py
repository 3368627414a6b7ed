"""The results of one run from those of its chunks: one trajectory, one map, one mesh, one report."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from spslam.config import Config
from spslam.datasets.base import RgbdDataset
from spslam.errors import DatasetError, OutputError
from spslam.evaluation.run_output import RunOutput
from spslam.geometry import compose, inverse
from spslam.io import atomic_write
from spslam.run.clock import RunClock
from spslam.run.device import explained_failures, resolve_device
from spslam.run.figures import (
    TIMING_FIGURES,
    decoding_figures,
    graph_figures,
    noise_figures,
    origin,
    scene_figures,
    timings,
    tracking_figures,
    truth_figures,
)
from spslam.run.merge import joined_state, make_map
from spslam.run.output_folder import OutputFolder
from spslam.run.recordings import source_of, write_map_mesh
from spslam.run.request import RunRequest
from spslam.run.results import RunInput, finish_results, write_segments
from spslam.run.session import identity_of
from spslam.run.threads import kernel_threads_limited, library_threads_limited
from spslam.run_folder import RunFolder
from spslam.slam.graph.archive import KeyframeArchive, Recording
from spslam.slam.graph.edges import LoopDecision
from spslam.slam.graph.joined import registrar_of
from spslam.slam.graph.parts import Part, join_parts, whole_recording
from spslam.slam.opened_map import archive_of, load_archive
from spslam.slam.state import SlamState
from spslam.trajectory import Trajectory


@dataclass(frozen=True)
class Chunk:
    """A chunk of a recording.

    Attributes:
        number: from 0.
        begin: index of its first frame.
        end: index after its last frame.
        own_begin: index of the first frame whose pose is taken from it; before are its predecessor's.
        own_end: index after the last one.
    """

    number: int
    begin: int
    end: int
    own_begin: int
    own_end: int

    @property
    def name(self) -> str:
        """Of its task and its folder; counts from 1."""
        return f"chunk-{self.number + 1}"


@dataclass(frozen=True)
class _Run:
    """The run of a chunk: its lines of log.jsonl and skipped.jsonl, metrics, map, and segments of its own frames."""

    chunk: Chunk
    log: list[dict[str, Any]]
    skipped: list[dict[str, Any]]
    metrics: dict[str, Any]
    part: Part
    segments: list[Trajectory]


def join_chunks(
    request: RunRequest, dataset: RgbdDataset, runs: Sequence[tuple[Chunk, RunFolder]], started: float | None
) -> dict[str, Any]:
    """Joins the runs of all chunks and writes the results of the whole.

    Args:
        request: of the whole.
        dataset: its frames.
        runs: the chunks in order, and the output folders of their runs.
        started: `time.perf_counter()` when the whole began; None where that was in an earlier call.

    Returns:
        What is written to metrics.json.

    Raises:
        OutputError: two chunks can't be joined, or a file can't be written.
        DatasetError: all frames are lost.
    """
    device = resolve_device(request.config.device)
    with library_threads_limited(), explained_failures(device), kernel_threads_limited(device):
        read = [_read(chunk, folder) for chunk, folder in runs]
        recording = Recording(dataset.name, source_of(request), dataset.camera, read[0].part.trajectory)
        joined = _joined(read, request.config)
        archive = whole_recording(joined, recording)
        state = joined_state(runs[0][1], archive, request.config, device)
        make_map(state, request.config)
        archive = archive_of(state, None, archive.settings)
        return _write(request, dataset, read, _Whole(state, archive, joined.decisions, started))


@dataclass(frozen=True)
class _Whole:
    """The joined map, what was decided on loops between chunks, and when the whole began."""

    state: SlamState
    archive: KeyframeArchive
    decisions: Sequence[LoopDecision]
    started: float | None

    @property
    def trajectory(self) -> Trajectory:
        return self.archive.recordings[0].trajectory


def _read(chunk: Chunk, path: RunFolder) -> _Run:
    folder = OutputFolder(path.path)
    log, archive = folder.read_log(), load_archive(folder)
    indices = chunk.begin + np.array([line["index"] for line in log], np.int64)
    if len(indices) != len(archive.recordings[0].trajectory):
        raise OutputError(f"{folder.log}: must have a line for each frame of {folder.trajectory.name}")
    metrics = json.loads(folder.metrics.read_text(encoding="utf-8"))
    part = Part(archive, indices)
    own = slice(part.row(chunk.own_begin), part.row(chunk.own_end))
    segments = own_segments(folder, own)
    return _Run(chunk, log, folder.read_skipped(), metrics, part, segments)


def own_segments(folder: RunFolder, rows: slice) -> list[Trajectory]:
    """The segments of a run, of some of its frames only: of those that are lost in its trajectory.

    Args:
        folder: of the run.
        rows: in the trajectory, of the frames that are wanted.

    Returns:
        Each in the axes of its first frame that is wanted; those without one are left out.
    """
    # Both files have the same rounded times.
    trajectory = Trajectory.load_tum(folder.trajectory)
    times = trajectory.timestamps[rows][trajectory.lost[rows]]
    found = []
    for path in folder.segments():
        segment = Trajectory.load_tum(path)
        kept = np.isin(segment.timestamps, times)
        if not kept.any():
            continue
        poses = segment.poses[kept]
        if not kept[0]:
            poses = compose(inverse(poses[0]), poses)
        found.append(Trajectory(segment.timestamps[kept], poses))
    return found


def _joined(runs: Sequence[_Run], config: Config) -> Part:
    joined = runs[0].part
    for run in runs[1:]:
        registrar = registrar_of(joined.archive, run.part.archive, config)
        found = join_parts(joined, run.part, run.chunk.own_begin, registrar)
        if isinstance(found, str):
            raise OutputError(
                f"{run.chunk.name} (frames {run.chunk.begin}:{run.chunk.end}) can't be joined with those before: "
                f"{found}; use fewer chunks, or another --overlap"
            )
        joined = found
    return joined


def _write(request: RunRequest, dataset: RgbdDataset, runs: Sequence[_Run], whole: _Whole) -> dict[str, Any]:
    folder, config = OutputFolder(Path(request.output_dir)), request.config
    trajectory, archive = whole.trajectory, whole.archive
    if trajectory.lost.all():
        raise DatasetError(f"{dataset.name}: all frames are lost in every chunk")
    log = _numbered([line for run in runs for line in _own_lines(run)])
    for decision in whole.decisions:
        log[decision.source]["loops"].append(asdict(decision))
    atomic_write(folder.log, "".join(json.dumps(line) + "\n" for line in log))
    skipped = [line for run in runs for line in _own_skipped(run)]
    if skipped:
        atomic_write(folder.skipped, "".join(json.dumps(line) + "\n" for line in skipped))
    trajectory.save_tum(folder.trajectory)
    whole.state.scene.save(folder.map)
    archive.save(folder.keyframes)
    source = RunInput.of_dataset(dataset, [line["index"] for line in log], config.run.previews)
    metrics = {
        **_metrics(request, dataset, runs, whole, log),
        **write_segments(folder, [segment for run in runs for segment in run.segments]),
        "skipped_frames": len(skipped),
        **truth_figures(trajectory, source.poses),
    }
    warnings = list(dict.fromkeys(text for run in runs for text in run.metrics.get("warnings", ())))
    if request.mesh:
        # The trajectory is the file's, so that `spslam mesh` makes the same one.
        written = replace(archive.recordings[0], trajectory=Trajectory.load_tum(folder.trajectory))
        meshed = replace(archive, recordings=[written])
        _, figures, missing = write_map_mesh(folder.mesh, whole.state.scene, meshed, config.mesh)
        metrics |= figures
        warnings += missing
    if whole.started is not None:
        wall_s = time.perf_counter() - whole.started
        metrics |= {"wall_s": wall_s, "fps": len(log) / wall_s}
    if warnings:
        metrics["warnings"] = warnings
    finish_results(RunOutput(folder, trajectory, source.poses, metrics, log, "", dataset.camera), source, config)
    return metrics


def _metrics(
    request: RunRequest, dataset: RgbdDataset, runs: Sequence[_Run], whole: _Whole, log: list[dict[str, Any]]
) -> dict[str, Any]:
    """What metrics.json says of the chunks and of their joined map."""
    scene, archive = whole.state.scene, whole.archive
    clock = RunClock(len(log), sum(run.metrics["wall_s"] * len(_own_lines(run)) / len(run.log) for run in runs))
    clock.decode_s = sum(run.metrics["decode_ms"] / 1e3 * len(_own_lines(run)) for run in runs)
    return {
        **origin(request.config, scene.device, request.command),
        "data": identity_of(dataset, request),
        "frames": len(log),
        "chunks": len(runs),
        "chunk_frames": [run.chunk.end - run.chunk.begin for run in runs],
        "chunk_wall_s": [run.metrics["wall_s"] for run in runs],
        **timings(log, clock),
        **decoding_figures(clock),
        **tracking_figures(whole.trajectory, log),
        **scene_figures(scene),
        "peak_rss_mb": max(run.metrics["peak_rss_mb"] for run in runs),
        **graph_figures(len(archive.keyframes), archive.edges),
        **noise_figures(next(iter(archive.noise.values()))),
        # As it was known at the end.
        **{name: runs[-1].metrics[name] for name in TIMING_FIGURES},
    }


def _own_lines(run: _Run) -> list[dict[str, Any]]:
    """The lines of the log of the frames whose poses are the chunk's; all frames by their indices in the recording."""
    part, begin = run.part, run.chunk.begin
    first = part.row(run.chunk.own_begin)
    lines = []
    for line in run.log[first : part.row(run.chunk.own_end)]:
        loops = [loop for loop in line["loops"] if min(loop["source"], loop["target"]) >= first]
        moved = [{**loop, **{end: int(part.indices[loop[end]]) for end in ("source", "target")}} for loop in loops]
        lines.append({**line, "index": begin + line["index"], "loops": moved})
    return lines


def _numbered(log: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The lines of a log with frames numbered as those of one run."""
    indices = [line["index"] for line in log]
    for row, line in enumerate(log):
        line["frame"] = row
        for loop in line["loops"]:
            loop |= {end: int(np.searchsorted(indices, loop[end])) for end in ("source", "target")}
    return log


def _own_skipped(run: _Run) -> list[dict[str, Any]]:
    chunk = run.chunk
    moved = [{**line, "position": chunk.begin + line["position"]} for line in run.skipped]
    return [line for line in moved if chunk.own_begin <= line["position"] < chunk.own_end]
