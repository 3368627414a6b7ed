"""A recording in chunks: the results of one run, resumed, and one line where chunks do not fit."""

import json
import shutil

import numpy as np
import pytest

from spslam.config import load_config
from spslam.datasets import open_dataset, registry
from spslam.errors import ConfigError, OutputError, SpslamError
from spslam.evaluation.run_output import RunOutput
from spslam.run import chunks
from spslam.run.chunk_options import ChunkOptions
from spslam.run.chunk_results import join_chunks
from spslam.run.chunks import cut, run_chunks
from spslam.run.output_folder import OutputFolder
from spslam.run.request import RunRequest
from spslam.run.sequence import run_sequence
from spslam.run_folder import RunFolder
from spslam.slam.graph.archive import KeyframeArchive
from spslam.tasks.local import LocalExecutor
from spslam.tasks.task import TaskEnd
from spslam.trajectory import Trajectory
from tests.cli.command import assert_refused, spslam
from tests.system.sequences import settings, write_room
from tests.system.test_maps import SETTINGS
from tests.system.test_segments import Frames
from tests.tasks.examples import InThisProcess

FRAMES = slice(2, 58)
OPTIONS = ChunkOptions(2, 16)


def request(output, *overrides, **changes):
    config = load_config("places", None, [*SETTINGS, "run.previews=2", *overrides])
    return RunRequest(config, None, output, FRAMES, **changes)


def run(output, options=OPTIONS, report=None, **changes):
    with LocalExecutor(1, 2) as executor:
        return run_chunks(request(output, **changes), options, executor, report)


@pytest.fixture(scope="module")
def joined(tmp_path_factory):
    """A run in chunks; beside it, in `unjoined`, as it was before they were joined."""
    output = tmp_path_factory.mktemp("chunks") / "run"

    def join(*arguments):
        shutil.copytree(output, output.parent / "unjoined")
        return join_chunks(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chunks, "join_chunks", join)
        run_chunks(request(output, command="spslam run places --chunks 2"), OPTIONS, InThisProcess())
    return output


def assert_same_results(output, expected):
    for name in ("trajectory.txt", "map.safetensors", "keyframes.safetensors", "mesh.ply"):
        assert (output / name).read_bytes() == (expected / name).read_bytes(), name


def test_chunks_cover_a_recording():
    found = cut(1001, ChunkOptions(4, 61))
    assert [(chunk.own_begin, chunk.own_end) for chunk in found] == [(0, 250), (250, 500), (500, 751), (751, 1001)]
    assert [(chunk.begin, chunk.end) for chunk in found] == [(0, 281), (220, 531), (470, 782), (721, 1001)]
    with pytest.raises(ConfigError, match="of 300 frames in at most 4 chunks, got 5"):
        cut(300, ChunkOptions(5))
    assert len(cut(300, ChunkOptions(4))) == 4


@pytest.mark.parametrize(("choice", "later"), [("stop", "warn"), ("warn", "warn"), ("skip", "skip")])
def test_later_chunks_look_at_their_first_frames_but_do_not_stop(tmp_path, choice, later):
    executor = Broken()
    with pytest.raises(SpslamError, match="2 of 2 chunks failed"):
        run_chunks(request(tmp_path / "run", f"run.data_check={choice}"), OPTIONS, executor)
    found = {task.key: task.arguments["config"]["run"]["data_check"] for task in executor.started}
    assert found == {"chunk-1": choice, "chunk-2": later}


def test_chunks_read_the_recording_under_the_name_that_was_given(tmp_path):
    """By which the camera of some is known, such as freiburg1."""
    link, executor = tmp_path / "named", Broken()
    link.symlink_to(write_room(tmp_path / "stored", 12))
    with pytest.raises(SpslamError, match="2 of 2 chunks failed"):
        run_chunks(RunRequest(load_config("7scenes"), link, tmp_path / "run"), ChunkOptions(2, 4), executor)
    assert {task.arguments["data"] for task in executor.started} == {str(link)}


