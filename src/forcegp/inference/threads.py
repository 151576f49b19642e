"""How many threads linear algebra takes."""

from contextlib import AbstractContextManager, nullcontext
from typing import Any

from threadpoolctl import threadpool_limits

SMALL_COVARIANCE = 2000
"""Rows of the full covariance below which one thread is faster than several (measured on 2 cores)."""


def blas_threads(covariance_rows: int) -> AbstractContextManager[Any]:
    """One BLAS thread while the covariance is small: threads that wait for each other cost up to 10 times as much."""
    return threadpool_limits(1) if covariance_rows <= SMALL_COVARIANCE else nullcontext()
