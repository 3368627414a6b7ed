"""What the processes run that read images for a `SharedOutDataset`: one forks the others. Does not import torch."""

import contextlib
import mmap
import multiprocessing
import pickle
import traceback
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any

import cv2
import numpy as np

from spslam.datasets.base import RgbdDataset
from spslam.errors import DatasetError
from spslam.helper_process import DISCONNECTED
from spslam.run.image_readers import FRAME_REQUEST, ImageWork, images_in


def serve(socket: int, shared: int, *sockets: int) -> None:
    """Main function of the first process: receives the work and forks a process for each further connection.

    Args:
        socket: file descriptor of the connection to the process that wants frames.
        shared: file descriptor of the memory that frames are left in.
        sockets: file descriptors of the connections that frames are asked for by.
    """
    cv2.setNumThreads(1)
    connections = [Connection(each) for each in sockets]
    with contextlib.suppress(*DISCONNECTED), Connection(socket) as connection:
        try:
            work: ImageWork = pickle.loads(connection.recv_bytes())
        except (AttributeError, ImportError):  # the dataset's class can't be imported here
            connection.send(False)
            return
        memory = np.frombuffer(mmap.mmap(shared, 0), np.uint8)
        context = multiprocessing.get_context("fork")
        try:
            for number, own in enumerate(connections[: work.readers]):
                others = [connection, *(other for other in connections if other is not own)]
                images = images_in(memory, number, work)
                context.Process(target=_read, args=(work.dataset, own, images, others), daemon=True).start()
        except OSError:  # no more processes, or no memory for them: threads need neither
            connection.send(False)
            return
        for own in connections:  # else nobody would notice that a process has ended
            own.close()
        connection.send(True)
        while True:
            connection.recv_bytes()  # until it is closed; those forked end then, as they are daemons


def _read(
    dataset: RgbdDataset, connection: Connection, images: Sequence[np.ndarray], others: Sequence[Connection]
) -> None:
    """What a forked process does until its connection is closed."""
    for other in others:
        other.close()
    # What is forked gets its memory page by page: its first frame would take ten times as long as the next.
    _answer(dataset, FRAME_REQUEST, 0, images)
    with contextlib.suppress(*DISCONNECTED):
        while True:
            request = connection.recv_bytes()
            connection.send(_answer(dataset, request[:1], int.from_bytes(request[1:], "little"), images))


def _answer(
    dataset: RgbdDataset, kind: bytes, index: int, images: Sequence[np.ndarray]
) -> tuple[dict[str, Any] | None, str | None]:
    """What is said of a frame, whose images are left in memory: its other attributes, None if that can't be done, so
    that whoever asks reads it and sees why; and what went wrong that is not the data's fault."""
    depth, color = images
    try:
        if kind != FRAME_REQUEST:
            depth[:] = dataset.depth(index)
            return {}, None
        frame = dataset[index]
        if frame.depth.shape != depth.shape or frame.color.shape != color.shape:
            return None, None
        depth[:], color[:] = frame.depth, frame.color
    except DatasetError:
        return None, None
    except Exception:
        return None, traceback.format_exc()
    return {name: getattr(frame, name) for name in ("index", "timestamp", "pose", "offsets")}, None