def test_results_are_those_of_one_run(joined, tmp_path):
    one_piece = run_sequence(request(tmp_path / "one", mesh=False))
    output = RunOutput.read(joined)
    metrics, frames = output.metrics, FRAMES.stop - FRAMES.start
    assert metrics["frames"] == metrics["mesh_frames"] == frames == len(output.trajectory)
    assert metrics["chunks"] == 2 and metrics["chunk_frames"] == [36, 36] and metrics["lost_frames"] == 0
    assert metrics["ate_rmse_cm"] < max(1.5 * one_piece["ate_rmse_cm"], 0.5)
    dataset = open_dataset(request(joined).config.dataset)
    known = dataset.poses()[FRAMES]
    # In the first frame's world, without any alignment.
    assert np.abs(output.trajectory.poses[:, :3, 3] - known[:, :3, 3]).max() < 0.02
    assert [line["frame"] for line in output.log] == [line["index"] for line in output.log] == list(range(frames))
    assert np.allclose([line["timestamp"] for line in output.log], dataset.timestamps()[FRAMES])
    for name in ("mesh", "map", "report", "config", "preview_camera"):
        assert getattr(RunFolder(joined), name).is_file(), name
    assert set(one_piece) - {"start_s", "first_mapping_s"} <= set(metrics) | {"max_error_probability"}
    assert not (joined / "chunks").exists()


def test_the_map_is_that_of_one_recording(joined):
    archive = KeyframeArchive.load(RunFolder(joined).keyframes)
    assert len(archive.recordings) == 1 and (np.diff(archive.rows) > 0).all()
    half = (FRAMES.stop - FRAMES.start) // 2
    across = [edge for edge in archive.edges if (archive.rows[[edge.source, edge.target]] < half).sum() == 1]
    assert {edge.kind for edge in across} >= {"tracked", "covisible"}
    mesh = RunFolder(joined).mesh.read_bytes()
    assert spslam("mesh", joined, cwd=joined.parent).returncode == 0
    assert RunFolder(joined).mesh.read_bytes() == mesh


@pytest.mark.slow
def test_finished_chunks_are_not_run_again(joined, tmp_path):
    output, ends = tmp_path / "run", []

    def interrupt(done, total, end):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(output, report=interrupt)
    assert (output / "chunks" / "chunk-1" / "metrics.json").is_file()
    with pytest.raises(OutputError, match="continue it with --chunks 2 --overlap 16 --resume"):
        run(output)
    run(output, resume=True, report=lambda *end: ends.append(end))
    assert [(done, total, end.key) for done, total, end in ends] == [(2, 2, "chunk-2")]
    assert_same_results(output, joined)
    before = json.loads(RunFolder(output).metrics.read_text())
    assert run(output, resume=True) == before


class Broken:
    """An executor whose tasks fail, the last one that was started first."""

    slots = None

    def __init__(self):
        self.keys, self.started = [], []

    def prepare(self, tasks):
        pass

    def start(self, task):
        self.keys.append(task.key)
        self.started.append(task)

    def wait(self):
        return TaskEnd(self.keys.pop(), "out of luck")


CONTINUED = "contains an interrupted run in chunks; continue it with --chunks 2 --overlap 16 --resume, or use another"
IN_ONE_PIECE = "contains an interrupted run in one piece; continue it with --resume and without --chunks, or use"
BEFORE_CHECKPOINT = "holds a run in one piece that ended before its first checkpoint; start it over with --resume and w"


def test_interrupted_chunks_are_not_started_over(tmp_path):
    output = tmp_path / "run"
    with pytest.raises(SpslamError):
        run_chunks(request(output), OPTIONS, Broken())
    before = sorted(output.rglob("*"))
    started = []

    def stop(_request, _dataset, _runs, started_s):
        started.append(started_s)
        raise OutputError("not joined")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chunks, "_run_all", lambda *_: None)
        patch.setattr(chunks, "join_chunks", stop)
        with pytest.raises(OutputError, match="not joined"):
            run_chunks(request(output, resume=True), OPTIONS, Broken())
    assert started == [None]  # no chunk had finished, but some of the time was before: nobody knows how long it took
    for resume in (False, True):
        with pytest.raises(OutputError, match=CONTINUED):
            run_sequence(request(output, resume=resume))
        for options in (ChunkOptions(3, 16), ChunkOptions(2, 20)):
            with pytest.raises(OutputError, match=CONTINUED):
                run_chunks(request(output, resume=resume), options, Broken())
        with pytest.raises(OutputError, match="holds chunks of other options, data or frames; use another --output"):
            run_chunks(request(output, "seed=7", resume=resume), OPTIONS, Broken())
    with pytest.raises(OutputError, match=CONTINUED):
        run_chunks(request(output), OPTIONS, Broken())
    assert sorted(output.rglob("*")) == before
    RunFolder(output).chunk_plan.write_text('{"chunks": 2}')
    with pytest.raises(OutputError, match="plan.json: is damaged; use another --output"):
        run_sequence(request(output, resume=True))


