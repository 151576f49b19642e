import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from forcegp.errors import FitError, InvalidInput, NumericalError
from forcegp.inference import OptimizerOptions, best_of, minimize_objective
from forcegp.inference.optimization import _Search
from forcegp.progress import watched


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def rosenbrock(parameters):
    x = parameters["x"]
    return (100.0 * (x[1:] - x[:-1] ** 2) ** 2 + (1.0 - x[:-1]) ** 2).sum()


def start() -> dict[str, torch.Tensor]:
    return {"x": tensor(-1.2, 1.0)}


def falling(values) -> bool:
    return bool((np.diff(values) <= 0.0).all())


# ---------------------------------------------------------------- it finds optima


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), size=st.integers(1, 6))
def test_a_convex_quadratic(seed, size):
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(size, size))
    P, optimum = torch.as_tensor(factor @ factor.T + 0.1 * np.eye(size)), torch.as_tensor(rng.normal(size=size))
    result = minimize_objective(
        lambda p: 0.5 * (p["x"] - optimum) @ P @ (p["x"] - optimum) + 7.0,
        {"x": torch.as_tensor(rng.normal(size=size))},
        OptimizerOptions(tolerance=0.0),
    )
    assert result.converged
    assert result.value == pytest.approx(7.0)
    torch.testing.assert_close(result.parameters["x"], optimum, rtol=0.0, atol=1e-2)


def test_rosenbrock():
    calls, told = [], []
    with watched(lambda *given: told.append(given)):
        result = minimize_objective(lambda p: calls.append(1) or rosenbrock(p), start())
    assert [done for done, *_ in told] == list(range(1, len(result.history)))
    assert result.converged
    assert "converged" in result.status
    torch.testing.assert_close(result.parameters["x"], tensor(1.0, 1.0), rtol=0.0, atol=1e-5)
    assert falling(result.history)
    assert (result.history[0], result.history[-1]) == (float(rosenbrock(start())), pytest.approx(result.value))
    assert result.evaluations == len(calls) >= len(result.history)
    assert result.cpu_seconds >= 0.0


def test_several_parameters_of_any_shape_come_back_in_shape():
    initial = {"scalar": tensor(3.0)[0], "matrix": torch.ones(2, 3, dtype=torch.float64), "empty": tensor()}
    result = minimize_objective(lambda p: (p["scalar"] - 1.0) ** 2 + (p["matrix"] + 2.0).square().sum(), initial)
    assert {name: value.shape for name, value in result.parameters.items()} == {
        name: value.shape for name, value in initial.items()
    }
    assert float(result.parameters["scalar"]) == pytest.approx(1.0, abs=1e-4)
    torch.testing.assert_close(result.parameters["matrix"], torch.full((2, 3), -2.0).double(), rtol=0.0, atol=1e-4)


def test_what_the_caller_owns_is_not_changed():
    initial = {"x": start()["x"].requires_grad_()}
    result = minimize_objective(rosenbrock, initial)
    assert torch.equal(initial["x"].detach(), start()["x"])
    assert initial["x"].grad is None
    assert not result.parameters["x"].requires_grad
    result.parameters["x"].zero_()
    assert torch.equal(initial["x"].detach(), start()["x"])


def test_iterations_are_limited():
    result = minimize_objective(rosenbrock, start(), OptimizerOptions(iterations=5))
    assert len(result.history) == 6
    assert not result.converged
    assert "limit of" in result.status
    assert falling(result.history)


# ---------------------------------------------------------------- parameters without effect


def test_no_parameters_at_all():
    """A model with everything fixed: the value is still wanted."""
    result = minimize_objective(lambda parameters: tensor(3.0)[0], {})
    assert result.value == 3.0
    assert result.parameters == {}
    assert result.converged
    assert result.status == "no parameters to search for"


# ---------------------------------------------------------------- where the objective cannot be evaluated


def barrier_that_raises(parameters):
    x = parameters["x"]
    if bool((x <= 0.0).any()):
        raise NumericalError("the covariance matrix is not positive definite")
    return 1e3 * (x - x.log()).sum()


def barrier_that_gives_nan(parameters):
    return 1e3 * (parameters["x"] - parameters["x"].log()).sum()


