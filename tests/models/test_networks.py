"""The two networks: the conformance of every model, and what they compute, against plain torch modules and formulas."""

import dataclasses
from typing import ClassVar

import numpy as np
import pytest
import torch
from tests.models import floating_arm
from tests.models.arm import NOISE, arm_data
from tests.models.model_conformance import ModelConformance

from forcegp.errors import FitError, InvalidInput
from forcegp.models import Noise, load_posterior, save_posterior
from forcegp.models.baselines.network_ensemble import NetworkEnsemble
from forcegp.models.baselines.neural_network import (
    Batches,
    NeuralNetwork,
    ResidualLayers,
    held_out_rows,
    initial_weights,
    mean_and_variance,
    sigmoid_layer,
)

SMALL = {"members": 3, "width": 16, "depth": 2, "steps": 90, "batch": 20}


class TestNeuralNetwork(ModelConformance):
    quick: ClassVar = {}

    @classmethod
    def make(cls, system):
        return NeuralNetwork(system, width=12, steps=40, batch=16)


class TestNetworkEnsemble(ModelConformance):
    quick: ClassVar = {}

    @classmethod
    def make(cls, system):
        return NetworkEnsemble(system, **SMALL)


@pytest.mark.parametrize("model", [TestNeuralNetwork, TestNetworkEnsemble])
def test_robots_whose_base_moves_have_other_numbers_of_positions_and_inputs(model, tmp_path):
    log = floating_arm.recording(0, 1.2, floating_arm.satellite())
    assert len(set(log.system.sizes)) == 3
    posterior = model.make(log.system).fit(log)
    save_posterior(posterior, tmp_path / "model")
    found, again = (each.predict(log.q, log.v, log.u) for each in (posterior, load_posterior(tmp_path / "model")))
    assert found.mean.shape == log.a.shape
    assert torch.equal(found.mean, again.mean)
    assert torch.equal(found.covariance, again.covariance)


def smooth_data(rows, seed, noise=0.05):
    """The states of the arm with accelerations that are smooth functions of them."""
    data = arm_data(rows, seed)
    truth = np.stack([np.sin(data.q[:, 0]) + 0.1 * data.u[:, 0], data.v[:, 1] * data.q[:, 2], 0.5 * data.v[:, 2]], 1)
    noisy = truth + np.random.default_rng(seed).normal(0.0, noise, truth.shape)
    return dataclasses.replace(data, a=noisy, truth={"a": truth}, noise_std=np.full(3, noise))


@pytest.fixture(scope="module")
def train():
    return smooth_data(400, seed=1)


@pytest.fixture(scope="module")
def test():
    return smooth_data(200, seed=2)


@pytest.fixture(scope="module")
def network(train):
    return NeuralNetwork(train.system, steps=600, batch=200).fit(train, seed=1)


@pytest.fixture(scope="module")
def ensemble(train):
    return NetworkEnsemble(train.system, width=32, steps=600, batch=64).fit(train, seed=1)


def test_one_layer_is_that_of_torch():
    shapes = sigmoid_layer(5).shapes(1, 4, 2)
    weights = initial_weights(shapes, torch.Generator().manual_seed(0))
    twin = torch.nn.Sequential(torch.nn.Linear(4, 5), torch.nn.Sigmoid(), torch.nn.Linear(5, 2)).double()
    with torch.no_grad():
        for place, layer in ((0, "hidden"), (2, "output")):
            twin[place].weight.copy_(weights[f"{layer}.weight"][0].mT)
            twin[place].bias.copy_(weights[f"{layer}.bias"][0, 0])
    x = torch.linspace(-1.0, 1.0, 12, dtype=torch.float64).reshape(3, 4)
    torch.testing.assert_close(sigmoid_layer(5)(weights, x[None])[0], twin(x), rtol=1e-14, atol=1e-14)


def test_residual_layers_are_those_written_plainly_member_by_member():
    layers = ResidualLayers(width=6, depth=2)
    weights = initial_weights(layers.shapes(3, 4, 2), torch.Generator().manual_seed(0))
    x = torch.linspace(-1.0, 1.0, 20, dtype=torch.float64).reshape(5, 4)
    means, variances = mean_and_variance(layers(weights, x[None]))
    for member in range(3):
        w = {name: value[member] for name, value in weights.items()}
        h = x @ w["input.weight"] + w["input.bias"]
        for block in ("block0", "block1"):
            h = h + (h * torch.sigmoid(h)) @ w[f"{block}.weight"] + w[f"{block}.bias"]
        out = (h * torch.sigmoid(h)) @ w["output.weight"] + w["output.bias"]
        torch.testing.assert_close(means[member], out[:, :2], rtol=1e-13, atol=1e-13)
        torch.testing.assert_close(variances[member], torch.log1p(out[:, 2:].exp()) + 1e-6, rtol=1e-12, atol=1e-12)


