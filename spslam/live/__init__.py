"""Live input: frames from a camera as they come, tracked and mapped at the camera's rate."""

from spslam.live.frame_queue import FrameQueue
from spslam.live.recorder import FolderRecorder
from spslam.live.replay import ReplaySource
from spslam.live.request import LiveRequest
from spslam.live.source import LiveFrame, LiveSource

__all__ = ["FolderRecorder", "FrameQueue", "LiveFrame", "LiveRequest", "LiveSource", "ReplaySource"]
