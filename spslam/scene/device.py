"""Whether kernels can run on a device."""

import torch

from spslam import ops
from spslam.errors import DeviceError


def usable_device(device: torch.device | str) -> torch.device:
    """A device of torch, if scenes can be on it.

    Args:
        device: `cpu`, `cuda` or `cuda:N`.

    Raises:
        DeviceError: it is another one, or not available here.
    """
    try:
        usable = torch.device(device)
    except (RuntimeError, TypeError):
        raise DeviceError(f"device must be cpu, cuda or cuda:N, got {device}") from None
    if usable.type == "cuda":
        if ops.CUDA_OFF_REASON:
            hint = 'use --device cpu, in Python device="cpu"'
            raise DeviceError(f"device {device} is not available: {ops.CUDA_OFF_REASON}; {hint}")
        if usable.index is not None and usable.index >= torch.cuda.device_count():
            raise DeviceError(f"device {device} is not available: there are {torch.cuda.device_count()} CUDA devices")
    elif usable.type != "cpu":
        raise DeviceError(f"device must be cpu, cuda or cuda:N, got {device}")
    return usable
