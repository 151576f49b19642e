"""Every force as it was: numbers and words, at states of an arm on a plane whose last joint slides."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.forces.force_conformance import bent_arm, some_states
from tests.forces.test_parse_forces import EXPRESSIONS, NAMES
from tests.forces.test_thrusters import DRONE, PLACES
from tests.goldens.compare import assert_unchanged
from tests.robots.mjcf_models import ARM, CHAIN, QUADROTOR
from tests.robots.random_positions import random_positions

from forcegp import Model, Robot
from forcegp.errors import RobotFileWarning
from forcegp.forces import Actuation, Coulomb, Law, Payload, RigidBodies, Thrusters, Viscous, force_to_dict
from forcegp.forces.contact_friction import ExpectedFriction, TabulatedCurve
from forcegp.forces.force import Memory
from forcegp.forces.joint_laws import law_columns, usual_columns
from forcegp.forces.kernels import KERNELS, kernel_of
from forcegp.forces.unknown import has_few_inputs

SPRUNG = """<body name="pod"><joint name="tilt" stiffness="3" springref="20" damping=".2"/><geom size=".1"/>
<site name="up"/></body></body></worldbody>"""


def numbers(tensors) -> list:
    return [x.detach().tolist() if isinstance(x, torch.Tensor) else None for x in tensors]


def of_law(law, dynamics) -> dict:
    robot, state = dynamics.state.robot, dynamics.state
    names = law.bound_to(robot).memory_names(robot)
    bound = (replace(law, memory=False) if names else law).bound_to(robot)
    typical = {name: k + np.arange(1.0, 4.0) for k, name in enumerate(("force", "position", "velocity", "inertia"))}
    features = () if isinstance(law, RigidBodies | Payload) else bound.features(bound.seen(state))
    opened = bound.open() if bound.coefficients else bound
    return {
        "values": numbers(bound.values.values()),
        "parts": numbers([bound.direction(state), *features, features and bound.amplitude(features, bound.values)]),
        "force": numbers([bound.force(state), bound.added_inertia(robot)]),
        "learned": [str(bound.learned), str(opened.learned), bound.title, str(names)],
        "acts": {name: [*map(float, bound.acts_on(name, robot))] for name in bound.coefficients},
        "units": [bound.unit(name, joint, robot) for name in bound.coefficients for joint in robot.joint_names],
        "sizes": {name: each.size(typical) for name, each in bound.coefficients.items()},
    }


def of_unknown(prior, dynamics) -> dict:
    robot, features = dynamics.state.robot, prior.features(dynamics)
    variances = torch.linspace(0.5, 2.0, len(features)).double()
    kernels = prior.kernels(robot, tuple(z.shape[-1] for z in features), variances)
    words = prior.title, prior.latent_names(robot), prior.latent_units(robot), prior.feature_names(robot)
    return {
        "parts": numbers([prior.direction(dynamics), *features, prior.point_force(dynamics)]),
        "words": [*map(str, words), str(prior.scalings(robot)), str(has_few_inputs(prior, robot))],
        "covariance": numbers(k(z, z[:2]).to_dense() for k, z in zip(kernels, features, strict=True)),
    }


@pytest.mark.usefixtures("unchecked")
def test_forces_at_states():
    dynamics, found = bent_arm().dynamics(*(0.5 * x for x in some_states(4))), {}
    for text, force in (NAMES | EXPRESSIONS).items():
        if getattr(force, "contact", 0) == 0:  # the only one
            found[text] = of_law(force, dynamics) if isinstance(force, Law) else of_unknown(force, dynamics)
    assert_unchanged("forces/forces", found)


def test_kernels_and_their_priors():
    found, z = {}, torch.linspace(-2.0, 2.0, 5).double()[:, None]
    for name in (*KERNELS, "linear + matern-3/2"):
        for dimension in (1,) if "friction" in name else (1, 3):
            kernel, points = kernel_of(name, dimension, 0.7), z * torch.arange(1.0, dimension + 1.0)
            priors = [prior.log_prob(closure(module)) for _, module, prior, closure, _ in kernel.named_priors()]
            start = [parameter.flatten() for parameter in kernel.parameters()]
            found[f"{name} of {dimension}"] = numbers([kernel(points, points + 0.3).to_dense(), *priors, *start])
    assert_unchanged("forces/kernels", found)


def test_expected_friction_and_memory():
    model = bent_arm()
    curves = TabulatedCurve((0.0, 0.1, 0.5), (0.1, 0.4, 0.2)), TabulatedCurve((-1.0, 0.0, 2.0), (-0.5, 0.0, 0.3))
    dynamics = model.dynamics(*(0.5 * x for x in some_states(6)))
    expected = ExpectedFriction(curves[0], (("lift", curves[1]),))
    laws = Coulomb(0.5, memory=("lift", "bend"), sigma=200.0), Viscous(1.0)
    memory = Memory([law.bound_to(model.robot) for law in laws], model.robot)
    z, v, seen = (torch.tanh(x) for x in some_states(6))
    strokes = 0.01 * torch.stack(some_states(6), dim=-1)
    found = {
        "load": numbers([expected.normal_force(dynamics, 0, z, v[:, 0].abs()), *(curve(v[:, 0]) for curve in curves)]),
        "memory": numbers([*memory.likely(v, z[:, :2], seen), memory.after(z[:, :2], 0.01 * v, 0.02)]),
        "past": numbers([memory.past_of(strokes)]),
        "columns": law_columns(laws, model.robot, *(x.numpy() for x in (z, v, seen, v))),
        "usual": usual_columns(model.robot, *(x.numpy() for x in (z, v, seen, v)), (0.1, 1.0)),
    }
    assert_unchanged("forces/expected", found)


def test_forces_that_files_state_and_thrusters(tmp_path):
    robot, found, generator = Robot.from_urdf_text(DRONE, base="floating"), {}, torch.Generator().manual_seed(0)
    q = random_positions(robot, generator, 3)
    v, u = (torch.randn(3, n, dtype=torch.float64, generator=generator) for n in (robot.nv, 4))
    wrenches = [(0, 0, 1, 0, 0, 0.02), (1, 2, -3, 0.4, 0.5, 0.6), (0, 0, 0, 0.1, 0.2, -0.3), (0,) * 6]
    made = {str(wrench): Thrusters.of_wrench("pod", wrench, "one") for wrench in wrenches}
    for name, force in (made | {"plain": Thrusters("pod", PLACES, power=2)}).items():
        model = Model(robot, (), (force, Actuation(np.eye(robot.nv)[:, -2:], ("a", "b"))))
        dynamics = model.dynamics(q, v, u[:, : len(model.inputs)])
        found[name] = of_law(model.laws[0], dynamics) | {"u": model.inputs, "Q": dynamics.Q_K.tolist()}
    sprung = QUADROTOR.replace("</body></worldbody>", SPRUNG)
    for name, text in (("arm", ARM), ("chain", CHAIN), ("rotors", QUADROTOR), ("sprung", sprung)):
        (tmp_path / "robot.xml").write_text(text)
        with warnings.catch_warnings(action="ignore", category=RobotFileWarning):
            model = Model.from_mjcf(tmp_path / "robot.xml")
        found[name] = {"u": model.inputs, "forces": [force_to_dict(force) for force in model.laws]}
    assert_unchanged("forces/files", found)
