"""How much wider intervals are than at the fitted hyper-parameters; closed forms for one unknown number."""

import math

import numpy as np
import pytest
import torch
from scipy.stats import norm
from tests.posterior.arm import NOISE, arm_data

from forcegp.data import Dataset
from forcegp.fit import fit
from forcegp.fit import search as widening
from forcegp.forces import JointFriction
from forcegp.inference import ExactPosterior, OptimizerOptions
from forcegp.inference.pathwise import draw_functions
from forcegp.model import Model
from forcegp.robots import Robot

WHEEL = """<robot name="wheel"><link name="base"/><link name="disc"><inertial><mass value="1"/>
<inertia ixx="0.5" iyy="0.5" izz="0.5" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="spin" type="continuous">
<parent link="base"/><child link="disc"/><axis xyz="0 0 1"/></joint></robot>"""
"""A turning disc of inertia 0.5 kg m^2."""

QUICK = OptimizerOptions(iterations=30)


def spinning(rows: int, noise: float) -> Dataset:
    """A disc with viscous friction of 0.4 Nms/rad; a = (u - 0.4 v) / 0.5 + noise."""
    generator = np.random.default_rng(0)
    q, v, u = generator.normal(size=(3, rows, 1))
    a, model = (u - 0.4 * v) / 0.5 + noise * generator.normal(size=(rows, 1)), Model(Robot.from_urdf_text(WHEEL))
    return Dataset(q=q, v=v, u=u, a=a, time=0.1 * np.arange(rows), model=model, noise_std=np.full(1, noise))


def one_slope(rows: int, noise: float):
    """A posterior in which one number is unknown: the slope of the friction."""
    data = spinning(rows, noise)
    return fit(data.model.with_forces(JointFriction(kernel="linear")), data, restarts=1, options=QUICK)


def test_one_unknown_number_has_the_factor_of_one_normal_variable():
    """All states are inside or none: the slope has to be inside in `CONFIDENCE` of the cases, not in 95 %."""
    posterior = one_slope(30, 0.1)
    states, expected = widening._States(posterior), norm.ppf(0.5 + 0.5 * widening.CONFIDENCE) / norm.ppf(0.975)
    assert states.content_factor(posterior.latent) == pytest.approx(expected, rel=0.06)  # of 2000 draws


def test_an_unknown_variance_widens_as_the_closed_form_does():
    """Bayesian regression on one slope w ~ N(0, s): everything by hand, in the units of the standardised velocity."""
    noise = 1.0  # so large that the prior matters
    posterior = one_slope(8, noise)
    training = posterior.training
    z = (training.v[:, 0] / training.v[:, 0].square().mean().sqrt()).numpy()
    x, y = -z / 0.5, (training.a - training.u / 0.5)[:, 0].numpy()
    ((name, fitted),) = [each for each in posterior.hyperparameters.items() if each[0].startswith("kernels")]
    # the kernel's parameter is the logarithm of s
    theta = float(posterior.latent.kernels[0].variance.log())
    assert theta == pytest.approx(float(fitted), abs=1e-9), name

    ((_, _, prior, _, _),) = list(posterior.kernels[0].named_priors())
    center, spread = float(prior.loc), float(prior.scale)

    def objective(theta):
        S = noise**2 * np.eye(len(x)) + math.exp(theta) * np.outer(x, x)
        return 0.5 * y @ np.linalg.solve(S, y) + 0.5 * np.linalg.slogdet(S)[1] + 0.5 * ((theta - center) / spread) ** 2

    def without(theta):  # of each row, from the others
        others = [np.delete(np.arange(len(x)), i) for i in range(len(x))]
        information = np.array([x[k] @ x[k] / noise**2 + math.exp(-theta) for k in others])
        slope = np.array([x[k] @ y[k] for k in others]) / noise**2 / information
        return x * slope, x**2 / information

    h = 1e-4
    curvature = (objective(theta + h) - 2.0 * objective(theta) + objective(theta - h)) / h**2
    step = max(curvature, widening.LARGEST_STEP**-2) ** -0.5
    mean, variance = without(theta)
    sides = [without(theta + sign * step) for sign in (1.0, -1.0)]
    told = 0.5 * curvature * step**2  # what a parabola rises by
    told += 0.6 * math.sqrt(told)
    shares = [told / max(told, objective(theta + sign * step) - objective(theta)) for sign in (1.0, -1.0)]
    more = 0.5 * sum(k * ((m - mean) ** 2 + v - variance) for k, (m, v) in zip(shares, sides, strict=True))
    expected = math.sqrt(max(1.0, 1.0 + (more / variance).mean()))
    assert widening._States(posterior).mixture_factor(posterior) == pytest.approx(expected, rel=1e-2)
    assert expected > 1.01


