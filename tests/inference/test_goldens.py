"""Drawn functions, few points, compressed covariances, choices of engines and searches, as they were."""

import warnings

import torch
from tests.goldens.compare import assert_unchanged
from tests.inference.problems import normal, problem
from tests.inference.test_one_input_functions import latents
from tests.inference.test_optimization import barrier_that_gives_nan, rosenbrock, tensor
from tests.inference.test_pathwise import conditioned
from tests.inference.test_prepared_kernels import sample

from forcegp.errors import NumericalError
from forcegp.forces.kernels import kernel_of
from forcegp.inference import ExactPosterior, OptimizerOptions, best_of, engines, memory, minimize_objective
from forcegp.inference.engines import ProblemSize, choose_engine
from forcegp.inference.inducing import InducingPosterior
from forcegp.inference.likelihood import factorize
from forcegp.inference.one_input import one_input_form
from forcegp.inference.pathwise import draw_functions
from forcegp.inference.prepared_kernels import compress, kernel_sums

KERNELS = "friction", "matern-1/2", "linear + matern-3/2", "constant + squared-exponential", "matern-5/2"


def test_drawn_functions_and_forms_of_one_input():
    found, s = {}, torch.linspace(-6.0, 6.0, 25).double()
    for expression in KERNELS:
        latent = conditioned([kernel_of(expression, 1, 1.3), kernel_of("matern-5/2", 2, 0.8)], (1, 2))
        drawn = draw_functions(latent, 3, seed=1, widening=1.3, frequencies=8)
        given = latents(expression, normal(9, seed=3))
        sums = kernel_sums(given)[0]
        forms = [
            form for form in (one_input_form(latent, 0, functions=drawn), one_input_form(given, 0)) if form is not None
        ]
        values = drawn([s.expand(3, 25)[..., None], torch.stack([s, s.flip(0)], -1).expand(3, 25, 2)])
        parts = [[form.table(), form.rates, [*form.curves], [*form.sides], form.values(s)] for form in forms]
        written = [len(form.c_source("f")) for form in forms] + [len(sums.c_source(n, n == 8)) for n in (1, 8)]
        found[expression] = {"values": values, "forms": parts, "written": written, "sums": sums.table()}
    assert_unchanged("inference/functions", found)


@torch.no_grad()
def test_few_points_and_compressed_covariances():
    given, found = problem(count=40), {}
    for points, tolerance in ((8, 0.0), (40, 0.3), (40, 30.0)):
        few = InducingPosterior.condition(given.kernels, given.terms, points=points, tolerance=tolerance)
        new = sample(5, seed=50).features
        drawn = draw_functions(few, 2, seed=4, frequencies=8)([z[None].expand(2, 5, 3) for z in new])
        numbers = [few.left_out, few.features, few.weights, few.mean(new), few.covariance(new), drawn]
        found[f"{points} {tolerance}"] = numbers
    exact = ExactPosterior.condition(given.kernels, given.terms)
    for tolerance, largest in ((0.0, 20), (0.1, 200), (0.5, 200)):
        small = compress(exact, sample(30, seed=50), sample(7, seed=90), tolerance=tolerance, largest=largest)
        found[f"compressed {tolerance}"] = [small.rank, small.inflation, small.at(exact, sample(4, seed=10).features)]
    assert_unchanged("inference/few", found, rtol=1e-5)


OPTIONS = {
    "plain": {"iterations": 20}, "slow": {"slow": 3.0}, "loose": {"tolerance": 1e-2}, "limited": {"iterations": 3},
    "patient": {"patience": 6}, "none": {"iterations": 0},
}  # fmt: skip


def test_every_value_of_a_search():
    results = {}
    for name, how in OPTIONS.items():
        start = {"x": tensor(-1.2, 1.0, 0.3)}
        results[name] = minimize_objective(rosenbrock, start, OptimizerOptions(**how), rival=2.0)
    start, few = {"x": tensor(30.0, 0.2)}, OptimizerOptions(iterations=6)
    results["wall"] = minimize_objective(barrier_that_gives_nan, start, few)
    results["best"] = best_of([results["patient"], results["limited"], results["plain"]])
    found = {name: [x.status, list(x.history), x.evaluations, x.converged, x.value] for name, x in results.items()}
    assert_unchanged("inference/searches", found, rtol=1e-3)


def test_engines_and_memory(monkeypatch):
    found = {}
    for free in (2.0, 40.0):
        for module in (engines, memory):
            monkeypatch.setattr(module, "free_memory", lambda device, free=free: int(free * 2**30))
        for rows in (0, 900, 1501, 3000, 30_000):
            for features in (3, 4):
                chosen = choose_engine(ProblemSize(rows, 6, 5, 6 * (rows > 0), features), torch.device("cpu"))
                found[f"{free} {rows} {features}"] = [chosen.reason, str(chosen.engine)]
    found["sizes"] = [memory.gib(round(size)) for size in (1e6, 1.07e8, 1.08e8, 5e9)]
    found["problem"] = vars(ProblemSize.of(problem(latents=2, dimension=4).terms))
    assert_unchanged("inference/engines", found)


def test_what_is_added_to_a_diagonal():
    found = {}
    for power in (0, -13, -11, -9, -7):
        with warnings.catch_warnings(record=True, action="always") as said:
            try:
                jitter = factorize(lambda p=power: torch.diag(tensor(1.0, 2.0, -(10.0**p) if p else 1.0))).jitter
            except NumericalError as error:
                jitter = str(error)
        found[f"{power}"] = [jitter, [str(each.message) for each in said]]
    assert_unchanged("inference/jitter", found)