def test_weights_start_differently_for_every_member_and_within_the_bound():
    weights = initial_weights(ResidualLayers(50, 1).shapes(4, 9, 3), torch.Generator().manual_seed(3))
    first = weights["input.weight"]
    assert float(first.abs().max()) <= 1.0 / 3.0
    assert float(first.std()) == pytest.approx(1.0 / 3.0 / np.sqrt(3.0), rel=0.1)
    assert not torch.equal(first[0], first[1])


def test_every_row_is_drawn_once_before_any_is_drawn_again():
    rows = [torch.arange(12), torch.arange(100, 112)]
    batches = Batches(rows, 4, torch.Generator().manual_seed(0))
    drawn = torch.cat([batches.draw() for _ in range(3)], dim=1)
    assert torch.equal(drawn[0].sort().values, rows[0])
    assert torch.equal(drawn[1].sort().values, rows[1])
    assert not torch.equal(drawn[0], drawn[1] - 100)
    assert Batches([torch.arange(3)], 10, torch.Generator()).draw().shape == (1, 3)


def test_whole_stretches_of_time_are_held_out(train):
    shuffled = train.rows(np.random.default_rng(0).permutation(400))
    training, held_out = held_out_rows(shuffled, 3, 0.1, seed=5)
    for mine, other in zip(training, held_out, strict=True):
        assert not set(mine.tolist()) & set(other.tolist())
        assert (len(mine), len(other)) == (360, 40)
        times = np.sort(shuffled.time[other.numpy()])
        assert (np.diff(times) > 0.015).sum() <= 1  # two stretches of 20 neighbours, 0.01 s apart
    assert set(held_out[0].tolist()) != set(held_out[1].tolist())


def test_both_learn(network, ensemble, train, test):
    scale = np.abs(test.truth["a"] - train.a.mean(0)).mean()
    for posterior in (network, ensemble):
        error = np.abs(posterior.predict(test.q, test.v, test.u).mean.numpy() - test.truth["a"]).mean()
        assert error < 0.3 * scale, posterior.description
        assert posterior.result.history[-1] < posterior.result.history[0]


def test_the_scatter_of_the_small_network_is_its_training_residual(network, train):
    residual = train.a - network.predict(train.q, train.v, train.u, covariance=False).mean.numpy()
    rms = np.sqrt(np.square(residual).mean(0))
    prediction = network.predict(train.q[:2], train.v[:2], train.u[:2])
    np.testing.assert_allclose(prediction.noise_covariance[1], NOISE**2 * np.eye(3), rtol=1e-12)
    np.testing.assert_allclose(
        prediction.covariance[1].diagonal(), np.maximum(rms**2 - NOISE**2, 0.0), rtol=1e-9, atol=1e-12
    )


def test_without_a_known_noise_all_of_the_scatter_is_noise(train):
    bare = dataclasses.replace(train, noise_std=None)
    small = NeuralNetwork(train.system, steps=50).fit(bare)
    residual = train.a - small.predict(train.q, train.v, train.u).mean.numpy()
    np.testing.assert_allclose(small.noise_std, np.sqrt(np.square(residual).mean(0)), rtol=1e-9)
    assert float(small.predict(train.q, train.v, train.u).covariance.abs().max()) == 0.0
    several = NetworkEnsemble(train.system, **SMALL)
    stated, unknown = several.fit(train), several.fit(bare)
    mine, theirs = (p.predict(train.q, train.v, train.u) for p in (stated, unknown))
    assert torch.equal(mine.mean, theirs.mean)
    # the same variance of a measurement wherever the predicted scatter is above the stated noise
    above = (theirs.noise_covariance.diagonal(dim1=1, dim2=2) > NOISE**2).all(-1)
    assert bool(above.any())
    torch.testing.assert_close(mine.measurement.covariance[above], theirs.measurement.covariance[above])


