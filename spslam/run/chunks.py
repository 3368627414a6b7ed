"""One recording in overlapping chunks: each is a run of its own, all are tasks, and the results are joined into one."""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from spslam import ops
from spslam.config import dump_config, restore_config
from spslam.datasets import open_dataset, open_sequence
from spslam.datasets.base import RgbdDataset
from spslam.errors import ConfigError, OutputError, SpslamError
from spslam.io import atomic_write
from spslam.run.chunk_options import ChunkOptions, ChunkPlan
from spslam.run.chunk_results import Chunk, join_chunks
from spslam.run.device import resolve_device
from spslam.run.output_folder import OutputFolder
from spslam.run.provenance import provenance
from spslam.run.request import RunRequest, memory_needed_mb
from spslam.run.sequence import run_sequence
from spslam.run.session import finished_metrics, identity_of, with_absolute_path
from spslam.run_folder import RunFolder
from spslam.slam.checkpoint import fingerprint
from spslam.tasks.schedule import LOG, run_tasks
from spslam.tasks.task import Executor, Needs, Task, TaskCall, TaskEnd

Report = Callable[[int, int, TaskEnd], None]


def cut(frames: int, options: ChunkOptions) -> list[Chunk]:
    """The chunks of a recording, whose own frames are equally many up to one.

    Args:
        frames: of the recording.
        options: how it is cut.

    Raises:
        ConfigError: the chunks would be shorter than what they share.
    """
    if options.count > 1 and frames // options.count <= options.overlap:
        most = max(frames // (options.overlap + 1), 1)
        raise ConfigError(
            f"--chunks must leave more frames in each than the {options.overlap} that two share, of {frames} frames in "
            f"at most {most} chunks, got {options.count}; --overlap changes what they share"
        )
    borders = [round(number * frames / options.count) for number in range(options.count + 1)]
    before, after = options.overlap // 2, options.overlap - options.overlap // 2
    return [
        Chunk(number, max(begin - before, 0), min(end + after, frames), begin, end)
        for number, (begin, end) in enumerate(zip(borders[:-1], borders[1:], strict=True))
    ]


def run_chunks(
    request: RunRequest, options: ChunkOptions, executor: Executor, report: Report | None = None
) -> dict[str, Any]:
    """Runs SLAM over the chunks of a sequence and joins them; the output folder is that of one run.

    The runs of the chunks are in `chunks/` of the output folder until they are joined. With `request.resume`, those
    that have finished are not run again.

    Args:
        request: of the whole run; `map` must be None.
        options: how it is cut.
        executor: where the chunks are run. They are joined in this process.
        report: called with (chunks done, number of chunks, how the last one ended).

    Returns:
        What is written to metrics.json.

    Raises:
        SpslamError: as `run_sequence`; a chunk failed; or two chunks share no place.
        ConfigError: too many chunks, or a run without a keyframe graph.
    """
    if not (request.config.graph.enabled and request.config.prior.enabled):
        raise ConfigError(
            "--chunks needs graph.enabled=true and prior.enabled=true: chunks are joined by their keyframes"
        )
    dataset = open_sequence(request.config.dataset, request.data_dir, request.frames)
    chunks = cut(len(dataset), options)
    folder = OutputFolder(Path(request.output_dir))
    with folder.locked():
        finished = finished_metrics(request, dataset)
        if finished is None:
            started = time.perf_counter()
            resumed = _prepare(folder, request, dataset, options)
            _run_all(request, chunks, options, executor, report)
            runs = [(chunk, chunk_folder(request, chunk)) for chunk in chunks]
            finished = join_chunks(request, dataset, runs, None if resumed else started)
            # The run has finished when the plan is gone; what is killed before is joined again, to the same results.
            folder.chunk_plan.unlink()
        shutil.rmtree(folder.chunks, ignore_errors=True)
    return finished


def run_chunk(call: TaskCall) -> None:
    """The task of a chunk: a run over its frames, without a mesh; continues from its checkpoint if it has one.

    Args:
        call: `config` as a JSON object, `data`, `frames` as start, stop and step.

    Raises:
        SpslamError: as `run_sequence`.
    """
    config = restore_config(call.arguments["config"])
    weights = call.local(config.prior.weights)
    config = config.model_copy(update={"prior": config.prior.model_copy(update={"weights": weights})})
    data = call.local(call.arguments["data"])
    ops.set_num_threads(call.threads)
    frames = slice(*call.arguments["frames"])
    run_sequence(RunRequest(config, None if data is None else Path(data), call.output, frames, True, mesh=False))


def _prepare(folder: OutputFolder, request: RunRequest, dataset: RgbdDataset, options: ChunkOptions) -> bool:
    """Makes the locked folder ready, for new chunks or to go on with those that are there.

    Returns:
        Whether there are some: the time that this takes is then not that of the whole.

    Raises:
        OutputError: it holds something else.
    """
    plan = ChunkPlan(fingerprint(request.config), identity_of(dataset, request), options.count, options.overlap)
    found = ChunkPlan.read(folder)
    if found is None:
        _check_whole(folder)
        folder.create(request.resume)
    elif (found.settings, found.data) != (plan.settings, plan.data):
        raise OutputError(f"{folder.path}: holds chunks of other options, data or frames; use another --output")
    elif found != plan or not request.resume:
        raise found.to_be_continued(folder)
    else:
        folder.clear()  # of what was written before they were joined to the end
    device = resolve_device(request.config.device)
    config = with_absolute_path(request.config)
    atomic_write(folder.config, dump_config(config, provenance(request.config, device)))
    if found is None:
        shutil.rmtree(folder.chunks, ignore_errors=True)
        folder.chunks.mkdir()
        plan.write(folder)
    return found is not None


def _check_whole(folder: OutputFolder) -> None:
    """Raises OutputError where the folder has an interrupted run in one piece."""
    if folder.checkpoint.is_file():
        begun = "contains an interrupted run in one piece; continue it"
    elif folder.log.is_file() and not folder.metrics.is_file():
        begun = "holds a run in one piece that ended before its first checkpoint; start it over"
    else:
        return
    raise OutputError(f"{folder.path}: {begun} with --resume and without --chunks, or use another --output")


def _run_all(
    request: RunRequest, chunks: Sequence[Chunk], options: ChunkOptions, executor: Executor, report: Report | None
) -> None:
    """Runs the chunks that have not finished."""
    missing = [chunk for chunk in chunks if not chunk_folder(request, chunk).is_finished]
    by_key = {chunk.name: chunk for chunk in missing}
    tasks = [_task(request, chunk, options.device) for chunk in missing]
    done, failed = len(chunks) - len(missing), []
    log = RunFolder(Path(request.output_dir)).chunks / LOG
    with contextlib.closing(run_tasks(tasks, executor, log)) as ends:
        for end in ends:
            done += 1
            if end.error:
                chunk = by_key[end.key]
                failed.append(f"{end.key} (frames {chunk.begin}:{chunk.end}): {end.error}")
            if report:
                report(done, len(chunks), end)
    if failed:
        raise SpslamError(f"{len(failed)} of {len(chunks)} chunks failed; the first: {failed[0]}")


def _task(request: RunRequest, chunk: Chunk, device: str) -> Task:
    config = request.config
    # By a keyword, as the folder of previews has the option's name, and names of files stand in `run_folder` alone.
    changes: dict[str, dict[str, Any]] = {"run": dict(previews=0)}
    if chunk.number:
        # The first one defines the world, and what a look at the first frames finds is found there.
        if config.run.data_check == "stop":
            changes["run"]["data_check"] = "warn"
        changes["scene"] = {"first_pose": "identity"}
    values = config.model_dump(mode="json")
    for section, options in changes.items():
        values[section] |= options
    values["device"] = device
    # Not what a link leads to: its name may tell the camera.
    data = None if request.data_dir is None else os.path.abspath(request.data_dir)
    if config.prior.weights is not None:
        values["prior"]["weights"] = str(Path(config.prior.weights).resolve())
    chosen = request.frames or slice(None)
    start, step = chosen.start or 0, chosen.step or 1
    if start < 0:
        start = max(start + len(open_dataset(config.dataset, request.data_dir)), 0)
    frames = (start + chunk.begin * step, start + (chunk.end - 1) * step + 1, step)
    return Task(
        chunk.name,
        "spslam.run.chunks:run_chunk",
        {"config": values, "data": data, "frames": frames},
        chunk_folder(request, chunk).path,
        Needs(gpus=int(device == "cuda"), memory_mb=memory_needed_mb(config, mesh=False)),
        tuple(path for path in (data, values["prior"]["weights"]) if path is not None),
    )


def chunk_folder(request: RunRequest, chunk: Chunk) -> RunFolder:
    """Output folder of a chunk's run."""
    return RunFolder(RunFolder(Path(request.output_dir)).chunks / chunk.name)
