"""One short `kuka-surface` motion, as it is and as the data job of a run."""

import pytest
from tests.benchmarks.stored_jobs import DATA, keep

from forcegp.jobs import JobStore


@pytest.fixture(scope="session")
def motion():
    """480 rows, 2 s, in the order of time, with noise-free accelerations among the truth."""
    from forcegp.simulation import KukaSurfaceConfig, simulate_kuka_surface

    return simulate_kuka_surface(KukaSurfaceConfig(seconds=2, seed=1))


@pytest.fixture(scope="module")
def run(motion, tmp_path_factory):
    """JobStore with one data job: 60 rows to train on, and the motion itself as test trajectory."""
    from benchmarks.paper.data import TEST, TRAIN

    from forcegp.data import farthest_rows

    results = JobStore.open(tmp_path_factory.mktemp("run") / "out", "a test", {})

    def write(folder):
        farthest_rows(motion, 60).save(folder / TRAIN)
        motion.save(folder / TEST)

    keep(results, DATA, {"seed": 1, "every": 4}, {}, write)
    return results
