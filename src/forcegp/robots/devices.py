"""Where tensors can be: the devices of this machine, as its build of torch sees them."""

from __future__ import annotations

import torch

from forcegp.errors import InvalidInput


def usable_device(device: torch.device | str) -> torch.device:
    """``device`` itself, if tensors of float64 can be made there.

    Raises :class:`~forcegp.errors.InvalidInput` that names the devices which are there.
    """
    try:
        asked = torch.device(device)
        torch.zeros(1, dtype=torch.float64, device=asked)
    except (RuntimeError, AssertionError, TypeError, NotImplementedError):  # as torch's backends happen to raise
        raise InvalidInput(
            f"device {str(device)!r} cannot be used here; there is {', '.join(available_devices())}{_why()}."
        ) from None
    return asked


def available_devices() -> tuple[str, ...]:
    """Names of the CPU and of every GPU that torch can compute on in float64."""
    return ("cpu", *(f"cuda:{index} ({torch.cuda.get_device_name(index)})" for index in range(_gpus())))


def _gpus() -> int:
    return torch.cuda.device_count() if torch.cuda.is_available() else 0


def _why() -> str:
    """What a machine without a usable GPU lacks."""
    if _gpus():
        return ""
    if torch.version.cuda is None and torch.version.hip is None:
        return f" (torch {torch.__version__} is built for the CPU alone; docs/gpu.md names the build for GPUs)"
    return " (torch finds no GPU: see the output of nvidia-smi)"
