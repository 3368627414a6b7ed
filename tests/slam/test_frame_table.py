"""The table of all processed frames: what it keeps as it grows, and in how much memory."""

import mmap
import subprocess
import sys
from pathlib import Path

import torch

from spslam.camera import Camera
from spslam.slam.frame_table import FrameTable


def add(table, number, thumbnail=None):
    pose = torch.tensor([1.0, 0, 0, 0, number, 0, 0])
    plain = torch.full(table.depth_thumbnails.shape[1:], float(number), dtype=torch.float16)
    table.append(pose, 0.1 * number, 2 * number, number % 3 == 0, plain if thumbnail is None else thumbnail, number)


def test_rows_stay_as_the_table_grows(device):
    table = FrameTable(Camera(64, 48, 50.0, 50.0, 31.5, 23.5), device)
    for number in range(300):
        add(table, number)
    assert len(table) == 300
    assert table.poses[:, 4].tolist() == list(range(300))
    assert table.indices.tolist() == list(range(0, 600, 2))
    assert table.lost.tolist() == [number % 3 == 0 for number in range(300)]
    assert [table.is_lost(row) for row in (0, 1, -1, -3)] == [True, False, False, True]
    assert [table.any_lost(count) for count in (1, 2, 3, 1000)] == [False, False, True, True]
    assert table.depth_time(7) == table.timestamps[7] and table.color_offset(7) == 0
    table.lost[-1] = True  # a column is the table itself
    assert table.is_lost(299) and not table.knows_speed
    assert torch.equal(table.depth_thumbnails[:, 0, 0].float().cpu(), torch.arange(300.0))


def grown_by():
    """Bytes by which the process has grown for 257 rows, with room for 512, over those of their thumbnails."""

    def resident():
        return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE

    table = FrameTable(Camera(4096, 4096, 4000.0, 4000.0, 2047.5, 2047.5))
    thumbnail = torch.ones(table.depth_thumbnails.shape[1:], dtype=torch.float16)
    before = resident()
    for number in range(257):
        add(table, number, thumbnail)
    return (resident() - before) / table.depth_thumbnails.nbytes


def test_rows_to_come_take_no_memory():
    """In a process of its own: what the allocator keeps of earlier tests is not the table's."""
    command = [sys.executable, "-c", "from tests.slam.test_frame_table import grown_by; print(grown_by())"]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True)
    # With the memory of all 512 it would be 2 times; the rest is the allocator's.
    assert float(done.stdout) < 1.3
