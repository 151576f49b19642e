"""How much memory there is, the error that names what a computation would need, and threads of linear algebra."""

from contextlib import AbstractContextManager, nullcontext
from functools import cache
from pathlib import Path
from typing import Any

import psutil
import torch
from threadpoolctl import ThreadpoolController

from forcegp.errors import NotEnoughMemory

CGROUP = Path("/sys/fs/cgroup")  # where Linux states what a container may use (control groups, version 2)

USABLE = 0.9
"""Fraction of the free memory that a computation may plan with; the rest is for what else happens meanwhile."""


def free_memory(device: torch.device) -> int:
    """Bytes that are free on the device, within the limits of a container."""
    if device.type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        return int(free)
    return min(psutil.virtual_memory().available, _free_in_container())


def require_memory(needed: int, what: str, remedy: str, device: torch.device) -> None:
    """Raise NotEnoughMemory where `what` needs more bytes than are free: before anything is allocated."""
    free = free_memory(device)
    if needed > USABLE * free:
        raise NotEnoughMemory(f"{what} needs {gib(needed)}, {gib(free)} are free: {remedy}")


def gib(size: int) -> str:
    """A number of bytes for people."""
    return f"{size / 2**30:.1f} GiB" if size >= 2**30 / 10 else f"{size / 2**20:.0f} MiB"


def _free_in_container() -> int:
    """What the limit of the control group leaves; file caches, which are given back on demand, count as free."""
    try:
        limit, used = (CGROUP / "memory.max").read_text().strip(), int((CGROUP / "memory.current").read_text())
        cached = dict(line.split() for line in (CGROUP / "memory.stat").read_text().splitlines())["inactive_file"]
    except (OSError, ValueError, KeyError):
        return 2**63
    return 2**63 if limit == "max" else max(0, int(limit) - used + int(cached))


SMALL_COVARIANCE = 2000
"""Rows of the full covariance below which one thread is faster than several (measured on 2 cores)."""
LIBRARIES = cache(ThreadpoolController)  # to find them anew takes a millisecond, as long as a small covariance does


def blas_threads(covariance_rows: int) -> AbstractContextManager[Any]:
    """One BLAS thread while the covariance is small: threads that wait for each other cost up to 10 times as much."""
    return LIBRARIES().limit(limits=1) if covariance_rows <= SMALL_COVARIANCE else nullcontext()
