"""CUDA graphs that whole-call ops keep from call to call."""

import weakref

import torch

from spslam.ops import _library


class LaunchGraph:
    """The CUDA graph of one op at one place of a program; nothing on the CPU.

    An op that is given one runs its whole call as one graph. It is built in the first call and when the shape of a call
    changes (iterations, rays, precision); other arguments, grown tensors among them, are brought up to date in it. One
    graph is for one thread at a time. It is freed with this object.
    """

    def __init__(self) -> None:
        self._number = 0

    def number(self, device: torch.device) -> int:
        """The number that names it to an op on `device`; 0 where that is not CUDA."""
        if device.type != "cuda":
            return 0
        if self._number == 0:
            if _library.CUDA_OFF_REASON is not None:
                raise RuntimeError(f"LaunchGraph: {_library.CUDA_OFF_REASON}")
            self._number = torch.ops.spslam.new_launch_graph()
            weakref.finalize(self, torch.ops.spslam.delete_launch_graph, self._number)
        return self._number

    @property
    def builds(self) -> int:
        """How often the graph was built."""
        return torch.ops.spslam.launch_graph_builds(self._number) if self._number else 0
