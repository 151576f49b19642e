"""Rollouts of a fitted model: against a loop over `predict`, on the surface, and as functions drawn from the model."""

import numpy as np
import pytest
import torch
from tests.posterior.arm import arm_data, arm_model

from forcegp.errors import InvalidInput, NumericalWarning
from forcegp.fit import fit
from forcegp.forces import JointForces, Viscous
from forcegp.inference import OptimizerOptions
from forcegp.mechanics import Baumgarte
from forcegp.posterior.rollout import Rollout, predicted
from forcegp.simulation import QuadrupedConfig
from forcegp.simulation.moving_bases import simulate_quadruped

DT, STEPS = 1 / 240, 12
QUICK = {"restarts": 1, "options": OptimizerOptions(iterations=15)}


@pytest.fixture(scope="module")
def data():
    return arm_data(40, seed=0)


@pytest.fixture(scope="module")
def posterior(data):
    return fit(data.model.with_forces(JointForces()), data, points=20, **QUICK)


@pytest.fixture(scope="module")
def start(data):
    """Two states on the plane and gravity-compensating torques (2, T, nv)."""
    q, v = torch.tensor(data.q[:2]), 0.3 * torch.tensor(data.v[:2])
    return q, v, data.model.robot.gravity_forces(q)[:, None].repeat(1, STEPS, 1)


def test_symplectic_euler_is_a_loop_over_predict(data, start):
    posterior = fit(arm_model(baumgarte=None).with_forces(JointForces()), data, points=20, **QUICK)
    q, v, u = start
    rollout = posterior.rollout(q, v, u, DT)
    for k in range(STEPS):
        a = posterior.predict(q, v, u[:, k], covariance=False).mean
        torch.testing.assert_close(rollout.a[:, k], a, rtol=1e-9, atol=1e-9)
        v = v + DT * a
        q = q + DT * v
    torch.testing.assert_close(rollout.q[:, -1], q, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(rollout.v[:, -1], v, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(rollout.time, DT * torch.arange(STEPS + 1, dtype=torch.float64))
    assert rollout.samples is None
    assert (rollout.diverged_at == -1).all()


@pytest.mark.parametrize(("damping", "dt", "chosen"), [(1.9, 0.02, "implicit-midpoint"), (0.2, 0.02, "rk4")])
def test_motions_that_friction_is_too_stiff_for_are_implicit(damping, dt, chosen):
    free = arm_model(0)
    stiff = fit(free.with_forces(Viscous(damping)), arm_data(20, 1, free))
    q, v = torch.tensor([[0.2, 0.4, -0.5]]), torch.tensor([[1.0, -0.5, 0.3]])
    u = free.robot.gravity_forces(q)[:, None].repeat(1, 50, 1)
    found = predicted(stiff, q.double(), v.double(), u.double(), dt, "rk4")
    assert found.integrator == chosen
    exact = stiff.rollout(q.double(), v.double(), u.repeat_interleave(200, 1).double(), dt / 200, integrator="rk4")
    torch.testing.assert_close(found.q[:, -1], exact.q[:, -1], rtol=0.0, atol=3e-3)


def test_other_motions_that_end_stay_as_they_are_with_a_warning(posterior, start):
    q, v, u = start
    with pytest.warns(NumericalWarning, match="2 of 2 rollouts diverged"):
        assert predicted(posterior, q, v, 1e7 * u, DT, "rk4").integrator == "rk4"


def test_the_stabilisation_is_the_one_of_the_rollout_and_not_of_the_data(posterior, start):
    q, v, u = start
    q = q + 1e-3  # off the plane
    assert posterior.model.baumgarte == Baumgarte(5.0)
    for baumgarte in (None, Baumgarte(20.0, 0.7)):
        rollout = posterior.rollout(q, v, u[:, :1], DT, baumgarte=baumgarte)
        dynamics = arm_model(baumgarte=baumgarte).dynamics(q, v, u[:, 0])
        torch.testing.assert_close((dynamics.A @ rollout.a[:, 0, :, None])[..., 0], dynamics.b, rtol=1e-9, atol=1e-10)


def test_the_constraint_is_that_of_the_contacts(posterior, start):
    q, v, u = start
    contact, robot = posterior.model.contacts[0], posterior.model.robot
    loose = posterior.rollout(q + 1e-3, v, u, DT, integrator="rk4")
    torch.testing.assert_close(loose.constraint[..., 0], contact.distance(robot.kinematics(loose.q)))


def test_a_motion_that_is_lost_has_no_distance_from_its_contacts_and_no_error():
    data = simulate_quadruped(QuadrupedConfig(seconds=0.1))
    q, v = (torch.tensor(x[:3]) for x in (data.q, data.v))
    lost = q.clone()
    lost[1] = torch.nan
    c, known = (Rollout(v[:, 0], each, v, v, torch.tensor(-1), "rk4", data.model).constraint for each in (lost, q))
    assert torch.isnan(c[1]).all()
    assert known.shape == (3, 12)
    torch.testing.assert_close(c[[0, 2]], known[[0, 2]], rtol=0.0, atol=0.0)


def test_samples_are_functions_that_obey_the_constraint(posterior, start):
    q, v, u = start
    rollout = posterior.rollout(q, v, u, DT, baumgarte=Baumgarte(10.0), samples=5, seed=3)
    drawn = rollout.samples
    assert drawn.q.shape == (5, 2, STEPS + 1, 3)
    assert drawn.a.shape == (5, 2, STEPS, 3)
    dynamics = arm_model(baumgarte=Baumgarte(10.0)).dynamics(drawn.q[..., :-1, :], drawn.v[..., :-1, :], u)
    assert ((dynamics.A @ drawn.a[..., None])[..., 0] - dynamics.b).abs().max() <= 1e-10
    assert drawn.a[:, :, 0].std(0).max() > 1e-4  # they differ
    again = posterior.rollout(q, v, u, DT, baumgarte=Baumgarte(10.0), samples=5, seed=3)
    torch.testing.assert_close(again.samples.q, drawn.q, rtol=0, atol=0)
    other = posterior.rollout(q, v, u, DT, baumgarte=Baumgarte(10.0), samples=5, seed=4)
    assert (other.samples.q - drawn.q).abs().max() > 1e-9
    torch.testing.assert_close(rollout.std("v"), drawn.v.std(0))
    low, high = rollout.interval("v")
    rank = torch.sort(drawn.v, dim=0).values
    torch.testing.assert_close(low, rank[0] + 0.1 * (rank[1] - rank[0]))  # 2.5 % of the way through five
    torch.testing.assert_close(high, rank[4] - 0.1 * (rank[4] - rank[3]))


def test_first_sampled_accelerations_have_the_predicted_distribution(posterior, start):
    q, v, u = (x[0] for x in start)
    first = posterior.rollout(q, v, u[:1], DT, baumgarte=Baumgarte(5.0), samples=1500, seed=0).samples.a[:, 0]
    expected = posterior.predict(q, v, u[0])
    assert ((first.mean(0) - expected.mean).abs() <= 5.0 * expected.std / np.sqrt(1500) + 1e-9).all()
    scale = expected.covariance.diagonal().max()
    torch.testing.assert_close(torch.cov(first.mT), expected.covariance, rtol=0.14, atol=0.14 * float(scale))


def test_a_model_without_unknown_forces_has_nothing_to_draw(data, start):
    q, v, u = start
    rollout = fit(data.model, data, points=10, **QUICK).rollout(q, v, u, DT, samples=2)
    torch.testing.assert_close(rollout.samples.q, rollout.q.expand(2, -1, -1, -1), rtol=1e-12, atol=1e-12)


def test_without_samples_there_is_no_interval(posterior, start):
    with pytest.raises(InvalidInput, match=r"has 0 samples, 1 are needed; ask for rollout\(\.\.\., samples=20\)"):
        posterior.rollout(*start, DT).interval()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"q0": torch.zeros(2, 4)}, r"q0 has shape \(2, 4\); its last dimension must be 3"),
        ({"u": torch.zeros(3)}, r"u has shape \(3,\); it must be \(\.\.\., T, 3\)"),
        ({"u": torch.zeros(0, 3)}, "u has no rows"),
        ({"v0": torch.full((3,), float("nan"))}, "v0 has values that are not finite"),
        ({"v0": torch.zeros(3, 3)}, "shapes do not broadcast"),
        ({"q0": "here"}, "q0 must be an array of real numbers"), ({"q0": torch.zeros(0, 1, 3)}, "no motion at all"),
        ({"samples": -1}, "samples=-1"), ({"seed": -1}, "seed=-1"),
        ({"integrator": "euler"}, "no integrator 'euler' in forcegp; did you mean 'symplectic-euler'"),
        ({"dt": 0.0}, r"dt is 0\.0"),
    ],
)  # fmt: skip
def test_wrong_arguments_are_named(posterior, start, changed, message):
    q, v, u = start
    arguments = {"q0": q, "v0": v, "u": u, "dt": DT} | changed
    with pytest.raises(InvalidInput, match=message):
        posterior.rollout(**arguments)


