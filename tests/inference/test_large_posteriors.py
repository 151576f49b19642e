"""Posteriors for many points, against the exact one of few."""

import pytest
import torch
from tests.inference.problems import Problem, normal, problem
from tests.scores.moving_arm import moving_arm
from torch.testing import assert_close

from forcegp import JointFriction, Noise, Posterior, fit
from forcegp.inference import ExactPosterior, Inducing
from forcegp.inference.inducing import InducingPosterior, pivoted_cholesky
from forcegp.inference.likelihood import Terms

SHAPES = {
    "no constraint": {"constraints": 0}, "one constraint": {"constraints": 1},
    "fewer latents than outputs": {"latents": 2}, "more latents than outputs": {"latents": 6, "outputs": 3},
}  # fmt: skip
COUNT = 40


def made(**shape) -> Problem:
    return problem(count=COUNT, **shape)


def new_features(given: Problem, points: int = 5) -> list[torch.Tensor]:
    return [normal(points, z.shape[1], seed=100 + c) for c, z in enumerate(given.features)]


def exact(given: Problem) -> ExactPosterior:
    return ExactPosterior.condition(given.kernels, given.terms)


def inducing(given: Problem, points: int = COUNT, tolerance: float = 0.0) -> InducingPosterior:
    return InducingPosterior.condition(
        given.kernels, Terms(given.features, *given.data), points=points, tolerance=tolerance
    )


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
@torch.no_grad()
def test_inducing_points_everywhere_are_the_exact_posterior(shape):
    given = made(**shape)
    features, posterior, expected = new_features(given), inducing(given), exact(given)
    assert_close(posterior.mean(features), expected.mean(features), rtol=1e-6, atol=1e-7)
    assert_close(posterior.covariance(features), expected.covariance(features), rtol=1e-6, atol=1e-7)
    for index, z in enumerate(features):
        assert_close(posterior.one(index, z), expected.one(index, z), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("louder", [4.0, 0.25], ids=["fewer suffice", "more are needed"])
@torch.no_grad()
def test_points_at_hand_serve_where_they_suffice(louder):
    given = made()
    features, how = new_features(given), {"points": COUNT, "tolerance": 0.05}
    W, residual, noise = given.data
    other = Terms(given.features, W, residual, louder * noise)
    near = InducingPosterior.condition(given.kernels, Terms(given.features, *given.data), **how)
    again = InducingPosterior.condition(given.kernels, other, **how, near=near)
    fresh = InducingPosterior.condition(given.kernels, other, **how)
    assert list(map(len, again.features)) == list(map(len, fresh.features)) != list(map(len, near.features))
    assert_close(again.mean(features), fresh.mean(features), rtol=1e-6, atol=1e-8)
    assert_close(again.covariance(features), fresh.covariance(features), rtol=1e-6, atol=1e-8)


@torch.no_grad()
def test_few_weights_know_less_than_all_data():
    given = made()
    features, few, expected = new_features(given), inducing(given, points=8), exact(given)
    surplus = few.covariance(features).diagonal(dim1=-2, dim2=-1).sum(-1) - expected.covariance(features).diagonal(
        dim1=-2, dim2=-1
    ).sum(-1)
    assert (surplus > 0).all()
    assert few.left_out > 0.1
    assert inducing(given).left_out == pytest.approx(0.0, abs=1e-6)


@torch.no_grad()
def test_tolerance_sets_the_number_of_inducing_points():
    given = made()
    loose, tight = inducing(given, tolerance=100.0), inducing(given, tolerance=1e-4)
    assert loose.left_out <= 100.0
    assert tight.left_out <= 1e-4
    assert sum(map(len, loose.features)) < sum(map(len, tight.features))


@torch.no_grad()
def test_drawn_functions_of_inducing_points_have_the_posterior_moments():
    given, samples = made(latents=2), 40000
    posterior = inducing(given, points=12)
    points, lowers = [z[:4] for z in posterior.features], [lower.clone() for lower in posterior.lowers]
    prior = [(lower @ normal(len(lower), samples, seed=300 + c)).mT.contiguous() for c, lower in enumerate(lowers)]
    weights = posterior.function_weights(prior, torch.Generator().manual_seed(2))
    values = torch.stack(
        [
            prior[c][:, :4] + w @ given.kernels[c](posterior.features[c], points[c]).to_dense()
            for c, w in enumerate(weights)
        ],
        dim=-1,
    )  # S 4 C
    mean, covariance, centred = posterior.mean(points), posterior.covariance(points), values - values.mean(0)
    sampled = torch.einsum("snc,snd->ncd", centred, centred) / samples
    scale = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    assert ((values.mean(0) - mean).abs() < 5.0 * scale / samples**0.5 + 1e-9).all()
    assert ((sampled - covariance).abs() < 0.05 * scale[..., :, None] * scale[..., None, :]).all()


@torch.no_grad()
def test_pivots_reproduce_the_matrix_that_they_are_made_of():
    given = made()
    z, kernel = given.features[0], given.kernels[0]
    K = kernel(z, z).to_dense()
    pivots = pivoted_cholesky(given.kernels.dense[0], z, torch.ones(COUNT, dtype=torch.float64), COUNT)
    assert_close(K[:, pivots] @ torch.linalg.pinv(K[pivots][:, pivots]) @ K[pivots], K, rtol=1e-6, atol=1e-6)
    assert len(set(pivots.tolist())) == len(pivots)
    for count in (3, 6):  # each pivot is where most is left
        known = pivots[:count]
        left = K - K[:, known] @ torch.linalg.solve(K[known][:, known], K[known])
        assert int(left.diagonal().argmax()) == int(pivots[count])


def test_a_latent_without_variance_has_a_predictor():
    """Which leaves nothing out at any point."""
    log = moving_arm(1.0, 1)
    model = log.model.with_forces(JointFriction(kernel="matern-3/2"), noise=Noise(0.2))
    fitted = fit(model, log, points=40, restarts=1)
    parameters = dict(fitted.hyperparameters)
    (name, *_) = (name for name in parameters if "outputscale" in name)
    parameters[name] = torch.full_like(parameters[name], -40.0)
    given = fitted.training, parameters, fitted.result, fitted.settings
    flat = Posterior.conditioned(fitted.model, *given, Inducing())
    q, v, u = (torch.tensor(each[:5]) for each in (log.q, log.v, log.u))
    mean, covariance = flat.predictor()(q, v, u)[:2]
    expected = flat.predict(q, v, u)
    assert_close(mean, expected.mean)
    assert_close(covariance, expected.covariance, rtol=1e-6, atol=1e-12)
