"""The examples of docs/how-to/control.md: they run, and with the tools of others where these are installed."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.control.test_mppi import cost, predictor
from tests.examples import run_example

__all__ = ["predictor"]  # a fixture


@pytest.fixture(scope="module")
def examples() -> list[str]:
    page = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "control.md"
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.nightly
def test_the_examples_run(examples, tmp_path):
    pytest.importorskip("pybullet")
    pytest.importorskip("gymnasium")
    pytest.importorskip("mujoco")
    printed = run_example("".join(examples[:5]), tmp_path).splitlines()
    limited, plan, states, many, lasted, *touched, rows, kept = printed
    assert (lasted, rows, kept) == ("True", "2400", "True True")
    assert touched == []
    assert (tmp_path / "next.csv").exists()
    assert many == "(64, 14)"
    assert limited == "torch.Size([7]) tensor(False)"
    assert (plan, states) == ("torch.Size([7])", "torch.Size([5, 14])")


def test_dynamics_for_planners_in_torch(predictor):
    """The function of the page, in pytorch_mppi's own controller: the cart is brought to 0."""
    package = pytest.importorskip("pytorch_mppi", reason="pytorch_mppi is not installed")

    def dynamics(state, action):
        q, v = state.chunk(2, dim=-1)
        return torch.cat(predictor.step(q, v, action, dt=0.05, integrator="implicit-midpoint"), dim=-1)

    def running(state, action):
        return cost(state[:, None, :1], state[:, None, 1:], action[:, None])

    torch.manual_seed(0)
    planner = package.MPPI(dynamics, running, 2, torch.eye(1).double() * 9.0, num_samples=200, horizon=30, lambda_=0.1)
    state = torch.tensor([1.0, 0.0]).double()
    for _ in range(90):
        state = dynamics(state[None], planner.command(state)[None])[0]
    assert float(state.abs().max()) < 0.2


def test_the_crocoddyl_model_has_the_derivatives_of_its_accelerations(examples, predictor):
    crocoddyl = pytest.importorskip("crocoddyl", reason="crocoddyl is not installed")
    names = {}
    exec(examples[5], names)
    state = crocoddyl.StateVector(2)
    costs = crocoddyl.CostModelSum(state, 1)
    costs.addCost("u", crocoddyl.CostModelResidual(state, crocoddyl.ResidualModelControl(state, 1)), 0.1)
    model = names["LearnedForces"](predictor, costs)
    rough = crocoddyl.DifferentialActionModelNumDiff(model, False)
    x, u = np.array([0.3, -0.4]), np.array([1.5])
    exact, found = (each.createData() for each in (model, rough))
    for each, data in ((model, exact), (rough, found)):
        each.calc(data, x, u)
        each.calcDiff(data, x, u)
    np.testing.assert_allclose(exact.xout, predictor.mean(x[:1], x[1:], u))
    assert exact.cost == pytest.approx(0.05 * 1.5**2)
    for name in ("Fx", "Fu", "Lx", "Lu"):
        np.testing.assert_allclose(getattr(exact, name), getattr(found, name), atol=1e-5)
