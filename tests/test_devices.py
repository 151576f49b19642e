"""Everything computes on the device of its robot: on a pretended one here, on real ones where they are."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.devices import DEVICES, PRETEND, MixedDevices, PretendTensor, pretend_device
from tests.inference.dense import dense_covariance
from tests.posterior.arm import arm_data, arm_model
from torch.testing import assert_close

from forcegp.errors import InvalidInput
from forcegp.evidence import MarginalLikelihood, TrainingData
from forcegp.fit import fit
from forcegp.forces import Coulomb, JointForces, Viscous, parse_forces
from forcegp.inference import OptimizerOptions
from forcegp.noise import Noise
from forcegp.posterior import load_posterior, save_posterior
from forcegp.robots.arguments import usable_device

QUICK = OptimizerOptions(iterations=2)
PRIORS = (
    "gp:joint", "gp:load-friction,gp:joint-friction", "gp:tool-friction", "gp:joint-position",
    "gp:joint:kernel=matern-3/2",
)  # fmt: skip

pytestmark = pytest.mark.filterwarnings("ignore::forcegp.errors.NumericalWarning", "ignore::forcegp.errors.DataWarning")


def states(device, rows=4):
    generator = torch.Generator().manual_seed(1)
    return [torch.rand(rows, 3, generator=generator, dtype=torch.float64).to(device) for _ in range(3)]


def numbers(values):
    return values.inner if isinstance(values, PretendTensor) else values.cpu()


# ---------------------------------------------------------------- the pretended device finds what it must


def test_the_pretended_device_computes_and_differentiates():
    with pretend_device():
        x = torch.tensor([1.0, 2.0, 3.0], device=PRETEND, dtype=torch.float64)
        (slope,) = torch.autograd.grad((x.requires_grad_() ** 2).sum(), x)
        assert isinstance(slope, PretendTensor)
        assert slope.device == PRETEND
        assert slope.inner.tolist() == [2.0, 4.0, 6.0]
        drawn = torch.randn(2, generator=torch.Generator(device=PRETEND).manual_seed(0), device=PRETEND)
        assert drawn.inner.shape == (2,)
        view = torch.eye(2, device=PRETEND)
        view.diagonal().add_(1.0)
        assert view.inner.tolist() == [[2.0, 0.0], [0.0, 2.0]]


@pytest.mark.parametrize(
    "mix",
    [
        lambda x, y: x + y, lambda x, y: torch.cat([x, y]), lambda x, y: x[torch.tensor([0, 1])],
        lambda x, y: torch.stack([x[0], y[0]]),
        lambda x, y: torch.randn(2, generator=torch.Generator(), device=PRETEND),
    ],
    ids=["sum", "cat", "index", "stack of numbers", "generator"],
)  # fmt: skip
def test_what_a_gpu_refuses_is_refused(mix):
    with pretend_device():
        x = torch.ones(3, device=PRETEND)
        with pytest.raises(MixedDevices):
            mix(x, torch.ones(3))


def test_numbers_of_the_cpu_may_join_and_trips_to_the_host_are_counted():
    with pretend_device() as trips:
        x = 2.0 * torch.ones(3, device=PRETEND) * torch.tensor(3.0)
        assert not trips
        assert (float(x[0]), x.tolist(), x.cpu().tolist()) == (6.0, [6.0] * 3, [6.0] * 3)
        assert bool((x > 0).all())
        with pytest.raises(RuntimeError, match="numpy"):
            x.numpy()
    assert trips == {"number": 2, "tolist": 1, "copy": 1}


# ---------------------------------------------------------------- the library on the pretended device


def test_robots_and_constrained_dynamics_never_wait_for_the_host():
    model = arm_model()
    forces = (*model.forces, Viscous(0.1), Coulomb([0.1, 0.2, 0.3]))
    model = replace(model, forces=forces)
    expected = model.dynamics(*states("cpu"))
    with pretend_device() as trips:
        there = model.to(PRETEND)
        q, v, u = states(PRETEND)
        trips.clear()  # of the checks of friction coefficients
        robot = there.robot
        results = (robot.mass_matrix(q), robot.bias_forces(q, v), robot.inverse_dynamics(q, v, u))
        results += (robot.forward_dynamics(q, v, u), robot.gravity_forces(q))
        dynamics = there.dynamics(q, v, u)
        assert not trips
        assert all(isinstance(x, PretendTensor) for x in results)
        for name in ("M", "A", "b", "H", "Q_K"):
            assert_close(getattr(dynamics, name).inner, getattr(expected, name))


@pytest.mark.parametrize("prior", PRIORS)
def test_the_likelihood_waits_for_a_few_flags_whatever_the_number_of_rows(prior):
    counts, values, conditions = [], [], []
    for rows in (6, 12):
        data = arm_data(rows, seed=1)
        model = data.model.with_forces(parse_forces(prior))
        plain = likelihood_and_gradients(model, data, torch.device("cpu"))[1:]
        conditions.append(condition_number(model, data))
        with pretend_device() as trips:
            model = data.model.to(PRETEND).with_forces(parse_forces(prior))
            before, value, slopes = likelihood_and_gradients(model, data, PRETEND, trips)
        assert not (trips - before).keys() & {"copy", "tolist"}
        counts.append((trips - before)["number"])
        values.append((numbers(value), plain[0]))
        for name, slope in slopes.items():
            assert_close(numbers(slope), plain[1][name], rtol=1e-6, atol=1e-6)
    assert counts[0] == counts[1] <= 6
    # y^T K^-1 y by two orders of the same operations: eps cond(K), times 10 for their number. Positions alone
    # do not explain these accelerations, so that their value rests on the noise, with a large cond(K).
    for (there, here), condition in zip(values, conditions, strict=True):
        bound = 10.0 * torch.finfo(torch.float64).eps * condition
        assert float(there) == pytest.approx(float(here), rel=max(bound, 1e-12))


def condition_number(model, data) -> float:
    """Of the dense covariance of all accelerations, at the start."""
    likelihood = MarginalLikelihood(model, TrainingData.of(data, torch.device("cpu")))
    kernels = likelihood.kernels
    parameters = kernels.initial_parameters() | Noise(0.05).parameters(3, torch.device("cpu"))
    terms = likelihood.terms(parameters)
    matrices = kernels.matrices(parameters, terms.features)
    return float(torch.linalg.cond(dense_covariance(terms.W, terms.noise, matrices).detach()))


def likelihood_and_gradients(model, data, device, trips=None):
    likelihood = MarginalLikelihood(model, TrainingData.of(data, device))
    kernels = likelihood.kernels
    parameters = kernels.initial_parameters() | Noise(0.05).parameters(3, device)
    parameters = {name: value.clone().requires_grad_() for name, value in parameters.items()}
    likelihood.terms(parameters)  # what does not depend on parameters is computed once
    before = trips.copy() if trips is not None else None
    value = likelihood(kernels, parameters)
    slopes = torch.autograd.grad(value, list(parameters.values()))
    return before, value.detach(), dict(zip(parameters, slopes, strict=True))


@pytest.mark.parametrize(
    ("prior", "integrators"),
    [
        pytest.param(
            "gp:load-friction:expected=0.1,gp:joint-friction", ["symplectic-euler"], marks=pytest.mark.nightly
        ),
        ("gp:joint:kernel=matern-3/2", ["rk4"]),
    ],
)
def test_structured_models_on_the_pretended_device(prior, integrators, tmp_path):
    data, test = arm_data(14, seed=1), arm_data(3, seed=2)
    posterior = fit(data.model.with_forces(parse_forces(prior)), data.rows(slice(0, 10)), restarts=1, options=QUICK)
    expected = posterior.predict(test.q, test.v, test.u)
    with pretend_device():
        there = posterior.to(PRETEND)
        prediction = there.predict(test.q, test.v, test.u)
        for name in ("acceleration", "multiplier", "contact_force", "unknown_force"):
            for part in ("mean", "covariance"):
                found, known = (getattr(getattr(p, name), part) for p in (prediction, expected))
                assert_close(found.inner, known, rtol=1e-7, atol=1e-7)
        there.components(test.q, test.v, test.u)
        for integrator in integrators:
            motion = there.rollout(test.q[0], test.v[0], test.u[:1], 0.001, integrator=integrator, samples=2)
            assert isinstance(motion.q, PretendTensor)
        assert isinstance(there.update(data.rows(slice(10, 14))).latent.system.factor.lower, PretendTensor)
        assert there.negative_log_likelihood == pytest.approx(posterior.negative_log_likelihood)
        save_posterior(there, tmp_path / "model")
    assert torch.equal(load_posterior(tmp_path / "model").predict(test.q, test.v, test.u).mean, expected.mean)


def test_inducing_points_on_the_pretended_device():
    data, test = arm_data(16, seed=10), arm_data(2, seed=11)
    posterior = fit(data.model.with_forces(JointForces()), data, restarts=1, options=QUICK, engine="inducing")
    expected = posterior.predict(test.q, test.v, test.u)
    with pretend_device():
        found = posterior.to(PRETEND).predict(test.q, test.v, test.u)
        assert_close(found.mean.inner, expected.mean, rtol=1e-6, atol=1e-6)
        assert_close(found.covariance.inner, expected.covariance, rtol=1e-6, atol=1e-6)


@pytest.mark.nightly
def test_independent_processes_on_the_pretended_device():
    data, how = arm_data(24, seed=5), {"restarts": 1, "options": QUICK}
    expected = fit(data.model.black_box(), data, **how)
    with pretend_device():
        fitted = fit(data.model.to(PRETEND).black_box(), data, **how)
        for posterior in (fitted, expected.to(PRETEND)):
            mean = posterior.predict(data.q[:3], data.v[:3], data.u[:3]).mean
            assert_close(mean.inner, expected.predict(data.q[:3], data.v[:3], data.u[:3]).mean, rtol=1e-6, atol=1e-6)


# ---------------------------------------------------------------- real devices


@pytest.mark.parametrize("device", DEVICES)
def test_a_fit_on_a_real_device_is_that_on_the_cpu(device):
    data, test = arm_data(40, seed=6), arm_data(5, seed=7)
    how = {"restarts": 1, "options": OptimizerOptions(iterations=10)}
    expected = fit(data.model.with_forces(JointForces()), data, **how)
    found = fit(data.model.to(device).with_forces(JointForces()), data, **how)
    assert found.predict(test.q, test.v, test.u).mean.device.type == device
    assert found.result.value == pytest.approx(expected.result.value, rel=1e-4)
    there, states_ = expected.to(device), (test.q, test.v, test.u)
    assert_close(there.predict(*states_).covariance.cpu(), expected.predict(*states_).covariance, rtol=1e-6, atol=1e-9)
    motions = [p.rollout(test.q[0], test.v[0], test.u, 0.001, samples=2).q.cpu() for p in (there, expected)]
    assert_close(*motions, rtol=1e-7, atol=1e-9)
    grown = [p.update(arm_data(5, seed=8)).predict(*states_).mean.cpu() for p in (there, expected)]
    assert_close(*grown, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("device", ["gpu", "cuda:999"])
def test_devices_that_are_not_there_are_refused_with_those_that_are(device):
    with pytest.raises(InvalidInput, match=r"cannot be used here; there is cpu"):
        usable_device(device)
    with pytest.raises(InvalidInput, match="there is cpu"):
        arm_model().to(device)


def test_moving_keeps_where_a_posterior_was_carried_and_what_standardises_it():
    data = arm_data(14, seed=9)
    posterior = fit(data.model.with_forces(JointForces()), data.rows(slice(0, 10)), restarts=1, options=QUICK)
    posterior = posterior.update(data.rows(slice(10, 14))).with_contacts([])
    again = posterior.to("cpu")
    assert again.target is not None
    np.testing.assert_array_equal(again.training.reference.q, posterior.training.reference.q)
    assert_close(
        again.predict(data.q, data.v, data.u).mean, posterior.predict(data.q, data.v, data.u).mean, rtol=1e-8, atol=1e-9
    )
