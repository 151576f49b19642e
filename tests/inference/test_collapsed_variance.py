"""A latent whose variance has collapsed leaves nothing out at any point; its posterior must still be usable."""

import torch
from tests.scores.moving_arm import moving_arm

from forcegp import JointFriction, Noise, fit
from forcegp.inference import Inducing
from forcegp.posterior import Posterior


def test_a_latent_without_variance_has_a_predictor():
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
    torch.testing.assert_close(mean, expected.mean)
    torch.testing.assert_close(covariance, expected.covariance, rtol=1e-6, atol=1e-12)
