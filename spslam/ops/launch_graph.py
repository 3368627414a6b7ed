"""CUDA graphs that ops reuse from call to call."""

import weakref

import torch

from spslam.ops import _library


class LaunchGraph:
    """A CUDA graph for the calls of one op from one place in a program; has no effect on the CPU.

    An op with a launch graph runs as one graph launch. The graph is captured in the first call, and again when the
    shape of the call changes (iterations, rays, precision). All other arguments, including reallocated tensors, are
    updated in the existing graph. A graph must be used by one thread at a time. It is freed with this object.
    """

    def __init__(self) -> None:
        self._number = 0

    def number(self, device: torch.device) -> int:
        """The handle that identifies the graph to an op on `device`; 0 on the CPU."""
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
        """How often the graph was captured."""
        return torch.ops.spslam.launch_graph_builds(self._number) if self._number else 0