@pytest.mark.parametrize("objective", [barrier_that_raises, barrier_that_gives_nan])
@pytest.mark.parametrize("begin", [(1000.0,), (3.0, 0.2, 40.0)], ids=str)
def test_failures_shorten_the_step_and_do_not_end_the_search(objective, begin):
    """The optimum is 1; a long first step lands where the logarithm does not exist."""
    result = minimize_objective(objective, {"x": tensor(*begin)}, OptimizerOptions(tolerance=1e-14))
    torch.testing.assert_close(result.parameters["x"], torch.ones(len(begin)).double(), rtol=0.0, atol=1e-4)
    assert result.value == pytest.approx(1e3 * len(begin))
    assert all(math.isfinite(value) for value in result.history)
    assert falling(result.history)


def test_a_parabola_stands_in_that_rises_as_much_as_the_objective_was_to_fall():
    """Its slope belongs to its value, c |step|^2, so the line search shortens the step by what it was told."""
    search = _Search(lambda p: p["x"].square().sum() / (p["x"].max() < 3.0), {"x": tensor(1.0, 2.0)})
    value, slope = search(np.array([1.0, 2.0]))
    step = np.array([2.5, 3.5])
    stand_in, rising = search(np.array([1.0, 2.0]) + step)
    assert (search.failures, stand_in) == (1, pytest.approx(value + slope @ step, rel=1e-14))
    np.testing.assert_allclose(rising, 2.0 * (slope @ step) * step / (step @ step), rtol=1e-14)


def test_failures_are_counted_and_named():
    result = minimize_objective(barrier_that_raises, {"x": tensor(1000.0)})
    assert result.converged
    assert "evaluations failed, the last because the covariance matrix is not positive definite" in result.status
    assert "failed" not in minimize_objective(rosenbrock, start()).status


@pytest.mark.parametrize(
    ("slope", "value"), [(lambda x: -100.0 * x.sum(), -141.42), (lambda x: (x - 1.5).square().sum(), 0.75)]
)
def test_a_wall_in_front_of_the_optimum_ends_the_search_at_the_wall(slope, value):
    def downhill(parameters):
        if float(parameters["x"].detach().norm()) > 1.0:
            raise NumericalError("outside of the disc")
        return slope(parameters["x"])

    result = minimize_objective(downhill, {"x": tensor(0.0, 0.0)})
    assert not result.converged, "steps that shrink before a wall are none"
    assert "outside of the disc" in result.status
    assert result.value == float(downhill(result.parameters))


@pytest.mark.parametrize(
    ("objective", "cause"),
    [(barrier_that_raises, "the covariance matrix is not positive definite"), (barrier_that_gives_nan, "not finite")],
)
def test_a_start_that_cannot_be_evaluated_is_an_error_with_its_cause(objective, cause):
    with pytest.raises(FitError, match=f"cannot be evaluated at the start values: .*{cause}"):
        minimize_objective(objective, {"x": tensor(-1.0)})


# ---------------------------------------------------------------- options and restarts


@pytest.mark.parametrize(
    "wrong", [{"iterations": -1}, {"tolerance": -1.0}, {"tolerance": math.nan}, {"patience": -1}], ids=str
)
def test_options_are_checked(wrong):
    with pytest.raises(InvalidInput):
        OptimizerOptions(**wrong)


def test_the_best_of_several_starts_says_so():
    far, near = (
        minimize_objective(rosenbrock, {"x": x}, OptimizerOptions(iterations=3))
        for x in (tensor(-3.0, 3.0), tensor(0.9, 0.8))
    )
    chosen = best_of([far, near])
    assert chosen.value == near.value < far.value
    assert chosen.status.endswith("(best of 2 starts)")
    assert best_of([far]) is far


def test_slow_progress_ends_the_search_and_says_so():
    patient = minimize_objective(rosenbrock, start())
    content = minimize_objective(rosenbrock, start(), OptimizerOptions(slow=50.0))
    assert content.converged
    assert "5 iterations lower the objective by less than 50 nats" in content.status
    assert len(content.history) < len(patient.history)
    assert content.history[-6] - content.history[-1] < 50.0
    assert content.value == min(content.history)


def test_a_search_without_hope_of_reaching_an_earlier_one_ends_and_says_so():
    options = OptimizerOptions(patience=10)
    alone = minimize_objective(rosenbrock, start(), options)
    assert alone.converged
    assert minimize_objective(rosenbrock, start(), options, rival=50.0).history == alone.history
    behind = minimize_objective(rosenbrock, start(), options, rival=-100.0)
    assert behind.status == "dropped: 10 iterations at its pace would not reach the best of earlier starts"
    assert not behind.converged
    k = len(behind.history) - 1
    pace = [alone.history[i - 5] - alone.history[i] for i in range(5, k + 1)]
    assert [alone.history[i] + 100.0 > 2.0 * pace[i - 5] for i in range(5, k + 1)] == [False] * (k - 5) + [True]
