"""What do fits to 1,000, 10,000 and 100,000 rows cost, and are they worth it?

1,000 and 10,000 rows: `kuka-surface` with viscous friction at the tool and Coulomb friction in the joints, joint prior
with analytical mean; hyper-parameters from all 1,000, or from the 600 of 10,000 that lie farthest apart. 100,000 rows:
viscous friction at the tool, prior tool-friction. Every fit runs in a process of its own on one thread, which tells CPU
seconds and by how much its memory rose above what it had with data and libraries loaded; every 24th row of another
recording is scored against the noise-free acceleration. Recordings are kept in runs/benchmarks.

    python -m benchmarks large_data
    python -m benchmarks.large_data fit-10000        one of the fits
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil

from benchmarks.scores import scores_of
from forcegp import Dataset, JointForces, KukaSurfaceConfig, ToolForces, fit, simulate_kuka_surface
from forcegp.data import farthest_rows

RECORDINGS = Path(__file__).resolve().parent.parent / "runs" / "benchmarks"
COULOMB = {"joint_friction": "coulomb"}
FITS: dict[str, dict[str, Any]] = {
    "fit-1000": {"points": 1000, "prior": JointForces(), "options": COULOMB, "seconds": 220.0, "seed": 901},
    "fit-10000": {"points": 10_000, "prior": JointForces(), "options": COULOMB, "seconds": 220.0, "seed": 901},
    "fit-100000": {"points": None, "prior": ToolForces(), "options": {}, "seconds": 420.0, "seed": 903},
}
ROWS = 100_000
TEST_SECONDS, TEST_STEP = 60.0, 24


def recording(seed: int, seconds: float, **options: Any) -> Dataset:
    """A recording of `kuka-surface`, simulated once and kept."""
    name = "-".join([f"seed{seed}", f"{seconds:.0f}s", *map(str, options.values())])
    file = RECORDINGS / f"{name}.h5"
    if not file.exists():
        RECORDINGS.mkdir(parents=True, exist_ok=True)
        simulate_kuka_surface(KukaSurfaceConfig(seed=seed, seconds=seconds, **options)).save(file)
    return Dataset.load(file)


def peak_bytes() -> int:
    """The most memory that this process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def measured_fit(name: str) -> dict[str, Any]:
    """One of the fits, in this process."""
    case = FITS[name]
    data = recording(case["seed"], case["seconds"], **case["options"])
    data = data.rows(slice(ROWS)) if case["points"] is None else farthest_rows(data, case["points"])
    few = farthest_rows(data.rows(slice(0, 2000)), 20)
    fit(data.model.with_forces(case["prior"]), few, restarts=1)  # loads what only a fit loads
    before, cpu, wall = psutil.Process().memory_info().rss, time.process_time(), time.monotonic()
    posterior = fit(data.model.with_forces(case["prior"]), data)
    measured = {
        "cpu_s": time.process_time() - cpu,
        "wall_s": time.monotonic() - wall,
        "memory_mib": (peak_bytes() - before) / 2**20,
        "rows": len(posterior.training.q),
        "engine": posterior.settings["engine_reason"],
        "status": posterior.result.status,
        "evaluations": posterior.result.evaluations,
    }
    test = recording(case["seed"] + 1, TEST_SECONDS, **case["options"]).rows(slice(0, None, TEST_STEP))
    scores = scores_of(posterior, test)
    chosen = ("mae", "mae_noise_free", "coverage_95", "coverage_95_noise_free")
    return measured | {key: scores[key] for key in chosen if key in scores}


def in_own_process(module: str, *arguments: str) -> dict[str, Any]:
    """What `python -m module arguments` prints as JSON in its last line, on one thread."""
    threads = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}
    done = subprocess.run(
        [sys.executable, "-m", module, *arguments],
        env={**os.environ, **threads},
        cwd=Path(__file__).resolve().parent.parent,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.splitlines()[-1])


def run() -> dict[str, float]:
    """Measure and print; returns the keys of results.json that this question answers."""
    results: dict[str, float] = {}
    print("fit          rows   CPU s  memory MiB  MAE noise-free  coverage  engine")
    for name in FITS:
        found = in_own_process("benchmarks.large_data", name)
        print(
            f"{name:10} {found['rows']:6d} {found['cpu_s']:7.1f} {found['memory_mib']:11.0f} "
            f"{found['mae_noise_free']:15.4f} {found['coverage_95']:9.3f}  {found['engine']}; {found['status']}",
            flush=True,
        )
        key = name.replace("-", "_n")
        results |= {
            f"{key}_cpu_s": found["cpu_s"],
            f"{key}_memory_mib": found["memory_mib"],
            f"{key}_mae_noise_free": found["mae_noise_free"],
            f"{key}_coverage_95": found["coverage_95"],
        }
    results["fit_seconds_n1000_coulomb"] = results["fit_n1000_cpu_s"]
    results["mae_ratio_n10000_n1000"] = results["fit_n10000_mae_noise_free"] / results["fit_n1000_mae_noise_free"]
    return results


if __name__ == "__main__":
    import torch

    torch.set_num_threads(1)
    print(json.dumps(measured_fit(sys.argv[1])))