@pytest.mark.parametrize("integrator", ["symplectic-euler", "rk4"])
def test_feedback_is_asked_once_per_step_and_acts_until_the_next(posterior, start, integrator):
    q, v, u = start
    gains, asked = torch.linspace(0.5, 2.0, STEPS, dtype=torch.float64), []

    def feedback(k, q, v):
        asked.append((k, q.clone(), v.clone()))
        return u[:, k] - gains[k] * v

    rollout = posterior.rollout(q, v, 0.0 * u, DT, integrator=integrator, feedback=feedback)
    assert [k for k, _, _ in asked] == list(range(STEPS))
    torch.testing.assert_close(torch.stack([at for _, at, _ in asked], dim=1), rollout.q[:, :-1], rtol=0, atol=0)
    torch.testing.assert_close(torch.stack([rate for _, _, rate in asked], dim=1), rollout.v[:, :-1], rtol=0, atol=0)
    same = posterior.rollout(q, v, u - gains[:, None] * rollout.v[:, :-1], DT, integrator=integrator)
    torch.testing.assert_close(rollout.q, same.q, rtol=1e-12, atol=1e-12)
    assert not torch.allclose(rollout.v, posterior.rollout(q, v, u, DT, integrator=integrator).v, atol=1e-6)


def test_feedback_of_another_shape_is_refused(posterior, start):
    q, v, u = start
    with pytest.raises(InvalidInput, match=r"feedback .*\(3,\) at step 0.*\(2, 3\)"):
        posterior.rollout(q, v, u, DT, feedback=lambda k, q, v: torch.zeros(3).double())


def test_a_gradient_is_never_dropped_in_silence(posterior, start):
    arguments = dict(zip(("q0", "v0", "u"), start, strict=True))
    for name in arguments:
        changed = {**arguments, name: arguments[name].clone().requires_grad_()}
        with pytest.raises(InvalidInput, match=rf"{name} requires a gradient.*_step, and give {name}\.detach\(\)"):
            posterior.rollout(**changed, dt=DT)
        with torch.no_grad():  # asked for without a graph on purpose
            assert not posterior.rollout(**changed, dt=DT).q.requires_grad
