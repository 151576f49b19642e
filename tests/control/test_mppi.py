"""Path integral control: what it finds is nearly optimal, within the limits, and it fails as documented."""

import numpy as np
import pytest
import scipy.linalg
import torch
from tests.goldens.compare import assert_unchanged

from forcegp import Dataset, JointFriction, Model, Noise, Robot, fit
from forcegp.control import MPPI
from forcegp.control.tracking import usual_integrator
from forcegp.errors import InvalidInput, NumericalError
from forcegp.forces import Viscous

MASS, DT, STEPS = 2.0, 0.05, 30
STATE_COST, TORQUE_COST = np.diag([1.0, 0.1]), 0.01
SLIDER = """<robot name="slider"><link name="base"/>
<link name="cart"><inertial><mass value="2"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="rail" type="prismatic"><parent link="base"/><child link="cart"/><axis xyz="1 0 0"/>
<limit lower="-9" upper="9" velocity="9" effort="9"/></joint></robot>"""


@pytest.fixture(scope="module")
def predictor():
    """A cart of 2 kg whose friction is nothing: what was learned is a double integrator."""
    model = Model(Robot.from_urdf_text(SLIDER))
    q, v, u = np.random.default_rng(0).uniform(-2.0, 2.0, (3, 20, 1))
    rows = Dataset(q=q, v=v, u=u, a=u / MASS, time=np.arange(20) * 0.1, model=model)
    return fit(model.with_forces(JointFriction(), noise=Noise(0.01, learn=False)), rows, restarts=1).predictor()


def cost(q, v, u):
    state = torch.cat([q, v], dim=-1)
    return ((state @ torch.tensor(STATE_COST)) * state).sum((-1, -2)) + TORQUE_COST * u.square().sum((-1, -2))


def controller(predictor, **changes):
    settings = {"dt": DT, "steps": STEPS, "torque_limits": 9.0, "integrator": "rk4", "seed": 1}
    return MPPI(predictor, changes.pop("cost", cost), **settings | changes)


def prepared(control):
    for _ in range(20):
        control.plan = control.improved(control.plan, torch.ones(1), torch.zeros(1))
    return control


def played(control, steps=80):
    """Summed cost of a motion from 1 m at rest under a controller (q, v) -> u, in closed form for constant u."""
    q, v, total, torques = np.array([1.0]), np.zeros(1), 0.0, []
    for _ in range(steps):
        u, state = np.asarray(control(q, v)), np.concatenate([q, v])
        total += state @ STATE_COST @ state + TORQUE_COST * float(u @ u)
        q, v = q + DT * v + 0.5 * DT**2 * u / MASS, v + DT * u / MASS
        torques.append(u)
    return total, np.array(torques)


def test_the_cost_is_nearly_that_of_the_linear_quadratic_regulator(predictor):
    A, B = np.array([[1.0, DT], [0.0, 1.0]]), np.array([[0.5 * DT**2 / MASS], [DT / MASS]])
    P = scipy.linalg.solve_discrete_are(A, B, STATE_COST, np.array([[TORQUE_COST]]))
    K = np.linalg.solve(TORQUE_COST + B.T @ P @ B, B.T @ P @ A)
    best, _ = played(lambda q, v: -K @ np.concatenate([q, v]))
    assert best == pytest.approx(P[0, 0], rel=0.01)
    found, _ = played(prepared(controller(predictor)))
    assert best * 0.999 < found < 1.03 * best


def test_torques_keep_their_limits_and_repeat_with_the_seed(predictor):
    first = controller(predictor, torque_limits=[1.5])
    _, torques = played(prepared(first), 20)
    assert np.abs(torques).max() <= 1.5 + 1e-12
    assert np.abs(torques[:3]).min() > 1.4  # far from the goal the limit binds
    first.restart()
    assert np.array_equal(played(prepared(first), 20)[1], torques)
    assert not np.array_equal(played(prepared(controller(predictor, torque_limits=[1.5], seed=2)), 20)[1], torques)


def test_without_a_finite_cost_it_raises(predictor):
    def broken_later(q, v, u):
        return cost(q, v, u) * (float("nan") if float(q[..., 0, 0].max()) > 5.0 else 1.0)

    with pytest.raises(NumericalError, match="none of 128 sequences"):
        controller(predictor, cost=broken_later)([6.0], [0.0])


@pytest.mark.parametrize(("damping", "wanted"), [(15.0, "rk4"), (15.0 * 1.8, "implicit-midpoint")])
def test_motions_are_implicit_where_a_step_is_long_beside_the_rates(damping, wanted):
    """The rate of viscous friction, near .75 and 1.35 per step of .1 s."""
    model = Model(Robot.from_urdf_text(SLIDER))
    q, v, u = np.random.default_rng(0).uniform(-2.0, 2.0, (3, 20, 1))
    v[0] = 0.0
    rows = Dataset(q=q, v=v, u=u, a=(u - damping * v) / MASS, time=np.arange(20) * 0.1, model=model)
    forces = (Viscous(damping), JointFriction())
    posterior = fit(model.with_forces(*forces, noise=Noise(0.01, learn=False)), rows, restarts=1)
    assert usual_integrator(posterior.predictor(covariance="none"), 0.1) == wanted
    assert MPPI(posterior.predictor(covariance="none"), cost, dt=0.1, steps=3, torque_limits=9.0).integrator == wanted


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"torque_limits": 0.0}, "torque_limits are zero in every joint"),
        ({"torque_limits": [1.0, 2.0]}, r"torque_limits has shape \(2,\) on cpu; give one number, or 1"),
        ({"torque_limits": np.inf}, "noise is infinite"), ({"steps": 0}, "steps"), ({"dt": 0.0}, "time step"),
        ({"cost": 3}, "give a function of motions"),
    ],
)  # fmt: skip
def test_arguments_that_do_not_fit(predictor, changes, message):
    with pytest.raises(InvalidInput, match=message):
        controller(predictor, **changes)([0.0], [0.0])


def test_states_and_costs_of_another_shape(predictor):
    with pytest.raises(InvalidInput, match="q is"):
        controller(predictor)([0.0, 1.0], [0.0])
    with pytest.raises(InvalidInput, match="v is"):
        controller(predictor)([0.0], [np.nan])
    with pytest.raises(InvalidInput, match="one number per motion"):
        controller(predictor, cost=lambda q, v, u: q)([0.0], [0.0])
    with pytest.raises(InvalidInput, match="give a Predictor"):
        MPPI(None, cost, dt=DT, steps=2, torque_limits=1.0)


def test_plans_are_what_they_were(predictor):
    control = controller(predictor, torque_limits=[1.5])
    torques = played(control, 12)[1]
    found = {f"{dt}": usual_integrator(predictor, dt) for dt in (1e-3, 0.05, 0.5)}
    assert_unchanged("control/plans", {"torques": torques, "plan": control.plan, **found})
