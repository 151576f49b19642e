"""Environment of every test: one thread, no verdict by the clock, and on request a check of all annotated shapes.

`FORCEGP_CHECK_SHAPES=1` (`make test-all`) checks at run time what annotations of forcegp promise, at more than twice
the time. `FORCEGP_TEST_THREADS=2` computes with two threads (`make test-processors`).
"""

import contextlib
import os
import resource
from collections.abc import Callable, Iterator
from pathlib import Path

THREADS = int(os.environ.get("FORCEGP_TEST_THREADS", "1"))
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):  # numpy and torch read them at import
    os.environ[variable] = str(THREADS)

import pytest
import torch
from hypothesis import HealthCheck, settings
from tests import shapes

if os.environ.get("FORCEGP_CHECK_SHAPES") == "1":
    shapes.install()  # before the first import of forcegp
torch.set_num_threads(THREADS)

# The same examples on every machine and no verdict by the clock: a failure here is a failure everywhere.
settings.register_profile("reproducible", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("reproducible")

REPOSITORY = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def repository() -> Path:
    return REPOSITORY


@pytest.fixture(scope="session")
def shared() -> Callable[[str], Path]:
    """`shared("reference/kuka_paper.npz")`: that file of the optional folder `../shared`; skips the test without it."""

    def path(name: str) -> Path:
        found = REPOSITORY.parent / "shared" / name
        if not found.exists():
            pytest.skip(f"optional data ../shared/{name} is not beside this checkout")
        return found

    return path


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Without the types of signatures checked, as users have it: what does not fit may be taken, too."""
    with shapes.unchecked():
        yield


@pytest.fixture
def limited_file_size() -> Callable[[int], contextlib.AbstractContextManager[None]]:
    """`with limited_file_size(count):` no file of this process can grow beyond `count` bytes, as on a full disk."""

    @contextlib.contextmanager
    def limited(count: int) -> Iterator[None]:
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (count, before[1]))  # Python ignores the signal: EFBIG is left
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    return limited
