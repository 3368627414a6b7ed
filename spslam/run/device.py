"""The device of a run: how it is selected, and clear errors when it fails."""

import contextlib
from collections.abc import Iterator

import torch

from spslam import ops
from spslam.errors import DeviceError
from spslam.scene.device import usable_device

# What torch's allocators say, by the way they ask for memory.
_CPU_OUT_OF_MEMORY = ("not enough memory", "can't allocate memory", "Cannot allocate memory")
_LESS_MEMORY = "lower pixels.budget_mb, choose a larger scene.voxel_size_m and scene.plane_cell_m"
_CUDA_FAILED = ("CUDA error", "CUDA driver", "cudaError", "CUDA out of memory")


def resolve_device(name: str) -> torch.device:
    """The torch device of `auto`, `cpu`, `cuda` or `cuda:N`.

    Raises:
        DeviceError: the device is not available.
    """
    if name == "auto":
        name = "cpu" if ops.CUDA_OFF_REASON else "cuda"
    return usable_device(name)


@contextlib.contextmanager
def explained_failures(device: torch.device, less_memory: str = _LESS_MEMORY) -> Iterator[None]:
    """Replaces torch's errors about a failing device by one line that says what to change.

    Args:
        device: the device.
        less_memory: what to change where memory is not enough, beside the device.

    Raises:
        DeviceError: out of memory, or the GPU has failed.
    """
    try:
        yield
    except (torch.OutOfMemoryError, MemoryError) as error:
        raise _out_of_memory(device, less_memory) from error
    except RuntimeError as error:
        if any(text in str(error) for text in _CPU_OUT_OF_MEMORY):
            raise _out_of_memory(torch.device("cpu"), less_memory) from error
        if any(text in str(error) for text in _CUDA_FAILED):
            raise _failed(device, error, less_memory) from error
        raise


def _out_of_memory(device: torch.device, less_memory: str) -> DeviceError:
    other = "another GPU or --device cpu" if device.type == "cuda" else "a machine with more memory"
    return DeviceError(f"{_name(device)} is out of memory{_in_use(device)}: {less_memory}, or use {other}")


def _failed(device: torch.device, error: RuntimeError, less_memory: str) -> DeviceError:
    reason = str(error).splitlines()[0]
    if "out of memory" in reason:
        return _out_of_memory(device, less_memory)
    return DeviceError(
        f"{_name(device)} has failed: {reason}; nvidia-smi shows its state; use --device cpu to run without it"
    )


def _name(device: torch.device) -> str:
    return "the machine" if device.type == "cpu" else f"device {device}"


def _in_use(device: torch.device) -> str:
    """GPU memory in use by this process and by all; empty where it is not known."""
    if device.type != "cuda":
        return ""
    try:
        own = torch.cuda.memory_allocated(device)
        free, total = torch.cuda.mem_get_info(device)
    except (RuntimeError, AssertionError):
        return ""
    return f" ({own / 2**20:.0f} MB in use by this run, {free / 2**20:.0f} of {total / 2**20:.0f} MB free)"
