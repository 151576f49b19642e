"""A compiled program as a function of rows of float64 tensors, one row per state."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, reduce
from operator import or_

import numpy as np
import torch
from torch import Tensor

STATES_PER_THREAD = 2048  # fewer are done before another thread has started
NOT_FINITE, NOT_POSITIVE, RESULT_NOT_FINITE = 1, 2, 4
"""What a program reports of its states: bits of its return value."""


class RowFunction:
    """`evaluate` of a library, whose inputs and outputs have these lengths.

    `tables` are the addresses of flat arrays, which the caller keeps alive.
    """

    def __init__(
        self, library: ctypes.CDLL, inputs: Sequence[int], outputs: Sequence[int], tables: Sequence[Tensor] = ()
    ) -> None:
        self.inputs, self.outputs = tuple(inputs), tuple(outputs)
        self._held = tuple(tables)
        self._tables = (ctypes.c_void_p * max(len(tables), 1))(*(x.data_ptr() for x in tables))
        self._evaluate = library.evaluate
        vectors = len(inputs) + len(outputs)
        self._evaluate.argtypes = [ctypes.c_long] * 2 + [ctypes.c_void_p, *[ctypes.c_void_p, ctypes.c_long] * vectors]

    def single(self, *inputs: Tensor) -> tuple[int, list[Tensor]]:
        """What is to be reported, and the outputs (size,) at one state (size,)."""
        made = [torch.empty(size, dtype=torch.float64) for size in self.outputs]
        given = [argument for x in (*inputs, *made) for argument in (x.data_ptr(), 1)]
        return self._evaluate(0, 1, self._tables, *given), made

    def rows(self, count: int, inputs: Sequence[Tensor], outputs: Sequence[Tensor]) -> int:
        """Fill `outputs` for `count` states; what is to be reported.

        Inputs and outputs are contiguous tensors (count, size), or (1, size) for all states; such an output receives
        the sum over the states. Large batches take as many threads as torch has.
        """
        threads = max(1, min(torch.get_num_threads(), count // STATES_PER_THREAD))
        if threads == 1:
            return self._evaluate(0, count, self._tables, *_pointers(count, (*inputs, *outputs)))
        # each thread has sums of its own
        sums = {k: x.new_zeros(threads, 1, x.shape[1]) for k, x in enumerate(outputs) if x.shape[0] != count}
        bounds = [count * k // threads for k in range(threads + 1)]

        def part(thread: int) -> int:
            filled = [sums[k][thread] if k in sums else x for k, x in enumerate(outputs)]
            pointers = _pointers(count, (*inputs, *filled))
            return self._evaluate(bounds[thread], bounds[thread + 1], self._tables, *pointers)

        found = reduce(or_, in_threads(part, threads))
        for k, values in sums.items():
            outputs[k].copy_(values.sum(0))
        return found


def in_threads(part: Callable[[int], int], count: int) -> list[int]:
    """part(0), part(1), ... at once, the first in this thread; ctypes lets other threads run meanwhile."""
    if count == 1:
        return [part(0)]
    others = [_pool(count - 1, os.getpid()).submit(part, k) for k in range(1, count)]
    return [part(0), *(other.result() for other in others)]


@cache
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    """Threads that stay, for to start them takes as long as many states; those of a parent process are not there."""
    return ThreadPoolExecutor(threads)


def _pointers(count: int, rows: Iterable[Tensor]) -> list[int]:
    """Addresses and strides from one state to the next."""
    return [number for x in rows for number in (x.data_ptr(), x.shape[1] if x.shape[0] == count else 0)]


def are_plain(given: Sequence[object], size: int) -> bool:
    """Whether these are tensors (size,) or (n, size), all of one shape, that need neither conversion nor a graph."""
    return all(
        type(x) is Tensor
        and x.shape == given[0].shape  # type: ignore[attr-defined]  # of a tensor, or they differ
        and x.shape[-1:] == (size,)
        and x.dim() <= 2
        and x.dtype is torch.float64
        and not x.requires_grad
        and x.is_cpu
        and x.is_contiguous()
        for x in given
    )


def aligned(values: np.ndarray) -> Tensor:
    """The numbers at an address that is a multiple of 64 bytes."""
    held = torch.empty(values.size + 8, dtype=torch.float64)
    start = (-held.data_ptr() // 8) % 8
    held[start : start + values.size] = torch.from_numpy(np.ascontiguousarray(values))
    return held[start : start + values.size]
