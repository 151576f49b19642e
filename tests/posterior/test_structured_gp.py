"""Fitting and predicting with the structured model."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.evidence.test_contact_forces import QUICK, held, measured, on_plane, tensors
from tests.posterior.arm import NOISE, URDF, arm_data, arm_model, quick_fit

from forcegp import Accelerations, ContactForces, Viscous
from forcegp.data import Dataset
from forcegp.errors import ContactError, DataWarning, InvalidInput
from forcegp.fit import fit
from forcegp.fit.physical import typical_sizes
from forcegp.fit.unseen import OF_TORQUE
from forcegp.forces import JointForces
from forcegp.inference import OptimizerOptions
from forcegp.mechanics import Contact, Plane, fixed_point
from forcegp.noise import Noise
from forcegp.robots import Robot


@pytest.fixture(scope="module")
def train():
    return arm_data(60, seed=1)


@pytest.fixture(scope="module")
def test():
    return arm_data(200, seed=2)


@pytest.fixture(scope="module")
def posterior(train):
    return quick_fit(train.model.with_forces(JointForces()), train, 40)


def test_learns_the_friction_and_is_calibrated(posterior, test):
    prediction = posterior.predict(test.q, test.v, test.u)
    nominal = test.model.dynamics(*map(torch.tensor, (test.q, test.v, test.u))).acceleration_map().offset.numpy()
    assert np.abs(prediction.mean.numpy() - test.truth["a"]).mean() < 0.1 * np.abs(nominal - test.truth["a"]).mean()
    inside = np.abs(prediction.mean.numpy() - test.a) < 1.96 * prediction.measurement.std.numpy()
    assert 0.90 < inside.mean() < 0.99


def test_every_prediction_obeys_the_constraint(posterior, test):
    prediction = posterior.predict(test.q, test.v, test.u)
    dynamics = test.model.dynamics(*map(torch.tensor, (test.q, test.v, test.u)))
    assert float(((dynamics.A @ prediction.mean[..., None])[..., 0] - dynamics.b).abs().max()) < 1e-10
    assert float((dynamics.A @ prediction.covariance @ dynamics.A.mT).abs().max()) < 1e-12
    assert float(torch.linalg.eigvalsh(prediction.covariance).min()) > -1e-12


def test_forces_and_acceleration_belong_together(posterior, test):
    prediction = posterior.predict(test.q, test.v, test.u)
    dynamics, Q_U = test.model.dynamics(*map(torch.tensor, (test.q, test.v, test.u))), prediction.unknown_force
    assert torch.allclose(dynamics.acceleration(Q_U.mean), prediction.mean, atol=1e-10)
    assert torch.allclose(dynamics.H @ Q_U.covariance @ dynamics.H.mT, prediction.covariance, atol=1e-10)
    assert torch.allclose(dynamics.multiplier(Q_U.mean), prediction.multiplier.mean, atol=1e-10)
    normals = dynamics.normals[:, 0]
    assert torch.allclose(prediction.contact_force.mean, normals * prediction.multiplier.mean, atol=1e-10)
    # M a = Q_K + Q_U + A^T lambda
    balance = dynamics.M @ prediction.mean[..., None] - dynamics.A.mT @ prediction.multiplier.mean[..., None]
    assert float((balance[..., 0] - dynamics.Q_K - Q_U.mean).abs().max()) < 1e-9


def test_equals_dense_gaussian_conditioning(posterior, train, test):
    """p(a*) from one joint covariance of all training accelerations, written plainly."""
    model, kernels = posterior.likelihood, list(posterior.latent.kernels)

    def parts(data):
        dynamics = train.model.dynamics(*map(torch.tensor, (data.q, data.v, data.u)))
        (scaled, *_) = model.standardization([torch.cat([torch.tensor(x) for x in (data.q, data.v, data.u)], -1)] * 3)
        return dynamics.H, dynamics.acceleration_map().offset, scaled

    H, m, z = parts(train)
    H_new, m_new, z_new = parts(test.rows(slice(0, 5)))
    S, cross = torch.zeros(60, 3, 60, 3).double(), torch.zeros(5, 3, 60, 3).double()
    prior = torch.zeros(5, 3, 3).double()
    for joint, kernel in enumerate(kernels):
        w, w_new = H[..., joint], H_new[..., joint]
        S += torch.einsum("id,ij,je->idje", w, kernel(z, z).to_dense(), w)
        cross += torch.einsum("id,ij,je->idje", w_new, kernel(z_new, z).to_dense(), w)
        prior += torch.einsum("id,ie->ide", w_new, w_new) * kernel.outputscale
    S, cross = S.reshape(180, 180) + NOISE**2 * torch.eye(180).double(), cross.reshape(5, 3, 180)
    mean = m_new + cross @ torch.linalg.solve(S, (torch.tensor(train.a) - m).reshape(-1))
    covariance = prior - cross @ torch.linalg.solve(S, cross.mT)

    prediction = posterior.predict(*(x[:5] for x in (test.q, test.v, test.u)))
    assert torch.allclose(prediction.mean, mean, atol=1e-8)
    assert torch.allclose(prediction.covariance, posterior.widening**2 * covariance, atol=1e-8)


def test_the_noise_is_learned(train):
    fitted = quick_fit(train.model.with_forces(JointForces(), noise=Noise(0.2, learn=True)), train, 60)
    assert np.allclose(fitted.noise_std.numpy(), NOISE, rtol=0.5)


def test_force_level_noise_widens_along_H(train, test):
    fitted = quick_fit(train.model.with_forces(JointForces(), noise=Noise(NOISE, 0.3)), train)
    prediction = fitted.predict(test.q[:4], test.v[:4], test.u[:4])
    H = test.model.dynamics(*(torch.tensor(x[:4]) for x in (test.q, test.v, test.u))).H
    expected = NOISE**2 * torch.eye(3).double() + 0.09 * H @ H.mT
    assert torch.allclose(prediction.noise_covariance, expected, atol=1e-12)


def test_the_objective_is_the_likelihood_times_the_priors(train):
    found = fit(train.model.with_forces(JointForces()), train, points=20, restarts=1, options=OptimizerOptions(10))
    priors = found.kernels.log_prior(found.hyperparameters) + found.likelihood.noise.log_prior(found.hyperparameters)
    assert float(priors.detach()) != 0.0
    assert found.result.value == pytest.approx(found.negative_log_likelihood - float(priors.detach()), abs=1e-6)


def test_a_dataset_of_another_robot_is_refused(train):
    renamed = Robot.from_urdf_text(URDF.replace('"pan"', '"yaw"'))
    with pytest.raises(InvalidInput, match="dataset are pan, lift, bend, those of the robot yaw, lift, bend"):
        fit(train.model.with_robot(renamed).with_forces(JointForces()), train)


def test_a_surface_that_no_row_touches_is_refused(train):
    raised = train.model.with_contacts((Contact("hand", (0.0, 0.0, 0.2), Plane((0.2, 0.0, 1.0), 0.9)),))
    with pytest.raises(ContactError, match=r"contact 0 \(frame 'hand'\).* 0\.49 m"):
        fit(raised.with_forces(JointForces()), train, points=10, restarts=1, options=OptimizerOptions(iterations=1))


def test_a_surface_that_most_rows_miss_is_pointed_out(train):
    low, high = arm_data(20, 5, train.model), arm_data(40, 6, arm_model(contacts=0))
    mixed = {name: np.concatenate([getattr(low, name), getattr(high, name)]) for name in ("q", "v", "u", "a")}
    data = Dataset(**mixed, time=np.arange(60.0), model=train.model, noise_std=train.noise_std)
    with pytest.warns(DataWarning, match=r"half of the training points .* rows in contact only"):
        fit(train.model.with_forces(JointForces()), data, restarts=1, options=OptimizerOptions(iterations=1))


def test_states_that_make_no_sense_are_refused(posterior, test):
    with pytest.raises(InvalidInput, match="last dimension must be 3"):
        posterior.predict(test.q[:, :2], test.v, test.u)
    with pytest.raises(InvalidInput, match="not finite"):
        posterior.predict(np.full(3, np.nan), np.zeros(3), np.zeros(3))
    with pytest.raises(InvalidInput, match="do not broadcast"):
        posterior.predict(test.q[:2], test.v[:3], test.u[:3])
    with pytest.raises(InvalidInput, match=r"is not an array of real numbers|must be an array of real numbers"):
        posterior.predict(["a", "b", "c"], test.v, test.u)


def test_predictions_given_accelerations_are_those_of_one_large_gaussian():
    model = replace(on_plane(JointForces(("q",))), noise=Noise(0.05, 0.02, learn=False, sensor=0.3))
    log = measured(on_plane(Viscous(0.7)), on_plane(), rows=20, noise=0.05)
    posterior = fit(model, log, [Accelerations(), ContactForces()], **QUICK)
    states, at = tensors(log, "q", "v", "u"), model.dynamics(*tensors(log, "q", "v", "u"))
    a, plain = torch.tensor(log.a) + 0.1, posterior.predict(*states)
    H, C = at.H, at.contact_force_map().matrix
    S = plain.unknown_force.covariance + torch.diag(posterior.hyperparameters["noise.log_force"].exp().square())
    G, mean = torch.cat([H, C], 1), torch.cat([plain.mean, plain.contact_force.mean], 1)
    whole = G @ S @ G.mT
    gain = whole[:, 3:, :3] @ torch.linalg.inv(whole[:, :3, :3] + 0.05**2 * torch.eye(3))
    expected = mean[:, 3:] + (gain @ (a - mean[:, :3])[..., None])[..., 0]
    spread, found = whole[:, 3:, 3:] - gain @ whole[:, :3, 3:], posterior.predict(*states, a=a).force_at("hand")
    torch.testing.assert_close(found.mean, expected, rtol=0.0, atol=1e-8)
    torch.testing.assert_close(found.covariance, spread, rtol=0.0, atol=1e-8)
    with pytest.raises(InvalidInput, match=r"no contact at 'fore'.*; there is hand"):
        posterior.predict(*states).force_at("fore")
    several = posterior.with_contacts(fixed_point("hand")).predict(*states)
    torch.testing.assert_close(several.force_at("hand").mean, several.contact_force.mean.unflatten(-1, (3, 3)).sum(-2))
    with pytest.raises(InvalidInput, match="a has shape"):
        posterior.predict(*states, a=a[:, :2])
    with pytest.raises(InvalidInput, match="batch shapes do not broadcast"):
        posterior.predict(*states, a=a[:2])


def test_what_contacts_hide_is_in_the_interval_of_their_force():
    log = measured(held(Viscous(0.7)), held(), rows=60)
    posterior = fit(held(Viscous()), replace(log, measured={}), Accelerations())
    h = torch.tensor(posterior.settings["hidden_force"])
    typical = typical_sizes(held(), [replace(log, measured={})])["force"]
    assert h.numpy() == pytest.approx(0.2 * typical)  # a leg, a UR10e: gains off by 10 to 16 % and friction
    assert OF_TORQUE == 0.2
    at = posterior.dynamics(*tensors(log, "q", "v", "u"))
    expected = torch.linalg.inv((at.A / h.square()) @ at.A.mT).diagonal(dim1=-2, dim2=-1)  # (A h^-2 A^T)^-1
    found = posterior.predict(*tensors(log, "q", "v", "u"))
    torch.testing.assert_close(found.multiplier.variance, expected, rtol=1e-5, atol=0.0)
    assert float(found.unseen.min()) > 0.999  # of a model without functions all is the prior
    assert float(found.variance.max()) < 1e-6 * float(expected.min())
    log = replace(log, noise_std=[0.05] * 3)
    sensed = fit(held(JointForces(("v",))), log, [Accelerations(), ContactForces()], **QUICK)
    assert "hidden_force" not in sensed.settings
    assert not bool(sensed.predict(*tensors(log, "q", "v", "u")).unseen.any())
    learned = fit(held(JointForces(("v",))), replace(log, measured={}), **QUICK)
    found = learned.predict(*tensors(log, "q", "v", "u"))
    seen = learned.with_settings(hidden_force=None).predict(*tensors(log, "q", "v", "u"))
    torch.testing.assert_close(found.unseen, 1.0 - seen.multiplier.variance / found.multiplier.variance)
    assert "not seen by the log" in str(found)