def test_a_run_in_one_piece_is_not_started_over_in_chunks(tmp_path):
    folder = RunFolder(tmp_path / "run")

    def interrupt(done, *_):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_sequence(request(folder.path, "run.checkpoint_every=1", mesh=False), interrupt)
    assert folder.checkpoint.is_file()
    for resume in (False, True):
        with pytest.raises(OutputError, match=IN_ONE_PIECE):
            run_chunks(request(folder.path, resume=resume), OPTIONS, Broken())
    assert folder.checkpoint.is_file() and folder.log.is_file()
    folder.checkpoint.unlink()
    with pytest.raises(OutputError, match=BEFORE_CHECKPOINT):
        run_chunks(request(folder.path, resume=True), OPTIONS, Broken())


@pytest.mark.slow
def test_killed_while_results_are_written_it_is_resumed_to_the_same(joined, tmp_path, monkeypatch):
    folder = RunFolder(tmp_path / "run")
    shutil.copytree(joined.parent / "unjoined", folder.path)

    def kill(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(OutputFolder, "write_report", kill)
        run_chunks(request(folder.path, resume=True), OPTIONS, Broken())
    assert folder.metrics.is_file() and not folder.report.is_file() and not folder.is_finished
    metrics = run_chunks(request(folder.path, resume=True), OPTIONS, Broken())
    assert_same_results(folder.path, joined)
    assert folder.is_finished and folder.report.is_file() and not folder.chunks.exists()
    expected = json.loads(RunFolder(joined).metrics.read_text())
    assert set(expected) - set(metrics) == {"command", "wall_s", "fps"}
    # Killed while the chunks were removed, it has finished; the next start removes the rest.
    folder.chunks.mkdir()
    assert run_chunks(request(folder.path, resume=True), OPTIONS, Broken()) == json.loads(folder.metrics.read_text())
    assert not folder.chunks.exists()


class LostAndBack(Frames):
    """Frames of a known place, black ones, frames of another place, and a way back to the known one."""

    order = (*range(0, 28, 2), *[-1] * 3, *range(106, 76, -2), *range(76, -1, -3))


@pytest.mark.slow
def test_what_a_chunk_could_not_join_is_kept(monkeypatch, tmp_path):
    """The first chunk's camera is lost until its end, in the frames that both chunks share too."""
    dataset = LostAndBack()
    monkeypatch.setattr(registry, "open_dataset", lambda *_: dataset)
    config = settings("graph.new_map_after_s=0.05", "mapping.iterations=3", "graph.max_translation_m=0.08")
    whole = RunRequest(config, None, tmp_path / "run", mesh=False)
    with monkeypatch.context() as patch:
        patch.setattr(chunks.shutil, "rmtree", lambda *_, **__: None)
        metrics = run_chunks(whole, ChunkOptions(2, 8), InThisProcess())
    folder, border = RunFolder(whole.output_dir), len(dataset) // 2
    apart = json.loads(RunFolder(folder.chunks / "chunk-1").metrics.read_text())
    assert apart["unjoined_frames"] == border + 4 - 17  # counted in all of its frames
    assert metrics["unjoined_frames"] == border - 17
    assert metrics["lost_frames"] == metrics["unjoined_frames"] + 3
    assert [path.name for path in folder.segments()] == ["segment-1.txt"]
    segment = Trajectory.load_tum(folder.segment(1))
    np.testing.assert_allclose(segment.timestamps, np.arange(17, border) / 30, atol=1e-6)
    truth = dataset.truth()[17:border]
    np.testing.assert_allclose(segment.poses, np.linalg.inv(truth[0]) @ truth, atol=0.01)


def test_a_chunk_that_fails_is_named(tmp_path):
    with pytest.raises(SpslamError, match=r"2 of 2 chunks failed; the first: chunk-2 \(frames 20:56\): out of luck"):
        run_chunks(request(tmp_path / "run"), OPTIONS, Broken())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--chunks", "1"), "--chunks must be 2 at least"),
        (("--chunks", "0"), "must be a whole number of at least 1"),
        (("--chunks", "2", "--map", "x"), "--chunks makes a new map"),
        (("--chunks", "2", "--view"), "--view and --rerun show a run in one piece"),
        (("--cluster", "auto"), "--cluster needs --chunks"),
        (("--chunks", "2", "--copy-data"), "--copy-data needs --cluster"),
        (("--chunks", "9", "--frames", "0:90"), "--chunks must leave more frames in each than the 60"),
        (("--chunks", "2", "--set", "graph.enabled=false"), "--chunks needs graph.enabled=true"),
        (("--chunks", "2", "--set", "prior.enabled=false"), "--chunks needs graph.enabled=true and prior.enabled=true"),
    ],
)
def test_what_does_not_go_together_is_refused(tmp_path, arguments, message):
    assert_refused(spslam("run", "demo", *arguments, cwd=tmp_path), message)
