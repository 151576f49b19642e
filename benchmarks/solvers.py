"""What do other ways to solve for the posterior of many rows need, and are estimated gradients worth it?

T alpha = t for 2000 rows of `kuka-surface` with Coulomb friction in the joints, joint prior (`solver_problem`): the
factorised covariance, conjugate gradients with five kinds of preconditioner, alternating projections and stochastic
dual descent (`rival_solvers`). CPU seconds on one thread until the relative residual is 1e-2 and 1e-4, with all that a
method prepares and without what measures it; no more than 120 of them. Block and step sizes of the last two are chosen
by trials of 10 seconds, which are not counted. Then `gradient_probes`.

    python -m benchmarks solvers
    python -m benchmarks.solvers plain gradients       some of them
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import product

import torch
from threadpoolctl import threadpool_limits

from benchmarks import gradient_probes
from benchmarks.rival_solvers import (
    Steps,
    alternating_projections,
    cholesky,
    conjugate_gradients,
    low_rank_plus_diagonal,
    pivoted_cholesky_of_covariance,
    point_blocks,
    stochastic_dual_descent,
    unpreconditioned,
)
from benchmarks.solver_problem import ROWS, Problem, Task

LEVELS = (1e-2, 1e-4)
CAP, TRIAL = 120.0, 10.0
BLOCKS = ((150, False), (300, False), (500, False), (500, True))
STEP_SIZES, BATCH = tuple(product((0.3, 1.0, 2.0), (False, True))), 100
DIVERGED = 1e6

Method = Callable[[Problem], Steps]


@dataclass
class Race:
    """CPU seconds, steps and noise-free MAE where each level was reached, and where it ended."""

    reached: dict[float, tuple[float, int, float]] = field(default_factory=dict)
    seconds: float = 0.0
    steps: int = 0
    residual: float = math.inf
    mae: float = math.nan

    def row(self, name: str) -> str:
        """A line of the table."""
        cells = [
            f"{self.reached[level][0]:8.1f} {self.reached[level][1]:6d} {self.reached[level][2]:8.4f}"
            if level in self.reached
            else f"{'-':>8} {'-':>6} {'-':>8}"
            for level in LEVELS
        ]
        return f"{name:44} {cells[0]} | {cells[1]} | {self.residual:8.1e} {self.mae:8.4f} after {self.seconds:5.1f} s"


def race(task: Task, method: Method, cap: float = CAP) -> Race:
    """Run a method until the last level, or for `cap` CPU seconds."""
    problem, found, next_look = task.problem, Race(), 0.0
    size = float(problem.t.norm())
    alpha = torch.zeros_like(problem.t)
    problem.product(alpha)  # makes the kernel matrices that serve only to measure
    with torch.no_grad():
        steps = method(problem)
        while found.seconds < cap:
            start = time.process_time()
            step = next(steps, None)
            found.seconds += time.process_time() - start
            if step is None:
                break
            alpha, residual = step
            found.steps += 1
            if residual is None:  # what the method does not compute is not in its time
                if found.seconds < next_look:
                    continue
                next_look = found.seconds + 0.02 * max(found.seconds, 10.0)
                relative = problem.relative_residual(alpha)
            else:
                relative = float(residual.norm()) / size
            if not relative < DIVERGED:
                break
            for level in LEVELS:
                if relative <= level and level not in found.reached and problem.relative_residual(alpha) <= level:
                    found.reached[level] = (found.seconds, found.steps, task.mae_noise_free(alpha))
            if len(found.reached) == len(LEVELS):
                break
        found.residual, found.mae = problem.relative_residual(alpha), task.mae_noise_free(alpha)
    return found


def tuned_projections(task: Task) -> tuple[str, Method]:
    """Alternating projections with the block size that comes farthest in a trial."""
    trials = {given: race(task, lambda p, g=given: alternating_projections(p, *g), TRIAL) for given in BLOCKS}
    for (size, clusters), found in trials.items():
        print(found.row(f"  trial: blocks of {size}, {'neighbours' if clusters else 'as they come'}"), flush=True)
    size, clusters = min(trials, key=lambda given: trials[given].residual)
    return f"alternating projections, blocks of {size}", lambda p: alternating_projections(p, size, clusters)


def tuned_descent(task: Task) -> tuple[str, Method]:
    """Stochastic dual descent with the step size and coordinates that come farthest in a trial."""
    trials: dict[tuple[float, bool], Race] = {}
    for step, whitened in STEP_SIZES:
        found = race(task, lambda p, s=step, w=whitened: stochastic_dual_descent(p, s, BATCH, 1000, w), TRIAL)
        print(found.row(f"  trial: step {step}{', whitened' if whitened else ''}"), flush=True)
        trials[step, whitened] = found
    step, whitened = min(trials, key=lambda given: trials[given].residual if trials[given].residual > 0 else math.inf)
    steps = int(trials[step, whitened].steps * CAP / TRIAL)
    name = f"stochastic dual descent, step {step}{', whitened' if whitened else ''}"
    return name, lambda p: stochastic_dual_descent(p, step, BATCH, steps, whitened)


def methods() -> dict[str, Callable[[Task], tuple[str, Method]]]:
    """Key -> title and method; those that are tuned do so when asked."""

    def cg(title: str, preconditioner: Callable) -> Callable[[Task], tuple[str, Method]]:
        return lambda _: (f"CG, {title}", lambda p: conjugate_gradients(p, preconditioner))

    return {
        "exact": lambda _: ("factorised covariance", cholesky),
        "ours_5th": cg(f"ours, {ROWS // 5} points", low_rank_plus_diagonal(ROWS // 5)),
        "ours_10th": cg(f"ours, {ROWS // 10} points", low_rank_plus_diagonal(ROWS // 10)),
        "ours_20th": cg(f"ours, {ROWS // 20} points", low_rank_plus_diagonal(ROWS // 20)),
        "pivoted_2000": cg("pivoted Cholesky of T, rank 2000", pivoted_cholesky_of_covariance(2000)),
        "pivoted_1000": cg("pivoted Cholesky of T, rank 1000", pivoted_cholesky_of_covariance(1000)),
        "pivoted_blocks_1000": cg(
            "the same, and blocks of what it leaves out", pivoted_cholesky_of_covariance(1000, blocks=True)
        ),
        "pivoted_500": cg("pivoted Cholesky of T, rank 500", pivoted_cholesky_of_covariance(500)),
        "pivoted_100": cg("pivoted Cholesky of T, rank 100", pivoted_cholesky_of_covariance(100)),
        "pivoted_15": cg("pivoted Cholesky of T, rank 15", pivoted_cholesky_of_covariance(15)),
        "point_blocks": cg("blocks of points", point_blocks),
        "plain": cg("no preconditioner", unpreconditioned),
        "projections": tuned_projections,
        "descent": tuned_descent,
    }


def run(chosen: list[str] | None = None) -> dict[str, float]:
    """Measure and print; returns the keys of results.json that this question answers."""
    results: dict[str, float] = {}
    task = Task.load()
    print(f"{task.problem.t.numel()} unknowns; MAE of the mean alone {task.mae_noise_free(0 * task.problem.t):.3f}")
    head = f"{'CPU s':>8} {'steps':>6} {'MAE':>8}"
    print(f"{'':44} {'to 1e-2':>24} | {'to 1e-4':>24} |\n{'':44} {head} | {head} | residual      MAE at the end")
    for key, make in methods().items():
        if chosen and key not in chosen:
            continue
        title, method = make(task)
        found = race(task, method)
        print(found.row(title), flush=True)
        for level, name in zip(LEVELS, ("1e2", "1e4"), strict=True):
            if level in found.reached:
                results[f"solver_{key}_cpu_s_{name}"] = found.reached[level][0]
        if LEVELS[-1] not in found.reached:
            results[f"solver_{key}_residual_120s"] = found.residual
    if not chosen or "gradients" in chosen:
        results |= gradient_probes.run(task)
    return results


if __name__ == "__main__":
    torch.set_num_threads(1)
    with threadpool_limits(1):
        print(run(sys.argv[1:]))
