"""CPU time of what arms with a fixed base use most: that of one version of forcegp over that of another.

    git worktree add /tmp/before COMMIT
    python benchmarks/arm_cost.py /tmp/before .
    python benchmarks/arm_cost.py /tmp/before . --count

The commit before bases could move is f1fc32b^. Each version runs in a process of its own, and the two take turns in
short slices, so that both see the same load of the machine. Processes differ by some percent for no reason of the code,
such as the layout of memory: so there are several pairs of them. Printed are the median ratio of successive slices (its
median and range over the pairs) and the ratio of the least times (its median). The same tree given twice shows what
noise remains. It uses only what both versions have.

`--count` prints what no load changes: operations of torch, entries of the tensors that they return, calls of Python.
Compiled programs have few of either.
"""

import argparse
import cProfile
import json
import os
import pstats
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any


def prepared() -> tuple[dict[str, Callable[[], object]], list[float]]:
    """What is timed, and what the fit found: equal results are a condition of a fair comparison."""
    import torch

    from forcegp import JointFriction
    from forcegp.fit import fit
    from forcegp.fit.objective import FitObjective
    from forcegp.inference import OptimizerOptions
    from forcegp.simulation import FreeArmConfig, simulate_free_arm

    torch.set_num_threads(1)
    data = simulate_free_arm(FreeArmConfig(arm="ur5-free", seconds=10.0, seed=1))
    model = data.model
    assert model is not None, "simulated data have one"
    model = model.with_forces(JointFriction())
    posterior = fit(model, data, points=60, restarts=1)
    fixed = posterior.model.split_noise[1]
    objective = FitObjective(posterior.likelihood, posterior.kernels, posterior.model.known_noise, fixed, True)
    free = {name: x.clone().requires_grad_() for name, x in posterior.hyperparameters.items() if name not in fixed}
    predictor, compiled = posterior.predictor(), model.robot.compile()
    q, v, u = (torch.tensor(x[:1000]) for x in (data.q, data.v, data.u))
    one, arrays, rest = (q[0], v[0], u[0]), (data.q[0], data.v[0], data.u[0]), torch.zeros_like(v)
    short = OptimizerOptions(iterations=1)
    jobs: dict[str, Callable[[], object]] = {
        "fit, 60 rows": lambda: fit(model, data, points=60, restarts=1),
        "fit without its search": lambda: fit(model, data, points=60, restarts=1, options=short),
        "objective and gradient": lambda: [torch.autograd.grad(objective(free), [*free.values()]) for _ in range(10)],
        "predict, 1,000 rows": lambda: posterior.predict(q, v, u),
        "predict, one row": lambda: [posterior.predict(*one) for _ in range(40)],
        "dynamics, 1,000 rows": lambda: [model.dynamics(q, v, u).acceleration(rest) for _ in range(40)],
        "dynamics, one row": lambda: [model.dynamics(*one).acceleration(rest[0]) for _ in range(400)],
        "predictor, one row of tensors": lambda: [predictor(*one) for _ in range(4000)],
        "predictor, one row of arrays": lambda: [predictor(*arrays) for _ in range(2000)],
        "compiled dynamics, one row": lambda: [compiled.forward_dynamics(*one) for _ in range(4000)],
    }
    return jobs, [posterior.result.evaluations, posterior.result.value]


def counted(job: Callable[[], object]) -> tuple[int, int, int]:
    """Operations of torch, entries of their results, and calls of Python in one run of that job."""
    import torch
    from torch.utils._python_dispatch import TorchDispatchMode
    from torch.utils._pytree import tree_leaves

    class Operations(TorchDispatchMode):
        number = entries = 0

        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            result = func(*args, **(kwargs or {}))
            self.number += 1
            self.entries += sum(x.numel() for x in tree_leaves(result) if isinstance(x, torch.Tensor))
            return result

    with Operations() as operations:
        job()
    with cProfile.Profile() as profile:
        job()
    return operations.number, operations.entries, pstats.Stats(profile).total_calls  # pyright: ignore[reportAttributeAccessIssue]


