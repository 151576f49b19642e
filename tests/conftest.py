"""Every shape in a signature of forcegp is checked at run time here, and every test computes on one thread."""

import os
from collections.abc import Callable
from pathlib import Path

for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):  # read when numpy and torch are imported
    os.environ[threads] = "1"

import pytest
import torch
from hypothesis import HealthCheck, settings
from jaxtyping import install_import_hook

if os.environ.get("FORCEGP_CHECK_SHAPES"):
    install_import_hook("forcegp", "beartype.beartype")
torch.set_num_threads(1)

# The same examples on every machine and no verdict by the clock: a failure here is a failure everywhere.
settings.register_profile("reproducible", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("reproducible")

REPOSITORY = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of this checkout."""
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