@pytest.fixture(scope="module")
def fitted():
    data = arm_data(24, 0)
    return fit(data.model.with_forces(JointFriction()), data, restarts=1, options=QUICK), data


def test_most_functions_have_most_states_inside(fitted):
    """What is promised, on functions drawn by other means (Matheron's rule) than the factor was found with."""
    posterior, data = fitted
    prediction = posterior.with_settings(widening=1.0).predict(data.q, data.v, data.u)
    wide = posterior.predict(data.q, data.v, data.u)
    dynamics = posterior.dynamics(*(torch.tensor(x) for x in (data.q, data.v, data.u)))
    features = posterior.likelihood.standardization(posterior.model.unknown.features(dynamics))
    values = draw_functions(posterior.latent, 600, 1)([z.expand(600, *z.shape) for z in features])
    W = dynamics.H @ posterior.model.unknown.direction(dynamics)
    drawn = torch.einsum("nkc,snc->snk", W, values - posterior.latent.mean(features))

    def share(std):
        return float(((drawn.abs() <= 1.96 * std).double().mean((1, 2)) >= widening.CONTENT).double().mean())

    assert share(wide.covariance.diagonal(dim1=-2, dim2=-1).sqrt()) > 0.985
    assert share(prediction.covariance.diagonal(dim1=-2, dim2=-1).sqrt()) < 0.985


def test_everything_with_a_spread_is_widened_and_no_mean_moves(fitted):
    posterior, data = fitted
    states = data.q[:4], data.v[:4], data.u[:4]
    posterior = posterior.with_settings(hidden_force=None)  # what contacts hide is no part of what was learned
    plain, factor = posterior.with_settings(widening=1.0), posterior.widening
    assert factor > 1.0
    narrow, wide = plain.predict(*states), posterior.predict(*states)
    parts = ((p, p.multiplier, p.contact_force, p.unknown_force) for p in (wide, narrow))
    for mine, theirs in zip(*parts, strict=True):
        assert torch.equal(mine.mean, theirs.mean)
        torch.testing.assert_close(mine.covariance, factor**2 * theirs.covariance)
    assert torch.equal(wide.noise_covariance, narrow.noise_covariance)
    latent = posterior.latent_names[0]
    torch.testing.assert_close(posterior.curve(latent).std, factor * plain.curve(latent).std)
    for covariance in ("exact", "compressed"):
        how = {"covariance": covariance, "compile": False}
        mean, predicted = posterior.predictor(**how)(*states)
        other, expected = plain.predictor(**how)(*states)
        torch.testing.assert_close(mean, other)
        torch.testing.assert_close(predicted, factor**2 * expected)


def test_the_covariance_between_states_is_that_of_dense_conditioning(fitted):
    posterior, data = fitted
    latent = posterior.latent
    assert isinstance(latent, ExactPosterior)
    z = [torch.linspace(-1.5, 1.5, 4).double()[:, None] for _ in latent.features]
    found = latent.joint_covariance(z).reshape(3, 4, 3, 4)
    own = torch.stack([found[:, i, :, i] for i in range(4)])
    torch.testing.assert_close(own, latent.covariance(z), atol=1e-10, rtol=1e-8)
    # against the plain formula, from the covariance of all training accelerations
    dynamics = posterior.dynamics(*(torch.tensor(x) for x in (data.q, data.v, data.u)))
    W, N = dynamics.H @ posterior.model.unknown.direction(dynamics), len(data)
    S = NOISE**2 * torch.eye(3 * N).double()
    cross, prior = torch.zeros(12, 3 * N).double(), torch.zeros(12, 12).double()
    for c, kernel in enumerate(latent.kernels):
        at = latent.features[c]
        S += torch.einsum("id,ij,je->idje", W[..., c], kernel(at, at).to_dense(), W[..., c]).reshape(3 * N, 3 * N)
        cross[4 * c : 4 * c + 4] = torch.einsum("nj,jd->njd", kernel(z[c], at).to_dense(), W[..., c]).flatten(1)
        prior[4 * c : 4 * c + 4, 4 * c : 4 * c + 4] = kernel(z[c], z[c]).to_dense()
    expected = prior - cross @ torch.linalg.solve(S, cross.mT)
    torch.testing.assert_close(found.reshape(12, 12), expected.detach(), atol=1e-8, rtol=1e-6)
