"""A recording in chunks: the results of one run, resumed, and one line where chunks do not fit."""

import json

import numpy as np
import pytest

from spslam.config import load_config
from spslam.datasets import open_dataset
from spslam.errors import ConfigError, OutputError, SpslamError
from spslam.evaluation.run_output import RunOutput
from spslam.run.chunks import ChunkOptions, cut, run_chunks
from spslam.run.request import RunRequest
from spslam.run.sequence import run_sequence
from spslam.run_folder import RunFolder
from spslam.slam.graph.archive import KeyframeArchive
from spslam.tasks.local import LocalExecutor
from spslam.tasks.task import TaskEnd
from tests.cli.command import assert_refused, spslam
from tests.system.test_maps import SETTINGS
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
    output = tmp_path_factory.mktemp("chunks") / "run"
    run_chunks(request(output, command="spslam run places --chunks 2"), OPTIONS, InThisProcess())
    return output


def test_chunks_cover_a_recording():
    chunks = cut(1001, ChunkOptions(4, 61))
    assert [(chunk.own_begin, chunk.own_end) for chunk in chunks] == [(0, 250), (250, 500), (500, 751), (751, 1001)]
    assert [(chunk.begin, chunk.end) for chunk in chunks] == [(0, 281), (220, 531), (470, 782), (721, 1001)]
    with pytest.raises(ConfigError, match="of 300 frames in at most 4 chunks, got 5"):
        cut(300, ChunkOptions(5))
    assert len(cut(300, ChunkOptions(4))) == 4


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
    with pytest.raises(OutputError, match="with --resume"):
        run(output)
    with pytest.raises(OutputError, match="holds chunks of other options, data or frames"):
        run(output, options=ChunkOptions(2, 20), resume=True)
    run(output, resume=True, report=lambda *end: ends.append(end))
    assert [(done, total, end.key) for done, total, end in ends] == [(2, 2, "chunk-2")]
    for name in ("trajectory.txt", "map.safetensors", "keyframes.safetensors", "mesh.ply"):
        assert (output / name).read_bytes() == (joined / name).read_bytes(), name
    before = json.loads(RunFolder(output).metrics.read_text())
    assert run(output, resume=True) == before


class Broken:
    """An executor whose tasks fail, the last one that was started first."""

    slots = None

    def __init__(self):
        self.keys = []

    def prepare(self, tasks):
        pass

    def start(self, task):
        self.keys.append(task.key)

    def wait(self):
        return TaskEnd(self.keys.pop(), "out of luck")


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
    ],
)
def test_what_does_not_go_together_is_refused(tmp_path, arguments, message):
    assert_refused(spslam("run", "demo", *arguments, cwd=tmp_path), message)