def test_the_ensemble_is_the_mixture_of_its_members(ensemble, test):
    """Lakshminarayanan et al. (2017), section 2.4: mean of the variances plus variance of the means."""
    states = torch.tensor(np.hstack([test.q, test.v, test.u]))
    seen = torch.cat([ensemble.training.q, ensemble.training.v, ensemble.training.u], -1)
    x = (states - seen.mean(0)) / seen.std(0, correction=0)
    a = ensemble.training.a
    means, variances = mean_and_variance(ensemble.model.layers(ensemble.parameters, x[None]))
    means = means * a.std(0, correction=0) + a.mean(0)
    variances = variances * a.var(0, correction=0)
    second_moment = (variances + means.square()).mean(0)
    unknown = dataclasses.replace(ensemble, model=dataclasses.replace(ensemble.model, noise=None))
    prediction = unknown.predict(test.q, test.v, test.u)
    torch.testing.assert_close(prediction.mean, means.mean(0), rtol=1e-12, atol=1e-12)
    expected = second_moment - means.mean(0).square()
    torch.testing.assert_close(prediction.measurement.variance, expected, rtol=1e-9, atol=1e-9)


def test_members_differ_more_where_there_were_no_data(ensemble, test):
    near = ensemble.predict(test.q, test.v, test.u)
    far = ensemble.predict(test.q + 3.0, 4.0 * test.v, 4.0 * test.u)
    assert float(far.std.mean()) > 3.0 * float(near.std.mean())


def test_the_ensemble_is_roughly_calibrated(ensemble, test):
    prediction = ensemble.predict(test.q, test.v, test.u)
    inside = np.abs(prediction.mean.numpy() - test.a) < 1.96 * prediction.measurement.std.numpy()
    assert 0.8 < inside.mean() <= 1.0


def test_the_noise_may_be_larger_somewhere(train):
    """Heteroscedastic: accelerations of fast states are noisier."""
    generator = np.random.default_rng(7)
    level = np.where(train.v[:, :1] > 0.0, 0.6, 0.03)
    noisy = dataclasses.replace(
        train, a=train.truth["a"] + generator.normal(0.0, 1.0, (400, 3)) * level, noise_std=None
    )
    fitted = NetworkEnsemble(train.system, width=32, steps=400, batch=64).fit(noisy)
    noise = fitted.predict(train.q, train.v, train.u).noise_covariance.diagonal(dim1=1, dim2=2).sqrt().numpy()
    fast, slow = noise[train.v[:, 0] > 0.3].mean(), noise[train.v[:, 0] < -0.3].mean()
    assert fast > 2.0 * slow


def test_the_best_weights_of_every_member_are_kept(train):
    fitted = NetworkEnsemble(train.system, width=16, steps=200, batch=32, rate=0.02).fit(train, points=60)
    assert fitted.result.value <= min(fitted.result.history)  # each member at its own best step
    assert "predicted best at steps" in fitted.result.status


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda s: NeuralNetwork(s, width=0), "width=0 must be a whole number above 0"),
        (lambda s: NeuralNetwork(s, rate=float("nan")), "rate=nan must be above 0"),
        (lambda s: NetworkEnsemble(s, members=-1), "members=-1 must be a whole number above 0"),
        (lambda s: NetworkEnsemble(s, held_out=0.5), "held_out=0.5"),
        (lambda s: NetworkEnsemble(s, beta=2.0), "beta=2.0"),
        (lambda s: NeuralNetwork(s, noise=Noise(0.1, learn=True)), "known noise of the acceleration only"),
        (lambda s: NetworkEnsemble(s, noise=Noise(0.1, 0.2)), "known noise of the acceleration only"),
        (lambda s: NetworkEnsemble(s).fit(arm_data(9, 0)), "needs 10 rows; there are 9"),
    ],
)
def test_what_makes_no_sense_is_refused(train, make, message):
    with pytest.raises(InvalidInput, match=message):
        make(train.system)


def test_bounds_themselves_are_allowed(train):
    for beta in (0.0, 1.0):
        assert NetworkEnsemble(train.system, beta=beta, weight_decay=0.0, held_out=0.49).beta == beta


def test_defaults_are_those_of_the_papers(train):
    """Rath et al. (2021), section 5; the ensemble is what docs/how-to/validation.md compares with."""
    network, ensemble = NeuralNetwork(train.system), NetworkEnsemble(train.system)
    assert (network.width, network.steps, network.batch, network.rate) == (80, 5000, 1000, 0.01)
    assert (ensemble.members, ensemble.width, ensemble.depth, ensemble.beta) == (5, 128, 3, 0.5)
    assert (ensemble.steps, ensemble.batch, ensemble.rate) == (3000, 256, 3e-3)
    assert (ensemble.weight_decay, ensemble.held_out) == (1e-3, 0.1)


def test_a_loss_that_is_not_finite_is_named(train):
    huge = dataclasses.replace(train, a=np.full_like(train.a, 1e200), truth={})
    with pytest.raises(FitError, match="not finite at step"):
        NeuralNetwork(train.system, steps=20).fit(huge)
