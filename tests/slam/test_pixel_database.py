"""The pixel database: what it keeps, and that it keeps within its budget."""

import mmap
from pathlib import Path

import pytest
import torch

from spslam.errors import SpslamError
from spslam.slam.pixel_database import RECORD_BYTES, PixelDatabase


def frame(number, count):
    """Records that tell their frame and place."""
    return torch.stack([torch.full((count,), number), torch.arange(count), torch.zeros(count)], 1).int()


def budget_mb(frames, pixels):
    return frames * pixels * RECORD_BYTES / 2**20


def test_records_come_back():
    database = PixelDatabase(100, budget_mb(1000, 100))
    for number in range(40):
        database.add(frame(number, 100))
    assert database.records.shape == (40, 100, 3)
    assert all(torch.equal(database.records[number], frame(number, 100)) for number in range(40))
    assert database.has_pixels.all()


def test_a_frame_without_pixels_is_marked():
    database = PixelDatabase(100, 1)
    database.add(frame(0, 0))
    database.add(frame(1, 100))
    assert database.has_pixels.tolist() == [False, True]
    assert not database.records[0].any()


def test_with_keyframes_the_others_are_kept_until_the_next_frame():
    database = PixelDatabase(100, 1, keyframe_every=4)
    for number in range(11):
        database.add(frame(number, 100))
        kept = database.has_pixels.nonzero()[:, 0].tolist()
        assert kept == sorted({*range(0, number + 1, 4), number})
    resumed = PixelDatabase(100, 1, keyframe_every=4)
    resumed.load_state_dict(database.state_dict())
    for one in (database, resumed):
        one.add(frame(11, 100))
    assert resumed.has_pixels.tolist() == database.has_pixels.tolist()


def test_fewer_records_are_repeated_and_more_are_cut():
    database = PixelDatabase(100, 1)
    database.add(frame(0, 30))
    database.add(frame(1, 250))
    assert torch.equal(database.records[0, :, 1], torch.arange(100).int() % 30)
    assert torch.equal(database.records[1], frame(1, 250)[:100])


def test_past_the_budget_all_frames_are_thinned_alike():
    database = PixelDatabase(256, budget_mb(20, 256))
    for number in range(50):
        database.add(frame(number, 256))
        assert database.nbytes <= budget_mb(20, 256) * 2**20
    assert database.pixels_per_frame == 64
    assert all(torch.equal(database.records[number], frame(number, 64)) for number in range(50))


def test_thinning_does_not_depend_on_a_resume():
    whole, resumed = PixelDatabase(256, budget_mb(20, 256)), PixelDatabase(256, budget_mb(20, 256))
    for number in range(45):
        whole.add(frame(number, 256))
        resumed.add(frame(number, 256))
        if number % 7 == 3:
            state = {name: tensor.clone() for name, tensor in resumed.state_dict().items()}
            resumed = PixelDatabase(256, budget_mb(20, 256))
            resumed.load_state_dict(state)
        assert whole.pixels_per_frame == resumed.pixels_per_frame
    assert torch.equal(whole.records, resumed.records)
    assert torch.equal(whole.has_pixels, resumed.has_pixels)


def test_loading_copies():
    database, other = PixelDatabase(100, 1), PixelDatabase(100, 1)
    database.add(frame(3, 100))
    other.load_state_dict(database.state_dict())
    database.records.zero_()
    assert torch.equal(other.records[0], frame(3, 100))


def test_a_budget_too_small_is_refused():
    with pytest.raises(SpslamError, match=r"must hold at least one frame of 100 pixels \(0.00 MB\), got 0.001"):
        PixelDatabase(100, 0.001)
    database = PixelDatabase(64, budget_mb(3, 64))
    for number in range(3):
        database.add(frame(number, 64))
    with pytest.raises(SpslamError, match="cannot hold 4 frames of 64 pixels; raise it"):
        database.add(frame(3, 64))
    assert database.num_frames == 3


def test_adding_a_frame_moves_no_other_and_thinning_none_out_of_its_memory():
    database = PixelDatabase(256, budget_mb(200, 256))
    database.add(frame(0, 256))
    place = database.records.data_ptr()
    for number in range(1, 450):
        database.add(frame(number, 256))
        assert database.records.data_ptr() == place
    assert database.pixels_per_frame == 64
    assert torch.equal(database.records[449], frame(449, 64))


def test_without_room_for_the_whole_budget_memory_grows_with_the_frames(monkeypatch):
    whole, growing = PixelDatabase(256, budget_mb(20, 256)), PixelDatabase(256, budget_mb(20, 256))
    monkeypatch.setattr(PixelDatabase, "_reserved_budget", lambda self: None)
    for number in range(50):
        growing.add(frame(number, 256 if number % 3 else 0))
    monkeypatch.undo()
    for number in range(50):
        whole.add(frame(number, 256 if number % 3 else 0))
    assert torch.equal(whole.records, growing.records)


def test_what_is_kept_beside_the_pixels_counts_within_the_budget():
    beside = 64 * RECORD_BYTES
    database = PixelDatabase(256, budget_mb(20, 256), bytes_beside=beside)
    for number in range(40):
        database.add(frame(number, 256))
        assert database.nbytes + beside * database.num_frames <= budget_mb(20, 256) * 2**20
    assert database.pixels_per_frame == 64
    with pytest.raises(SpslamError, match="must hold at least one frame"):
        PixelDatabase(100, budget_mb(1, 150), bytes_beside=beside)


def resident_bytes():
    return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE


def test_thinning_gives_memory_back():
    database = PixelDatabase(4096, budget_mb(1000, 4096))
    content = frame(0, 4096)
    for _ in range(1000):
        database.add(content)
    full = resident_bytes()
    database.add(content)
    assert database.pixels_per_frame == 2048
    assert full - resident_bytes() > 0.4 * database.budget_bytes
    assert all(torch.equal(database.records[number], content[:2048]) for number in (0, 500, 1000))
