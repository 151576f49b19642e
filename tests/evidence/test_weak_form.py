"""Learning from windows of positions or velocities instead of accelerations, through the public interface."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from tests.posterior.arm import URDF, arm_model
from tests.posterior.raw_log import SENSOR, motion

from forcegp import JointForces, JointFriction, Noise, RigidBodies, Windows, fit, load_posterior, save_posterior, score
from forcegp.data import Dataset
from forcegp.errors import FileFormatError, InvalidInput, NotEnoughMemory
from forcegp.evidence import MarginalLikelihood, TrainingData
from forcegp.forces import Body
from forcegp.inference import FunctionalPosterior, OptimizerOptions
from forcegp.posterior import Posterior
from forcegp.robots import Robot

HOW = Windows(0.1, nodes=8)
FIT = {"points": 24, "restarts": 1}


def with_true_accelerations(dataset: Dataset) -> Dataset:
    return replace(dataset, a=dataset.truth["a"])


@cache
def fitted() -> Posterior:
    data = motion()
    return fit(data.model.with_forces(JointFriction()), data, HOW, **FIT)


def test_positions_alone_teach_as_much_as_exact_accelerations():
    posterior, data = fitted(), with_true_accelerations(motion())
    test = with_true_accelerations(motion(seed=1))
    reference = fit(data.model.with_forces(JointFriction(), noise=Noise(0.01, learn=True)), data, **FIT)
    nothing = fit(data.model.with_forces(noise=Noise(1.0)), data, points=10)
    ours, best, without = (score(model, test, horizons=()).value("mae") for model in (posterior, reference, nothing))
    assert ours < 1.15 * best
    assert best < 0.2 * without


def test_the_noise_that_is_learned_is_that_of_the_sensors_in_a_window():
    windows = HOW.windows(motion(), 24)
    stated = SENSOR * np.linalg.norm(HOW.signal_weights(motion().time[None, :51])[0])
    np.testing.assert_allclose(windows.noise_level, stated, rtol=0.1)
    assert np.all(fitted().noise_std.numpy() < 2.0 * stated)
    assert np.all(fitted().noise_std.numpy() > 0.5 * stated)
    told = fitted().settings
    assert (told["points"], told["observe"]["name"], told["observe"]["seconds"]) == (24, "windows", 0.1)
    assert told["engine_reason"] == "exact: from 24 windows of 8 nodes"
    assert isinstance(fitted().latent, FunctionalPosterior)


def test_velocities_serve_as_well():
    how = replace(HOW, signal="v", order=1)
    data, test = motion(), with_true_accelerations(motion(seed=1))
    posterior = fit(data.model.with_forces(JointFriction()), data, how, **FIT)
    assert score(posterior, test, horizons=()).value("mae") < 1.3 * score(fitted(), test, horizons=()).value("mae")


def test_one_node_is_a_row_with_that_acceleration():
    data = motion()
    windows = replace(HOW, nodes=1).windows(data, 10)
    model = data.model.with_forces(JointForces(inputs=("q", "v")), noise=Noise(0.3, force=0.2))
    device = torch.device("cpu")
    observed, rows = TrainingData.of(windows, device), TrainingData.of(windows.nodes, device)
    likelihoods = [MarginalLikelihood(model, each) for each in (observed, rows)]
    kernels = likelihoods[1].kernels
    parameters = kernels.initial_parameters() | Noise(0.3, force=0.2).parameters(3)
    with torch.no_grad():
        left, right = (likelihood(kernels, parameters) for likelihood in likelihoods)
        torch.testing.assert_close(left, right)
        new = likelihoods[1].features
        posteriors = [likelihood.condition(kernels, parameters) for likelihood in likelihoods]
        torch.testing.assert_close(posteriors[0].mean(new), posteriors[1].mean(new))
        torch.testing.assert_close(posteriors[0].covariance(new), posteriors[1].covariance(new))


def test_gradients_of_the_likelihood_in_kernels_and_noise():
    data = motion()
    windows = replace(HOW, nodes=3).windows(data, 6)
    model = data.model.with_forces(JointFriction())
    likelihood = MarginalLikelihood(model, TrainingData.of(windows, torch.device("cpu")))
    kernels = likelihood.kernels
    parameters = kernels.initial_parameters() | Noise(0.3, force=0.2).parameters(3)
    names = list(parameters)

    def value(*values):
        return likelihood(kernels, dict(zip(names, values, strict=True)))

    leaves = [parameters[name].clone().requires_grad_() for name in names]
    gradients = torch.autograd.grad(value(*leaves), leaves)
    for name, leaf, gradient in zip(names, leaves, gradients, strict=True):
        direction = torch.randn(leaf.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        with torch.no_grad():
            moved = [[x + sign * 1e-5 * direction if x is leaf else x for x in leaves] for sign in (1, -1)]
            slope = (value(*moved[0]) - value(*moved[1])) / 2e-5
        assert float((gradient * direction).sum()) == pytest.approx(float(slope), rel=2e-5, abs=2e-5), name


def test_masses_are_learned_from_positions():
    wrong = arm_model(contacts=0).with_robot(Robot.from_urdf_text(URDF.replace('value="0.6"', 'value="0.9"')))
    data = replace(motion(), model=wrong)
    mass = RigidBodies({"hand": Body(parts=("mass",))})
    posterior = fit(wrong.with_forces(JointFriction(), mass), data, replace(HOW, nodes=4), **FIT)
    found = posterior.parameters["hand.mass"]
    assert found.start == pytest.approx(0.9)
    assert abs(found.value - 0.6) < 0.02
    assert abs(found.value - 0.6) < 3.0 * found.std


def test_a_stored_model_predicts_the_same_and_says_that_it_knows_windows(tmp_path):
    posterior, at = fitted(), motion(seed=1).rows(slice(0, 40))
    save_posterior(posterior, tmp_path / "run")
    loaded = load_posterior(tmp_path / "run")
    ours, theirs = (model.predict(at.q, at.v, at.u) for model in (posterior, loaded))
    torch.testing.assert_close(ours.mean, theirs.mean)
    torch.testing.assert_close(ours.covariance, theirs.covariance)
    assert len(loaded.training) == 24
    assert loaded.settings["observe"] == posterior.settings["observe"]
    broken = replace(posterior.training, weights=posterior.training.weights[:-1])
    object.__setattr__(posterior.likelihood, "training", broken)
    try:
        save_posterior(posterior, tmp_path / "broken")
    finally:
        object.__setattr__(posterior.likelihood, "training", loaded.training)
    with pytest.raises(FileFormatError, match="incomplete or damaged"):
        load_posterior(tmp_path / "broken")


def test_predictor_rollout_and_other_devices():
    posterior, at = fitted(), motion(seed=1).rows(slice(0, 5))
    prediction = posterior.predict(at.q, at.v, at.u)
    mean, covariance = posterior.predictor(compile=False)(at.q, at.v, at.u)
    torch.testing.assert_close(mean, prediction.mean)
    torch.testing.assert_close(covariance, prediction.covariance)
    moved = posterior.to("cpu").predict(at.q, at.v, at.u)
    torch.testing.assert_close(moved.mean, prediction.mean)
    motions = posterior.rollout(at.q[0], at.v[0], at.u, 0.002, samples=3)
    assert motions.samples is not None
    assert np.abs(motions.q[-1].numpy() - motion(seed=1).q[5]).max() < 1e-3


def test_what_needs_single_rows_is_refused_with_a_remedy():
    data, posterior = motion(), fitted()
    for attempt in (
        lambda: posterior.update(data.rows([1, 2])),
        lambda: posterior.predictor(covariance="compressed", compile=False),
    ):
        with pytest.raises(InvalidInput, match=r"windows|accelerations"):
            attempt()
    model = data.model.with_forces(JointFriction())
    for how in ({"engine": "inducing"}, {"learning_points": 5}):
        with pytest.raises(InvalidInput, match="windows are conditioned on exactly"):
            fit(model, data, HOW, **how)
    sensor = replace(model, noise=Noise(None, force=0.1, learn=True, measured_torque=True))
    with pytest.raises(InvalidInput, match=r"windows .* their mean"):
        fit(sensor, data, HOW)
    with pytest.raises(InvalidInput, match=r"evidence is .*weak"):
        fit(model, data, "weak")
    with pytest.raises(InvalidInput, match=r"points=99` must be an integer from 2 to \d+, the windows of 0.1 s"):
        fit(model, data, HOW, points=99)


def test_more_windows_than_memory_holds_are_refused(monkeypatch):
    monkeypatch.setattr("forcegp.inference.memory.free_memory", lambda device: 10_000)
    data = motion()
    with pytest.raises(NotEnoughMemory, match=r"24 windows of 8 nodes .*fewer points"):
        fit(data.model.with_forces(JointFriction()), data, HOW, **FIT)


def test_equal_seeds_give_equal_models_from_several_starts():
    data, options = motion(), OptimizerOptions(iterations=5)
    how = {"evidence": Windows(), "points": 8, "restarts": 2, "seed": 3, "options": options}
    first, second = (fit(data.model.with_forces(JointFriction()), data, **how) for _ in range(2))
    assert first.result.value == second.result.value
    assert len(first.settings["restart_objective"]) == 2
