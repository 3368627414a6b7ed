"""What `spslam import` leaves where it is ended, and how it stores depth."""

import json
import os
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest

from spslam.datasets import import_folder
from spslam.datasets.base import Subset
from spslam.datasets.folder import open_folder
from spslam.datasets.generated import GeneratedDataset
from tests.cli.command import ROOT

ENDED = """
import os, signal, sys
from spslam.datasets import import_folder
from spslam.datasets.generated import GeneratedDataset

def end(done):
    os.kill(os.getpid(), int(sys.argv[2]))

import_folder(GeneratedDataset(4, 32, 24), sys.argv[1], end)
"""


def ended_import(folder, number):
    command = [sys.executable, "-c", ENDED, str(folder), str(int(number))]
    return subprocess.run(command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, timeout=120).returncode


def test_the_copy_of_a_killed_import_is_removed_by_the_next(tmp_path):
    assert ended_import(tmp_path / "out", signal.SIGKILL) == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".out.") and left.name.endswith(".tmp")
    others = [tmp_path / name for name in (".out.mine.tmp", ".other.1.tmp", ".out.2.tmp.old", ".out.3.tmp")]
    for other in others[:-1]:
        other.mkdir()
    others[-1].touch()  # no folder
    import_folder(GeneratedDataset(2, 32, 24), tmp_path / "out")
    assert set(tmp_path.iterdir()) == {tmp_path / "out", *others}


def test_the_copy_of_an_import_that_goes_on_is_left_alone(tmp_path):
    began = []

    def begin_another(done):
        if not began:
            began.append(done)
            other = tmp_path / ".out.4194305.tmp"
            (own,) = tmp_path.iterdir()
            own.rename(other)  # as of another process, which still writes and holds its lock
            import_folder(GeneratedDataset(1, 32, 24), tmp_path / "out")
            assert other.is_dir()
            shutil.rmtree(tmp_path / "out")
            other.rename(own)

    import_folder(GeneratedDataset(2, 32, 24), tmp_path / "out", begin_another)
    assert began and [path.name for path in tmp_path.iterdir()] == ["out"]


def test_an_import_that_is_asked_to_end_leaves_nothing(tmp_path):
    assert ended_import(tmp_path / "out", signal.SIGTERM) == -signal.SIGTERM
    assert list(tmp_path.iterdir()) == []
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


class Deep(Subset):
    """Depth up to the farthest that the dataset allows."""

    def __init__(self, farthest_m):
        super().__init__(GeneratedDataset(1, 32, 24))
        self.depth_range = (0.1, farthest_m)

    def read(self, index):
        frame = super().read(index)
        far = self.depth_range[1] if np.isfinite(self.depth_range[1]) else 13.0
        frame.depth[:] = 1.5  # in the median, by which a folder's scale is judged
        frame.depth[0] = np.linspace(0.5, far, frame.depth.shape[1], dtype=np.float32)
        return frame


@pytest.mark.parametrize(
    ("farthest_m", "scale"),
    [(10.0, 5000), (13.1, 5000), (float("inf"), 5000), (13.2, 1000), (65.0, 1000), (80.0, 500), (1000.0, 50)],
)
def test_all_depth_that_the_dataset_allows_is_kept(tmp_path, farthest_m, scale):
    dataset = Deep(farthest_m)
    import_folder(dataset, tmp_path / "out")
    assert json.loads((tmp_path / "out" / "intrinsics.json").read_text())["depth_scale"] == scale
    np.testing.assert_allclose(open_folder(tmp_path / "out")[0].depth, dataset[0].depth, atol=0.5 / scale + 1e-4)
