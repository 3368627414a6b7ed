"""Asynchronous reading of frames: order, content, times and upload."""

import os

import numpy as np
import pytest
import torch

from spslam.datasets.base import RgbdFrame
from spslam.datasets.frozen_depth import FROZEN
from spslam.errors import DatasetError
from spslam.run.frame_feed import FrameFeed, automatic_workers
from spslam.slam.image_features import extract_features
from spslam.slam.pixels import sample_frame
from spslam.slam.prepared_frame import PreparedFrame
from spslam.slam.upload import Upload, Uploader
from tests.system.sequences import Recorded, settings

FRAMES = 9


def break_third(frame: RgbdFrame) -> None:
    if frame.index == 2:
        raise DatasetError("frame 2 is broken")


def pixels_of(item: PreparedFrame) -> torch.Tensor:
    received = item.pixels.received() if isinstance(item.pixels, Upload) else item.pixels
    return received.buffer.cpu()


@pytest.mark.parametrize(
    ("reader", "workers", "ahead"), [("threads", 1, 8), ("threads", 3, 8), ("process", 1, 1), ("process", 3, 4)]
)
def test_frames_come_in_order_with_their_pixels(device, reader, workers, ahead):
    options = f"run.reader={reader}", f"run.prefetch_workers={workers}", f"run.prefetch_ahead={ahead}"
    dataset, config = Recorded(FRAMES, break_third), settings(*options)
    with FrameFeed(dataset, config, device, start=1) as feed:
        items = list(feed)
        assert feed.decode_seconds > 0
    assert isinstance(items[1], DatasetError)
    prepared = items[:1] + items[2:]
    assert [item.index for item in prepared] == [1, 3, 4, 5, 6, 7, 8]
    for item in prepared:
        frame = Recorded(FRAMES)[item.index]
        assert torch.equal(pixels_of(item), sample_frame(frame, dataset.camera, config).buffer)
        assert item.timestamp == frame.timestamp
        assert item.decode_ms > 0
        assert item.wait_ms >= 0


def freeze_fourth(frame):
    break_third(frame)
    if frame.index == 4:
        frame.depth[:] = Recorded(FRAMES).frames[3].depth
        frame.color[:] = frame.color[:, ::-1]


@pytest.mark.parametrize("reader", ["threads", "process"])
def test_what_is_frozen_is_no_frame_and_features_are_of_those_processed(reader):
    """Frame 1 is the 28th processed, 3 the 29th and, as 4 is frozen, 5 the 30th, whose features are kept."""
    config = settings(f"run.reader={reader}", "run.prefetch_workers=2", "run.prefetch_ahead=8")
    dataset = Recorded(FRAMES, freeze_fourth)
    with FrameFeed(dataset, config, torch.device("cpu"), start=1, processed=28) as feed:
        items = list(feed)
    errors = [str(item) for item in items if isinstance(item, DatasetError)]
    assert len(errors) == 2 and errors[1].endswith(FROZEN)
    frames = [item for item in items if isinstance(item, PreparedFrame)]
    assert [item.index for item in frames] == [1, 3, 5, 6, 7, 8]
    assert all(item.features is None for item in frames)
    # Whoever reads position 1 takes it for the run's second frame, as nothing is known of those processed.
    assert [item.index for item in frames if item.pixels.features is not None] == [1, 5][: 1 + (reader == "process")]
    if reader == "process":
        read = sample_frame(Recorded(FRAMES)[5], dataset.camera, config)
        wanted = extract_features(read, dataset.camera, config.dataset.max_depth_m)
        assert np.array_equal(frames[2].pixels.features.descriptors, wanted.descriptors)


@pytest.mark.cuda
def test_upload_does_not_synchronize():
    dataset, config, device = Recorded(2), settings(), torch.device("cuda")
    uploader = Uploader(device)
    pixels = sample_frame(dataset[0], dataset.camera, config)
    uploader.send(pixels).received()
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        upload = uploader.send(pixels)
        received = upload.received()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert torch.equal(received.buffer.cpu(), pixels.buffer)
    assert upload.end.ms_since(upload.begin) > 0


@pytest.mark.parametrize(
    ("cores", "kind", "workers"),
    [(1, "cpu", 2), (2, "cpu", 2), (16, "cpu", 4), (1, "cuda", 2), (64, "cuda", 16), (16, "cuda", 12)],
)
def test_number_of_threads_depends_on_cores_and_device(monkeypatch, cores, kind, workers):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(cores), raising=False)
    assert automatic_workers(torch.device(kind)) == workers
