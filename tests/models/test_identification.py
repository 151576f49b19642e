"""Standard errors against closed forms, what cannot be identified, the prior, and what comes back from a fit."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from gpytorch.kernels import RBFKernel, ScaleKernel
from gpytorch.priors import NormalPrior
from tests.models.arm import NOISE, arm_data, arm_system

from forcegp.errors import InvalidInput, NumericalWarning
from forcegp.inference import LatentKernels, OptimizerOptions, minimize_objective
from forcegp.mechanics import Actuation, RigidBodyBias, ViscousJointFriction
from forcegp.models import Coefficients, Noise, StructuredGP, load_posterior, save_posterior
from forcegp.models.identification.identification import FLAT, curvature_about
from forcegp.models.identification.physical_parameters import PHYSICAL, PhysicalParameters
from forcegp.models.structured.search import squared_distance, with_variance_priors
from forcegp.priors import NoForces
from forcegp.priors.kernels import squared_exponential_kernel
from forcegp.robots import LinkInertia, pseudo_inertia_from_parameters

AT_THE_CENTER = -math.log(2.0 * math.sqrt(2.0 * math.pi))  # log density of N(c, 2^2) at c
LEARN = (LinkInertia("hand", ("mass", "com")), Coefficients("viscous-joint-friction"))


def damped(contacts=1, damping=(0.3, 0.2, 0.1)):
    return arm_system(contacts, known_forces=(Actuation(), RigidBodyBias(), ViscousJointFriction(list(damping))))


def measured(system, rows, seed):
    """Data without unknown force: the exact acceleration and noise."""
    data = arm_data(rows, seed, system)
    states = [torch.tensor(x) for x in (data.q, data.v, data.u)]
    exact = system.dynamics(*states).acceleration(torch.zeros(rows, 3).double()).numpy()
    noise = NOISE * np.random.default_rng([seed, 1]).standard_normal(exact.shape)
    return replace(data, a=exact + noise, truth={})


def dense_information(system, physical, z, data):
    """J^T R^-1 J of the acceleration in SI units, by central differences of the whole model in each SI value."""
    states = [torch.tensor(x) for x in (data.q, data.v, data.u)]

    def acceleration(point):
        return physical.system_at(point).dynamics(*states).acceleration(torch.zeros(len(data), 3).double()).flatten()

    to_z = torch.linalg.inv(torch.as_tensor(torch.autograd.functional.jacobian(physical.values, z)))
    columns = [
        (acceleration(z + 1e-4 * step) - acceleration(z - 1e-4 * step)) / 2e-4
        for step in torch.eye(len(z), dtype=torch.float64)
    ]
    J = torch.stack(columns, -1) @ to_z
    return J.mT @ J / NOISE**2


@pytest.fixture(scope="module")
def analytical():
    """The analytical model fitted to data of its own kind, from wrong values."""
    data = measured(damped(), 150, seed=4)
    wrong = PhysicalParameters.of(damped(), LEARN)
    z = 0.3 * torch.as_tensor(np.random.default_rng(1).standard_normal(len(wrong.zero)))
    return StructuredGP(wrong.system_at(z), prior=NoForces()).identify(data, LEARN), data


def test_standard_errors_of_the_analytical_model_are_those_of_least_squares(analytical):
    posterior, data = analytical
    found = posterior.identification
    expected = torch.linalg.inv(
        dense_information(found.physical.system, found.physical, found.parameters[PHYSICAL], data)
    )
    deviations = expected.diagonal().sqrt()
    # the Hessian has the second derivatives of the residual too, of the order of the noise
    assert list(found.standard_errors.values()) == pytest.approx(deviations.tolist(), rel=0.05)
    scale = deviations[:, None] * deviations
    assert torch.allclose(found.covariance / scale, expected / scale, atol=0.1)


def test_estimates_lie_within_their_errors(analytical):
    posterior, _ = analytical
    found = posterior.identification
    truth = PhysicalParameters.of(damped(), LEARN)
    true = truth.named(truth.zero)
    off = [(found.values[name] - true[name]) / found.standard_errors[name] for name in true]
    assert max(map(abs, off)) < 4.0
    low, high = found.intervals["hand.mass"]
    assert high - low == pytest.approx(2 * 1.96 * found.standard_errors["hand.mass"], rel=1e-4)
    assert abs(found.start["hand.mass"] - true["hand.mass"]) > 10 * found.standard_errors["hand.mass"]
    assert found.history[0] == pytest.approx(found.start)
    assert len(found.history) == len(posterior.result.history)
    assert posterior.result.history[-1] == pytest.approx(posterior.result.value)


def test_the_posterior_needs_nothing_but_its_system(analytical, tmp_path):
    posterior, data = analytical
    assert set(posterior.parameters) == {"noise.log_acceleration"}
    assert posterior.system.robot.link("hand").mass == pytest.approx(posterior.identification.values["hand.mass"])
    save_posterior(posterior, tmp_path / "model")
    again = load_posterior(tmp_path / "model")
    assert again.identification is None
    q, v, u = data.q[:5], data.v[:5], data.u[:5]
    assert torch.equal(again.predict(q, v, u).mean, posterior.predict(q, v, u).mean)
    stored = json.loads(json.dumps(posterior.identification.to_dict(), allow_nan=False))
    assert stored["parameters"]["hand.com.z"]["unit"] == "m"
    assert posterior.identification.at_optimum
    assert stored["decrement"] == posterior.identification.decrement < 0.1


def test_noise_is_learned_with_the_physical_parameters():
    data = measured(damped(), 60, seed=8)
    model = StructuredGP(damped(damping=(0.1, 0.1, 0.3)), prior=NoForces(), noise=Noise(0.2, learn=True))
    posterior = model.identify(data, LEARN)
    assert posterior.noise_std.tolist() == pytest.approx([NOISE] * 3, rel=0.35)
    assert posterior.identification.values["viscous-joint-friction.bend"] == pytest.approx(0.1, abs=0.05)


def test_what_no_motion_shows_is_named():
    # nothing turns about the x axis of the hand's centre of mass but through pan, and the links above it are as unknown
    data = measured(damped(0), 40, seed=2)
    learn = (LinkInertia("upper", ("mass", "com")), LinkInertia("hand", ("mass",)))
    found = StructuredGP(damped(0), prior=NoForces()).identify(data, learn).identification
    # pan turns upper about a vertical axis: gravity and the angle it starts from show nothing of com.z
    named = {
        max(direction.weights, key=lambda name: abs(direction.weights[name])) for direction in found.weak_directions
    }
    assert "upper.com.z/r" in named
    assert found.standard_errors["upper.com.z"] == math.inf
    assert math.isfinite(found.standard_errors["hand.mass"])
    assert "do not identify" in found.verdict
    assert "upper.com.z/r" in found.verdict
    assert found.to_dict()["parameters"]["upper.com.z"]["standard_error"] is None


def test_schur_complement_of_a_known_quadratic_form():
    generator = np.random.default_rng(0)
    root = torch.as_tensor(generator.standard_normal((7, 7)))
    H = root @ root.mT + torch.eye(7)

    def objective(parameters):
        x = torch.cat([parameters["a"].reshape(-1), parameters["p"], parameters["b"]])
        return 0.5 * x @ H @ x

    point = {"a": torch.zeros(2, 1).double(), "p": torch.zeros(3).double(), "b": torch.zeros(2).double()}
    seen = []
    found = curvature_about("p", objective, point, lambda done, of: seen.append((done, of)))
    expected = torch.linalg.inv(torch.linalg.inv(H)[2:5, 2:5])
    assert torch.allclose(found.information, expected, rtol=1e-8)
    assert seen[-1] == (11, 11)
    assert found.decrement == pytest.approx(0.0, abs=1e-9)
    assert not found.doubts
    alone = curvature_about("p", lambda x: (x["p"] ** 2).sum(), {"p": point["p"]})
    assert torch.allclose(alone.information, 2 * torch.eye(3).double())

    # away from the optimum: Newton's method would go to 0, by p in units of the covariance
    away = {name: torch.as_tensor(generator.standard_normal(tuple(value.shape))) for name, value in point.items()}
    with pytest.warns(NumericalWarning, match=r"move the estimates by .* more `iterations`"):
        moved = curvature_about("p", objective, away)
    assert moved.decrement == pytest.approx(float(away["p"] @ expected @ away["p"]) ** 0.5, rel=1e-7)
    size = 0.09 / moved.decrement
    near = curvature_about("p", objective, {name: size * value for name, value in away.items()})
    assert near.decrement == pytest.approx(0.09)
    assert not near.doubts


def quadratic(pp, pk, kk):
    """1/2 pp p^2 + pk p b + 1/2 kk b^2 at 0."""
    point = {"p": torch.zeros(1).double(), "b": torch.zeros(1).double()}
    return (lambda x: (0.5 * pp * x["p"] ** 2 + pk * x["p"] * x["b"] + 0.5 * kk * x["b"] ** 2).sum()), point


@pytest.mark.parametrize(
    ("form", "words"),
    [((2.0, 0.0, -2.0), "kernel and noise parameters falls to -2"), ((1.0, 2.0, 1.0), "physical.* falls to -3")],
)
def test_a_saddle_is_told(form, words):
    with pytest.warns(NumericalWarning, match=f"not ended at a minimum.*{words}"):
        found = curvature_about("p", *quadratic(*form))
    assert len(found.doubts) == 1


def test_no_information_is_no_saddle():
    found = curvature_about("p", *quadratic(0.0, 0.0, 1.0))
    assert found.information.item() == pytest.approx(0.0, abs=1e-9)
    assert not found.doubts


def test_a_flat_direction_of_the_others_does_not_count_as_known():
    # b is known to 1/sqrt(kk) = 45 and takes 80 % of the information along; a prior of 1/sqrt(FLAT) = 32 leaves 40 %
    kk = 0.5 * FLAT
    found = curvature_about("p", *quadratic(1.0, (0.8 * kk) ** 0.5, kk))
    assert found.information.item() == pytest.approx(1.0 - 0.8 * kk / FLAT, rel=1e-6)
    # at a minimum the coupling vanishes with the curvature (pk^2 <= pp kk), so nothing is lost to rounding
    assert curvature_about("p", *quadratic(1.0, 1e-6, 1e-12)).information.item() == pytest.approx(1.0, rel=1e-6)


def test_the_prior_is_the_affine_invariant_distance_and_pulls_to_the_start():
    robot = arm_system().robot
    start = robot.inertial_parameters("hand")["hand"]
    moved = start + 0.2 * torch.as_tensor(np.random.default_rng(3).standard_normal(10))
    P, P0 = (pseudo_inertia_from_parameters(x).numpy() for x in (moved, start))
    eigenvalues = np.linalg.eigvals(np.linalg.solve(P0, P)).real
    assert float(squared_distance(moved, start)) == pytest.approx(np.square(np.log(eigenvalues)).sum(), rel=1e-9)
    heavier = start + torch.tensor([0.5 * math.log(2.0)] + [0.0] * 9, dtype=torch.float64)
    assert float(squared_distance(heavier, start)) == pytest.approx((2 * math.log(2.0)) ** 2)
    torch.autograd.gradcheck(squared_distance, (moved.requires_grad_(), start))
    assert torch.equal(
        torch.autograd.grad(squared_distance(start.requires_grad_(), start.detach()), start)[0].round(decimals=6),
        torch.zeros(10).double(),
    )

    data = measured(damped(), 20, seed=6)
    system = PhysicalParameters.of(damped(), LEARN[0]).system_at(torch.tensor([0.5, 0.1, 0.1, 0.1]).double())
    model = StructuredGP(system, prior=NoForces())
    free, held = (model.identify(data, LEARN[0], prior_strength=w).identification for w in (0.0, 1e12))
    assert held.values == pytest.approx(held.start, rel=1e-3)
    assert free.values["hand.mass"] != pytest.approx(free.start["hand.mass"], rel=0.05)
    assert held.standard_errors["hand.mass"] < 0.01 * free.standard_errors["hand.mass"]


def test_every_iterate_of_a_structured_fit_is_kept():
    data = arm_data(25, seed=9, system=damped())
    learn = LinkInertia("hand", ("mass",))
    posterior = StructuredGP(damped()).identify(data, learn, restarts=2, options=OptimizerOptions(iterations=4))
    result, found = posterior.result, posterior.identification
    assert len(result.iterates) == len(result.history) == len(found.history)
    for point, value in zip(result.iterates, result.history, strict=True):
        assert float(found.objective(point)) == pytest.approx(value, abs=1e-9)
    assert posterior.at_iteration(1).system.robot.link("hand").mass == pytest.approx(found.history[1]["hand.mass"])
    last = posterior.at_iteration(len(result.history) - 1)
    state = (data.q[:3], data.v[:3], data.u[:3])
    assert torch.allclose(last.predict(*state).mean, posterior.predict(*state).mean, atol=1e-8)
    with pytest.raises(InvalidInput, match=r"keep_iterates=True"):
        posterior.at_iteration(len(result.history))
    assert posterior.settings["learned"] == [{"link": "hand", "parts": ["mass"]}]
    seen = []
    again = replace(found, progress=lambda done, of: seen.append((done, of)))
    with pytest.warns(NumericalWarning, match="not ended at a minimum"):  # after 4 iterations
        _ = again.information
    assert not again.at_optimum
    assert seen[-1] == (33, 33)  # 2 for the mass, 1 at the optimum, 30 for kernels
    assert again.verdict.startswith("The search has not ended at a minimum (")
    assert not again.to_dict()["at_optimum"]


def quiet_joint(rows, seed):
    """Data whose unknown force acts on pan alone; moments of the residual see noise on the other joints."""
    system = damped()
    data = arm_data(rows, seed, system)
    q, v, u = (torch.tensor(x) for x in (data.q, data.v, data.u))
    force = torch.stack([-0.8 * torch.tanh(v[:, 0] / 0.4), *torch.zeros(2, rows).double()], -1)
    noise = NOISE * np.random.default_rng([seed, 1]).standard_normal((rows, 3))
    return replace(data, a=system.dynamics(q, v, u).acceleration(force).numpy() + noise, truth={})


def test_a_variance_does_not_collapse():
    data, learn, options = quiet_joint(12, 1), LinkInertia("hand", ("mass",)), OptimizerOptions(iterations=100)
    posterior = StructuredGP(damped()).identify(data, learn, restarts=1, options=options)
    objective = posterior.identification.objective
    bare = replace(objective, kernels=objective.likelihood.kernels())  # the same without priors on variances
    names = [f"kernels.{k}.raw_outputscale" for k in range(3)]
    start = objective.kernels.initial_parameters() | {PHYSICAL: posterior.result.iterates[0][PHYSICAL]}
    assert float(bare(start)) == pytest.approx(float(objective(start)) + 3 * AT_THE_CENTER, abs=1e-9)
    collapsed = minimize_objective(bare, start, options)

    def fall(parameters):
        return min(float(parameters[name] - start[name]) for name in names)

    assert fall(collapsed.parameters) < -10.0
    assert -4.0 < fall(posterior.parameters) < -1.0
    # the curvature knows of the prior: 1/4 for the log of each variance, less what the likelihood takes away
    assert posterior.identification.curvature.lowest_other > 0.1
    assert float(replace(objective, hyperprior=False)(start)) == float(replace(bare, hyperprior=False)(start))


def test_the_prior_on_variances_is_log_normal_and_has_its_gradient():
    shared = squared_exponential_kernel(2, 1.0, 0.3)
    own = ScaleKernel(RBFKernel(), outputscale_prior=NormalPrior(1.0, 5.0)).double()
    softplus = ScaleKernel(RBFKernel()).double()
    softplus.outputscale = torch.tensor(0.02, dtype=torch.float64)
    plain = LatentKernels([shared, shared, own, softplus])
    held = with_variance_priors(plain)
    parameters = {
        name: (value + 0.7).requires_grad_(name.endswith("raw_outputscale"))
        for name, value in plain.initial_parameters().items()
    }
    variance = math.log1p(float(parameters["kernels.3.raw_outputscale"].detach().exp()))
    moved = [math.log(variance / 0.02), 0.7]  # in the logarithm of the variance, whatever its constraint
    expected = sum(-0.5 * (x / 2.0) ** 2 - math.log(2.0 * math.sqrt(2.0 * math.pi)) for x in moved)
    difference = held.log_prior(parameters) - plain.log_prior(parameters)
    assert float(difference.detach()) == pytest.approx(expected, rel=1e-9)
    names = ("kernels.0.raw_outputscale", "kernels.3.raw_outputscale")

    def prior(*raw):
        return held.log_prior({**parameters, **dict(zip(names, raw, strict=True))})

    assert torch.autograd.gradcheck(prior, tuple(parameters[name] for name in names))
    assert with_variance_priors(held).log_prior(parameters) == held.log_prior(parameters)


def test_a_negative_strength_is_refused():
    data = arm_data(5, seed=0, system=damped())
    with pytest.raises(InvalidInput, match="prior_strength is -1"):
        StructuredGP(damped()).identify(data, LEARN, prior_strength=-1.0)


def test_estimates_at_the_limit_of_what_is_allowed_count_as_unknown():
    """Without known forces and without processes, nothing but M^-1 Q_b speaks of the mass, and it runs away."""
    data = arm_data(30, 1)
    system = data.system
    learn = system.robot.link("hand").inertial("mass")
    posterior = StructuredGP(system, NoForces(), "zero").identify(data, learn)
    found = posterior.identification
    at_limit = replace(
        found,
        parameters={
            **found.parameters,
            PHYSICAL: torch.linalg.solve(found.physical.transform, torch.full((1,), 25.0).double()),
        },
    )
    with pytest.warns(NumericalWarning, match="nothing counts as identified"):
        errors = at_limit.standard_errors
    assert list(errors.values()) == [float("inf")]
    assert not at_limit.at_optimum
    assert "has not ended at a minimum" in at_limit.verdict
    assert at_limit.to_dict()["decrement"] is None


def test_coefficients_can_be_learned_without_any_inertia():
    model = StructuredGP(damped(damping=(0.1, 0.1, 0.1)))
    found = model.identify(arm_data(20, 0), LEARN[1], restarts=1, options=OptimizerOptions(iterations=3))
    assert set(found.identification.values) == {f"viscous-joint-friction.{name}" for name in ("pan", "lift", "bend")}
