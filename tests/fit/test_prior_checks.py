"""What no data can teach is said before the fit, with the names of what is concerned and what to do about it."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.evidence.test_contact_forces import SENSOR, held, measured, on_plane, tensors
from tests.forces.world_forces import WorldForces
from tests.posterior.arm import arm_data, arm_model
from torch.testing import assert_close

from forcegp import AerodynamicForce, ContactForces, Torques, Viscous
from forcegp.errors import DataWarning, InvalidInput, UnknownName
from forcegp.fit import fit as fit_model
from forcegp.fit.physical import typical_sizes
from forcegp.fit.sensors import with_sensors
from forcegp.fit.unseen import PUSHED, Unseen
from forcegp.forces import Actuation, ContactFriction, JointForces, JointFriction, JointPositionForces, ToolForces
from forcegp.inference import OptimizerOptions
from forcegp.mechanics import Contact, Plane
from forcegp.noise import Noise

ONCE = OptimizerOptions(iterations=1)
TIP = (0.0, 0.0, 0.2)
TABLE = (Contact("hand", TIP, Plane((0.0, 0.0, 1.0), 0.4)),)


@pytest.fixture(scope="module")
def data():
    return arm_data(12, 1)


@pytest.fixture(scope="module")
def on_a_table():
    return arm_data(12, 1, arm_model().with_contacts(TABLE))


def fit(data, *forces, mean=True, noise=None):
    model = data.model.with_forces(*forces, noise=noise)
    return fit_model(model if mean else model.without_mean(), data, restarts=1, options=ONCE)


def with_columns(data, **columns):
    return replace(data, truth={}, **columns)


@pytest.mark.parametrize("prefix", ["", "tool-friction "], ids=["alone", "in-a-sum"])
def test_a_force_along_the_normal_is_hidden(on_a_table, prefix):
    prior = WorldForces()
    forces = (prior, JointFriction()) if prefix else (prior,)
    with pytest.warns(DataWarning) as caught:
        posterior = fit(on_a_table, *forces)
    (message,) = [str(warning.message) for warning in caught]
    assert message.startswith(f"no data can identify '{prefix}force-z': the contacts take that force")
    assert "learn a force along the surface, such as gp:tool-friction" in message
    force = posterior.components(on_a_table.q, on_a_table.v, on_a_table.u)["tool-friction"].latents
    states = [torch.tensor(x) for x in (on_a_table.q, on_a_table.v, on_a_table.u)]
    z = posterior.likelihood.standardization(posterior.model.unknown.features(on_a_table.model.dynamics(*states)))[2]
    prior_variance = list(posterior.latent.kernels)[2](z, diag=True)
    assert_close(force.mean[:, 2], torch.zeros(12).double(), rtol=0.0, atol=1e-6)
    assert_close(force.variance[:, 2], posterior.widening**2 * prior_variance.detach(), rtol=1e-6, atol=0.0)


def test_along_the_surface_nothing_is_hidden(on_a_table):
    with warnings.catch_warnings(action="error"):
        fit(on_a_table, ToolForces(), JointFriction())


def test_all_hidden_is_refused(data):
    """A point that is held along all three axes holds the whole arm."""
    robot, q = data.model.robot, torch.tensor(data.q[:1]).expand(12, 3).clone()
    tip = Contact("hand", TIP, TABLE[0].surface).position(robot.kinematics(q))[0]
    normals = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    walls = [Plane(normal, float(tip[axis])) for axis, normal in enumerate(normals)]
    held = data.model.with_contacts([Contact("hand", TIP, wall) for wall in walls])
    rows = with_columns(data, q=q.numpy(), model=held)
    with pytest.raises(InvalidInput, match="'pan', 'lift', 'bend': the contacts"):
        fit(rows, JointFriction())


def test_a_term_that_moves_no_joint_is_refused(data):
    class Idle(JointFriction):
        def direction(self, dynamics):
            return 0.0 * super().direction(dynamics)

    with pytest.raises(InvalidInput, match=r"'idle pan', 'idle lift', .*no force.*frame, point and contact"):
        fit(data, JointFriction(), Idle())


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (JointFriction(), r"latent 'lift' depends on velocity of lift \[rad/s\], which is the same in all 12"),
        ((JointPositionForces(), JointForces(("u",))), "latent 'joint-position-forces lift' depends on position of"),
        ((JointFriction(), ContactFriction()), "latent 'joint-friction lift'"),
    ],
    ids=["friction", "position", "sum"],
)
def test_a_joint_that_never_moves_teaches_nothing_of_its_own(data, prior, message):
    free, moving = data.model.with_contacts([]), np.array([1.0, 0.0, 1.0])
    stuck = with_columns(data, q=data.q * moving, v=data.v * moving, model=free)
    if isinstance(prior, tuple) and ContactFriction() in prior:
        stuck = with_columns(data, v=data.v * moving)
    with pytest.raises(InvalidInput, match=message) as caught:
        fit(stuck, prior)
    assert "give data in which it changes, or leave this prior (or this joint) out" in str(caught.value)
    fit(stuck, JointFriction(("pan", "bend")))


@pytest.mark.parametrize("prior", [ToolForces(), ContactFriction()], ids=["tool", "contact"])
def test_a_tool_that_never_moves_has_no_friction(data, prior):
    with pytest.raises(InvalidInput, match=r"\[m/s\].* all 12 training rows"):
        fit(with_columns(data, v=np.zeros((12, 3))), prior)


@pytest.mark.parametrize(
    ("prior", "error", "message"),
    [
        (AerodynamicForce("base"), InvalidInput, "AerodynamicForce acts on frame 'base', which is fixed"),
        (AerodynamicForce("tool"), UnknownName, "no frame 'tool'"),
        (JointFriction(("pna",)), UnknownName, "did you mean 'pan'"),
        (JointPositionForces(("elbow",)), UnknownName, "Valid joints: bend, lift, pan"),
        (ContactFriction(contact=1), InvalidInput, "contact 1, but the model has only contact 0"),
        ((JointFriction(), ToolForces(contact=2)), InvalidInput, "acts at contact 2"),
    ],
    ids=lambda value: value.title if hasattr(value, "title") else "",
)
def test_a_prior_that_does_not_fit_the_system_is_refused_before_any_data(data, prior, error, message):
    with pytest.raises(error, match=message):
        data.model.with_forces(prior)


def test_forces_of_a_contact_need_one():
    with pytest.raises(InvalidInput, match=r"no contact with a surface.*`contacts`"):
        arm_model(contacts=0).with_forces(ToolForces())


def test_equal_terms_are_refused(data):
    with pytest.raises(InvalidInput, match="'joint-friction' twice"):
        data.model.with_forces(JointFriction(), ContactFriction(), JointFriction())


@pytest.mark.parametrize(
    "prior",
    [
        (JointFriction(), JointForces(("v",))), (JointFriction(), JointForces()), (ContactFriction(), ToolForces()),
        (JointFriction(("pan",)), JointFriction(("lift",))), (JointFriction(), ()), (),
    ],
    ids=["inputs", "all", "axes", "joints", "nothing", "none"],
)  # fmt: skip
def test_terms_that_differ_are_fitted_without_a_word(data, prior):
    with warnings.catch_warnings(action="error"):
        fit(data, *prior)


def test_no_residual_at_all_is_refused(data):
    states = [torch.tensor(x) for x in (data.q, data.v, data.u)]
    exact = with_columns(data, a=data.model.dynamics(*states).acceleration_map().offset.numpy())
    with pytest.raises(InvalidInput, match="accelerations equal the mean"):
        fit(exact, JointFriction(), noise=Noise(0.1))


@pytest.mark.parametrize(("force", "found"), [(1.3, ("lift",)), (0.7, ())])
def test_a_joint_that_something_pushes_teaches_nothing(force, found):
    truth, log = held(Actuation(gain=[0.8, 1.0, 1.0])), measured(held(), held(), rows=100)
    log = replace(log, u=log.u * [1.0, 0.0, 1.0], measured={})
    needed = held().robot.kinematics(*tensors(log, "q", "v")).inverse_dynamics(torch.tensor(log.a)).numpy()
    push = np.zeros((100, 3))
    push[:, 1] = force * PUSHED * np.sqrt((needed[:, 1] ** 2).mean())
    log = replace(log, a=truth.dynamics(*tensors(log, "q", "v", "u")).acceleration(torch.tensor(push)).numpy())
    unseen = Unseen.of(held(), log, typical_sizes(held(), [log])["force"])
    assert tuple(log.joint_names[j] for j in unseen.pushed) == found
    if found:
        with pytest.warns(DataWarning, match="nothing drives lift, u is 0 there"):
            posterior = fit_model(held(Viscous()), log, Torques())
        assert posterior.model.noise.pushes[1] == pytest.approx(10.0 * push[0, 1], rel=0.3)


def test_noise_that_nobody_states_begins_at_two_per_cent():
    log = measured(on_plane(), on_plane(), rows=20)
    noise = with_sensors(log, log.model, Torques(), [ContactForces()])[1].noise
    assert noise.sensor == pytest.approx((0.02 * np.sqrt((log.measured[SENSOR] ** 2).mean()),))
    assert with_sensors(log, held(), Torques(), [ContactForces(noise=0.7)])[1].noise.sensor == (0.7,) * 3
    typical = np.array([1.0, 2.0, 3.0])
    assert Unseen(typical, (), 0.0 * typical, None).with_pushes(noise).force == pytest.approx(0.02 * typical)
