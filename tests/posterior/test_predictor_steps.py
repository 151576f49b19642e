"""Steps, forces and inverse dynamics of a predictor: against rollouts, finite differences and `predict`."""

import pytest
import torch
from tests.posterior.arm import arm_model, quick_fit

from forcegp.errors import InvalidInput
from forcegp.forces import ContactFriction, JointForces, JointFriction, RigidBodies, ToolForces
from forcegp.posterior import Posterior

DT, INTEGRATORS = 0.02, ["symplectic-euler", "rk4", "implicit-midpoint"]
PRIORS = {
    "joint": JointForces(),  # has u among its features
    "friction under load": (JointFriction(), ContactFriction(load=True, expected=0.2)),
    "friction under nominal load": (JointFriction(), ContactFriction(load=True)),
    "tool forces on place": (JointFriction(), ToolForces(inputs=("velocity", "position"))),
    "none": (),
}


@pytest.fixture(scope="module", params=PRIORS)
def posterior(request) -> Posterior:
    return quick_fit(arm_model().with_forces(PRIORS[request.param]))


@pytest.fixture(scope="module")
def smooth() -> Posterior:
    return quick_fit(arm_model().with_forces(JointForces()))


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_step_is_that_of_a_rollout(posterior, states, integrator):
    predictor = posterior.predictor(covariance="none", compile=False)
    q, v = predictor.step(*states, DT, integrator)
    rollout = posterior.rollout(
        *states[:2], states[2][:, None], DT, integrator=integrator, baumgarte=posterior.model.baumgarte
    )
    torch.testing.assert_close(q, rollout.q[:, 1], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(v, rollout.v[:, 1], rtol=1e-9, atol=1e-9)
    alone = predictor.step(*(x[1].tolist() for x in states), DT, integrator)
    torch.testing.assert_close(alone, (q[1], v[1]), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("compile", [True, False])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_the_linear_model_is_the_step_there_and_has_its_finite_differences(smooth, states, integrator, compile):
    predictor = smooth.predictor(covariance="none", compile=compile)
    linear = predictor.linearize_step(*states, DT, integrator)
    q, v, u = states
    there = torch.cat(predictor.step(q, v, u, DT, integrator), dim=-1)
    torch.testing.assert_close(torch.cat([linear.q, linear.v], dim=-1), there, rtol=1e-10, atol=1e-10)
    x = torch.cat([q, v], dim=-1)
    affine = (linear.A @ x[..., None] + linear.B @ u[..., None])[..., 0] + linear.c
    torch.testing.assert_close(affine, there, rtol=1e-10, atol=1e-10)
    for column, direction in zip(range(0, 9, 2), torch.eye(9, dtype=torch.float64)[::2], strict=True):
        ahead, behind = (
            torch.cat(predictor.step(*(torch.cat([x, u], -1) + h * direction).chunk(3, -1), DT, integrator), dim=-1)
            for h in (1e-5, -1e-5)
        )
        slope = torch.cat([linear.A, linear.B], dim=-1)[..., column]
        torch.testing.assert_close(slope, (ahead - behind) / 2e-5, rtol=1e-6, atol=1e-6)
    alone = predictor.linearize_step(*(part[2] for part in states), DT, integrator)
    assert [tuple(part.shape) for part in alone] == [(3,), (3,), (6, 6), (6, 3), (6,)]
    for found, expected in zip(alone, linear, strict=True):
        torch.testing.assert_close(found, expected[2], rtol=1e-8, atol=1e-8)


def test_a_step_is_differentiable(smooth, states):
    predictor = smooth.predictor(covariance="none", compile=False)
    x = [part[:2].clone().requires_grad_() for part in states]
    for integrator in INTEGRATORS:
        assert torch.autograd.gradcheck(lambda *x: predictor.step(*x, DT, integrator), x, fast_mode=True)  # noqa: B023


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"dt": 0.0}, r"dt is 0\.0; give the time step as a positive number"),
        ({"dt": True}, "dt is True; give the time step"),
        ({"integrator": "rk5"}, "no integrator 'rk5'.*did you mean 'rk4'"),
        ({"u": torch.zeros(2, 3)}, r"q \(5, 3\), v \(5, 3\), u \(2, 3\)"),
    ],
)
def test_wrong_arguments_of_a_step_are_named(smooth, states, changed, message):
    predictor = smooth.predictor(covariance="none", compile=False)
    arguments = dict(zip("qvu", states, strict=True)) | {"dt": DT} | changed
    for ask in (predictor.step, predictor.linearize_step):
        with pytest.raises(InvalidInput, match=message):
            ask(**arguments)


def test_inverse_dynamics_is_predict_read_backwards(posterior, states):
    q, v, u = states
    predictor, expected = posterior.predictor(covariance="exact", compile=False), posterior.predict(q, v, u)
    back = predictor.inverse_dynamics(q, v, expected.mean, expected.multiplier.mean)
    torch.testing.assert_close(back.mean, u, rtol=1e-9, atol=1e-9)
    for wanted in ([12.0], torch.tensor([[3.0], [-2.0], [7.0], [40.0], [1.0]]).double(), None):
        found = predictor.inverse_dynamics(q, v, expected.mean, wanted)
        forward = posterior.predict(q, v, found.mean)
        multiplier = torch.zeros(5, 1).double() if wanted is None else torch.as_tensor(wanted).double().expand(5, 1)
        torch.testing.assert_close(forward.mean, expected.mean, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(forward.multiplier.mean, multiplier, rtol=1e-9, atol=1e-9)
        assert (torch.linalg.eigvalsh(found.covariance) >= -1e-12).all()
    alone = predictor.inverse_dynamics(q[1], v[1], expected.mean[1], [40.0])
    assert alone.mean.shape == (3,)
    assert alone.covariance.shape == (3, 3)


def test_inverse_dynamics_refuses_what_it_cannot_solve(smooth, states):
    predictor = smooth.predictor(covariance="none", compile=False)
    with pytest.raises(InvalidInput, match=r"normal_force has shape \(2,\); give \(1,\) or \(5, 1\)"):
        predictor.inverse_dynamics(*states, [1.0, 2.0])
    with pytest.raises(InvalidInput, match=r"q \(5, 3\), v \(5, 3\), a \(3,\)"):
        predictor.inverse_dynamics(*states[:2], torch.zeros(3))
    carried = quick_fit(arm_model().with_forces(JointForces()).without_mean())
    with pytest.raises(InvalidInput, match="no RigidBodies"):
        carried.predictor(covariance="none", compile=False).inverse_dynamics(*states)
    passive = smooth.with_model(arm_model(forces=(RigidBodies(),)))
    with pytest.raises(InvalidInput, match=r"no Actuation\(\) among its laws"):
        passive.predictor(covariance="none", compile=False).inverse_dynamics(*states)
