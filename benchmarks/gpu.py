"""What does a GPU gain: likelihood with all gradients, predictions, dynamics and rollouts, on the CPU and on a GPU?

    python -m benchmarks.gpu                         both, with growing numbers of rows and states
    python -m benchmarks.gpu --device cpu --small    the CPU alone and few of them: shows that this script works

The robot is that of `kuka-surface`: 7 joints, one contact, the prior on joint forces with the analytical mean, kernels
and noise at start values. Wall seconds, medians of three after one run that is not counted; a GPU is waited for. Values
on both devices are compared. Sizes that would not fit into memory, by the estimate that is printed, are left out, and
on the CPU those beyond --cpu-rows. What ran on a GPU is written to benchmarks/gpu_results.json. Without one: exit code
2.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from forcegp.atomic_files import write_text
from forcegp.data import Dataset, farthest_rows
from forcegp.errors import InvalidInput
from forcegp.evidence import MarginalLikelihood, TrainingData
from forcegp.forces import JointForces
from forcegp.inference import OptimizationResult
from forcegp.inference.memory import free_memory, gib
from forcegp.jobs import machine
from forcegp.noise import Noise
from forcegp.posterior import Posterior
from forcegp.robots.arguments import usable_device
from forcegp.simulation import KukaSurfaceConfig, simulate_kuka_surface

RESULTS = Path(__file__).resolve().parent / "gpu_results.json"
JOINTS, RANK = 7, 6
ROWS, MANY = (200, 500, 1000, 2000, 4000, 8000), (1, 100, 1000, 10_000)
LARGE = {"rows": ROWS, "states": (*MANY, 100_000), "states_to_predict": MANY, "motions": MANY}
SMALL = {"rows": (20, 40), "states": (1, 50), "states_to_predict": (1, 50), "motions": (1, 5)}
ROWS_TO_PREDICT_FROM, STEPS = 1000, 20
REPEATS = 3
NOT_SEARCHED = OptimizationResult({}, math.nan, (), "not searched", False, 0, 0.0)


def required_bytes(rows: int) -> int:
    """Estimate for the likelihood and its gradients: three matrices of the deflated size, three sets of kernels."""
    return 3 * 8 * (RANK * rows) ** 2 + 3 * 8 * JOINTS * rows**2


def median_seconds(device: torch.device, call: Callable[[], object]) -> float:
    """Of `REPEATS` calls after one that is not counted."""
    seconds = []
    for _ in range(REPEATS + 1):
        _wait(device)
        start = time.perf_counter()
        call()
        _wait(device)
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[1:])


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


class Questions:
    """Everything that is timed, on one device."""

    def __init__(self, data: Dataset, device: torch.device) -> None:
        self.data, self.device = data, device
        self.model = data.model.to(device).with_forces(JointForces(), noise=Noise(0.1))  # type: ignore[union-attr]  # simulated data have a model

    def likelihood(self, rows: int) -> Callable[[], Tensor]:
        training = TrainingData.of(self.data.rows(slice(0, rows)), self.device)
        likelihood = MarginalLikelihood(self.model, training)
        kernels = likelihood.kernels
        parameters = kernels.initial_parameters() | Noise(0.1).parameters(JOINTS, self.device)
        parameters = {name: value.clone().requires_grad_() for name, value in parameters.items()}

        def evaluate() -> Tensor:
            value = likelihood(kernels, parameters)
            torch.autograd.grad(value, list(parameters.values()))
            return value.detach()

        return evaluate

    def posterior(self, rows: int) -> Posterior:
        training = TrainingData.of(self.data.rows(slice(0, rows)), self.device)
        likelihood = MarginalLikelihood(self.model, training)
        parameters = likelihood.kernels.initial_parameters() | Noise(0.1).parameters(JOINTS, self.device)
        return Posterior.conditioned(self.model, training, parameters, NOT_SEARCHED, {})

    def states(self, count: int) -> list[Tensor]:
        """Rows of the data, again and again."""
        given = (torch.tensor(x, device=self.device) for x in (self.data.q, self.data.v, self.data.u))
        return [x.repeat(math.ceil(count / len(x)), 1)[:count] for x in given]

    def dynamics(self, count: int) -> Callable[[], Tensor]:
        states = self.states(count)
        return lambda: self.model.dynamics(*states).acceleration_map().offset

    def prediction(self, posterior: Posterior, count: int) -> Callable[[], Tensor]:
        states = self.states(count)
        return torch.no_grad()(lambda: posterior.predict(*states).mean)

    def rollout(self, posterior: Posterior, motions: int) -> Callable[[], Tensor]:
        q, v, u = self.states(motions)
        forces = u[:, None].expand(motions, STEPS, JOINTS)
        return lambda: posterior.rollout(q, v, forces, 1.0 / 240.0).q


def measure(devices: list[torch.device], small: bool, cpu_rows: int) -> dict[str, dict[str, float]]:
    """Print the tables; gives seconds by device and question."""
    sizes = SMALL if small else LARGE
    longest = max(sizes["rows"])
    seconds = max(5.0, 1.2 * longest / 240.0)
    data = simulate_kuka_surface(KukaSurfaceConfig(seconds=seconds, seed=1))
    data = farthest_rows(data, longest)
    asked = {str(device): Questions(data, device) for device in devices}
    from_rows = min(ROWS_TO_PREDICT_FROM, longest)
    posteriors = {name: questions.posterior(from_rows) for name, questions in asked.items()}
    found: dict[str, dict[str, float]] = {name: {} for name in asked}

    def row(
        key: str, what: str, fits: Callable[[Questions], bool], make: Callable[[str, Questions], Callable[[], Tensor]]
    ) -> None:
        cells, values = [], []
        for name, questions in asked.items():
            if not fits(questions):
                cells.append("-")
                continue
            if questions.device.type == "cuda":
                torch.cuda.reset_peak_memory_stats(questions.device)
            call = make(name, questions)
            values.append(call().cpu())
            found[name][key] = median_seconds(questions.device, call)
            memory = ""
            if questions.device.type == "cuda":
                peak = torch.cuda.max_memory_allocated(questions.device)
                found[name][f"{key}_peak_bytes"] = float(peak)
                memory = f" ({gib(peak)})"
            cells.append(f"{found[name][key]:.4g} s{memory}")
        apart = ""
        if len(values) == 2:
            largest = float((values[0] - values[1]).abs().max() / (1.0 + values[0].abs().max()))
            found[str(devices[-1])][f"{key}_apart"] = largest
            apart = f"{largest:.0e}"
        print(f"| {what} | {' | '.join(cells)} | {apart} |", flush=True)

    print(f"| {' | '.join(('what', *asked, 'apart'))} |\n|---|{'---:|' * (len(asked) + 1)}")
    for rows in sizes["rows"]:

        def fits(questions: Questions, rows: int = rows) -> bool:
            within = questions.device.type != "cpu" or small or rows <= cpu_rows
            return within and required_bytes(rows) < free_memory(questions.device)

        what = f"likelihood and gradients, N = {rows} (needs {gib(required_bytes(rows))})"
        row(f"nll_n{rows}", what, fits, lambda _, questions, rows=rows: questions.likelihood(rows))
    for count in sizes["states_to_predict"]:
        what = f"prediction with covariance of {count} states, N = {from_rows}"
        row(f"predict_{count}", what, _always, lambda name, asked, n=count: asked.prediction(posteriors[name], n))
    for count in sizes["states"]:
        what = f"constrained dynamics of {count} states"
        row(f"dynamics_{count}", what, _always, lambda _, asked, n=count: asked.dynamics(n))
    for count in sizes["motions"]:
        what = f"rollout of {count} motions, {STEPS} steps, N = {from_rows}"
        row(f"rollout_{count}", what, _always, lambda name, asked, n=count: asked.rollout(posteriors[name], n))
    return found


def _always(_: Questions) -> bool:
    return True


def main(arguments: list[str] | None = None) -> int:
    """Gives the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--device", default="cuda", help="cuda (default), cuda:K, or cpu for the CPU alone")
    parser.add_argument("--small", action="store_true", help="few rows and states, for trying this script")
    parser.add_argument("--cpu-rows", type=int, default=2000, help="most rows for the likelihood on the CPU")
    given = parser.parse_args(arguments)
    try:
        device = usable_device(given.device)
    except InvalidInput as error:
        needs = ", ".join(f"N = {rows} {gib(required_bytes(rows))}" for rows in ROWS[2:])
        print(f"benchmarks.gpu: {error} The likelihood needs about this much GPU memory: {needs}.", file=sys.stderr)
        return 2
    threads = 1 if given.small else os.cpu_count() or 1
    torch.set_num_threads(threads)
    cpu = torch.device("cpu")
    processor = f"{machine()}; {threads} threads used"
    print(f"CPU: {processor}, {gib(free_memory(cpu))} free")
    if device.type == "cuda":
        properties = torch.cuda.get_device_properties(device)
        print(f"GPU: {properties.name}, {gib(properties.total_memory)}, CUDA {torch.version.cuda}")
    with threadpool_limits(threads):  # LAPACK's own; entered after the libraries are loaded
        found = measure([cpu] if device.type == "cpu" else [cpu, device], given.small, given.cpu_rows)
    if device.type == "cuda":
        card = {"gpu": torch.cuda.get_device_name(device), "torch": torch.__version__, "cuda": torch.version.cuda}
        document = card | {"cpu": processor, "small": given.small, "results": found}
        write_text(RESULTS, json.dumps(document, indent=1, sort_keys=True) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
