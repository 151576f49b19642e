"""CPU time of what arms with a fixed base use most, to compare two versions of forcegp on one machine.

Run it alternately with the two versions, for instance
    git worktree add /tmp/before COMMIT
    for k in 1 2 3; do for tree in /tmp/before .; do PYTHONPATH=$tree/src python benchmarks/arm_cost.py; done; done
and compare medians over the runs. It uses only what both versions have. The commit before bases could move is f1fc32b^.
"""

import json
import time
import warnings
from collections.abc import Callable

import torch

from forcegp import JointFriction, StructuredGP
from forcegp.simulation import FreeArmConfig, simulate_free_arm


def cpu(job: Callable[[], object], times: int) -> float:
    """Least CPU seconds, since noise only adds."""
    seconds = []
    for _ in range(times):
        begun = time.process_time()
        job()
        seconds.append(time.process_time() - begun)
    return min(seconds)


def main() -> None:
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    data = simulate_free_arm(FreeArmConfig(arm="ur5-free", seconds=10.0, seed=1))
    system, model = data.system, StructuredGP(data.system, JointFriction())
    posterior = model.fit(data, points=60, restarts=1)
    predictor = posterior.predictor()
    q, v, u = (torch.tensor(x[:1000]) for x in (data.q, data.v, data.u))
    one = tuple(x[0] for x in (data.q, data.v, data.u))
    rest = torch.zeros_like(v)
    compiled = system.robot.compile()
    at = tuple(torch.tensor(x) for x in one)
    jobs: dict[str, tuple[Callable[[], object], int]] = {
        "fit, 60 rows": (lambda: model.fit(data, points=60, restarts=1), 5),
        "predict, 1,000 rows": (lambda: posterior.predict(q, v, u), 25),
        "predict, 20 x one row": (lambda: [posterior.predict(q[0], v[0], u[0]) for _ in range(20)], 25),
        "dynamics, 1,000 rows": (lambda: system.dynamics(q, v, u).acceleration(rest), 25),
        "dynamics, 100 x one row": (
            lambda: [system.dynamics(q[0], v[0], u[0]).acceleration(rest[0]) for _ in range(100)],
            25,
        ),
        "predictor, 2,000 x one row of tensors": (lambda: [predictor(*at) for _ in range(2000)], 25),
        "predictor, 2,000 x one row of arrays": (lambda: [predictor(*one) for _ in range(2000)], 25),
        "compiled dynamics, 2,000 x one row": (lambda: [compiled.forward_dynamics(*at) for _ in range(2000)], 25),
    }
    print(json.dumps({name: round(cpu(*job), 6) for name, job in jobs.items()}))


if __name__ == "__main__":
    main()
