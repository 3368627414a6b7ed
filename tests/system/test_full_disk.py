"""A disk that is full at any output: one line names the file, nothing is half-written, and the run can be continued."""

import contextlib
import os
import subprocess

import pytest

from spslam.errors import OutputError
from spslam.run_folder import RunFolder
from tests.system.sequences import Recorded, results, run_on

FRAMES = 4
PAGE = 4096
SETTINGS = ("run.checkpoint_every=2", "run.previews=1", "mesh.resolution_m=0.1")


@pytest.fixture
def disk(tmp_path):
    """Mounts an empty file system of so many bytes, and returns its folder."""
    folder = tmp_path / "disk"
    folder.mkdir()

    def mount(size):
        subprocess.run(["umount", folder], check=False, capture_output=True)
        made = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", folder], check=False, capture_output=True
        )
        if made.returncode:
            pytest.skip("may not mount a file system")
        return folder

    if os.geteuid():
        pytest.skip("may not mount a file system")
    yield mount
    subprocess.run(["umount", folder], check=False, capture_output=True)


def pages(path):
    return -(-path.stat().st_size // PAGE)


def outputs(path):
    """The files of a run in the order in which they are written."""
    folder = RunFolder(path)
    first = [folder.config, folder.log, folder.trajectory, folder.map, folder.keyframes, folder.mesh, folder.metrics]
    return [*first, folder.preview_camera, *sorted(folder.previews.glob("*.png")), folder.report]


@pytest.mark.slow
def test_every_output_is_named_when_the_disk_is_full(monkeypatch, tmp_path, disk):
    """The disk holds all files before one of them, and at most half of that."""
    whole = tmp_path / "whole"
    run_on(monkeypatch, Recorded(FRAMES), whole, *SETTINGS, mesh=True)
    named, room = set(), 0
    for path in outputs(whole):
        out = disk((1 + room + pages(path) // 2) * PAGE) / "out"
        (out.parent / "filler").write_bytes(bytes(PAGE))  # a size of 0 would be no limit
        # Checkpoints would take the room of what is written after them.
        with pytest.raises(OutputError, match="can't be written: .*[Nn]o space left on device") as error:
            run_on(monkeypatch, Recorded(FRAMES), out, *SETTINGS[1:], "run.checkpoint_every=0", mesh=True)
        named.add(str(error.value).partition(":")[0].rpartition("/")[2])
        assert not [left for left in out.rglob("*") if ".tmp" in left.name]
        room += pages(path)
    assert {"config.yaml", "log.jsonl", "map.safetensors", "mesh.ply", "report.html"} <= named
    assert any(name.endswith(".png") for name in named)


def test_a_run_goes_on_when_there_is_room_again(monkeypatch, tmp_path, disk):
    run_on(monkeypatch, Recorded(FRAMES), tmp_path / "whole", *SETTINGS)
    out = disk(2**25) / "out"
    filler = out.parent / "filler"

    def fill(done, total, report):
        if done == FRAMES - 1:  # after the checkpoint
            with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
                while file.write(bytes(PAGE)):
                    pass

    with pytest.raises(OutputError, match="can't be written: .*[Nn]o space left on device"):
        run_on(monkeypatch, Recorded(FRAMES), out, *SETTINGS, progress=fill)
    filler.unlink()
    run_on(monkeypatch, Recorded(FRAMES), out, *SETTINGS, resume=True)
    assert results(out) == results(tmp_path / "whole")
