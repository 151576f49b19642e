"""One short `kuka-surface` motion, for tests of the experiments on force priors."""

import pytest


@pytest.fixture(scope="session")
def motion():
    """480 rows, 2 s, in the order of time, with noise-free accelerations among the truth."""
    pytest.importorskip("pybullet")
    from forcegp.simulation import KukaSurfaceConfig, simulate_kuka_surface

    return simulate_kuka_surface(KukaSurfaceConfig(seconds=2, seed=1))