def work(count: bool) -> None:
    """Run the jobs whose names come in, and print the CPU seconds of each."""
    warnings.simplefilter("ignore")
    jobs, found = prepared()
    for job in jobs.values():
        job()
    print(json.dumps([list(jobs), found]), flush=True)
    for name in sys.stdin:
        if count:
            print(json.dumps(counted(jobs[name.strip()])), flush=True)
            continue
        begun = time.process_time()
        jobs[name.strip()]()
        print(time.process_time() - begun, flush=True)


class Worker:
    """A process of the version in `tree`, which waits for names of jobs."""

    def __init__(self, tree: str, *options: str) -> None:
        environment = os.environ | {"PYTHONPATH": str(Path(tree).resolve() / "src"), "OMP_NUM_THREADS": "1"}
        call, pipe = [sys.executable, __file__, "--work", *options], subprocess.PIPE
        self.process = subprocess.Popen(call, env=environment, text=True, stdin=pipe, stdout=pipe)

    def answer(self, name: str | None = None) -> Any:
        """CPU seconds or counts of that job; without a name what the process prints once it is prepared."""
        assert self.process.stdin is not None, "a pipe"
        assert self.process.stdout is not None, "a pipe"
        if name is not None:
            print(name, file=self.process.stdin, flush=True)
        return json.loads(self.process.stdout.readline())


def main(trees: list[str], pairs: int, turns: int) -> None:
    """Print the ratios, the second tree over the first."""
    ratios: dict[str, list[tuple[float, float]]] = {}
    for _ in range(pairs):
        workers = [Worker(tree) for tree in trees]
        (names, found), (_, others) = (worker.answer() for worker in workers)
        print(f"evaluations and value of the fit: {found}, {others}", file=sys.stderr)
        seconds: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name in names}
        for turn in range(turns):
            for name in names:
                for k in (0, 1) if turn % 2 else (1, 0):
                    seconds[name][k].append(workers[k].answer(name))
        for worker in workers:
            worker.process.communicate()
        for name, (first, second) in seconds.items():
            middle = median(b / a for a, b in zip(first, second, strict=True))
            ratios.setdefault(name, []).append((middle, min(second) / min(first)))
    for name, each in ratios.items():
        (low, middle, high), (_, least, _) = ((min(x), median(x), max(x)) for x in zip(*each, strict=True))
        print(f"{name:30} median {middle:.3f} ({low:.3f} to {high:.3f}), least times {least:.3f}")


def compare_counts(trees: list[str]) -> None:
    """Print what each version counts, and the ratio, the second over the first."""
    workers = [Worker(tree, "--count") for tree in trees]
    (names, _), _ = (worker.answer() for worker in workers)
    print(f"{'':30} {'operations of torch':>28} {'entries of results':>32} {'calls of Python':>28}")
    for name in names:
        pairs = zip(*(worker.answer(name) for worker in workers), strict=True)
        columns = zip(pairs, (9, 11, 9), strict=True)
        print(f"{name:30} " + " ".join(f"{a:{w}d} {b:{w}d} {b / a if a else 1:7.4f}" for (a, b), w in columns))
    for worker in workers:
        worker.process.communicate()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trees", nargs="*", help="two checkouts: the ratio is the second over the first")
    parser.add_argument("--pairs", type=int, default=5, help="pairs of processes (default: %(default)s)")
    parser.add_argument("--turns", type=int, default=10, help="slices of each job and process (default: %(default)s)")
    parser.add_argument("--count", action="store_true", help="count operations and calls instead of seconds")
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.work:
        work(given.count)
    elif len(given.trees) == 2 and given.count:
        compare_counts(given.trees)
    elif len(given.trees) == 2:
        main(given.trees, given.pairs, given.turns)
    else:
        parser.error("give two trees")
