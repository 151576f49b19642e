"""The scenario's kinds of friction, surface and contact: the physics by forcegp's own robot."""

import numpy as np
import pytest
import torch

from forcegp.data import Dataset
from forcegp.errors import InvalidInput, SimulationError
from forcegp.simulation import KukaSurfaceConfig, simulate_kuka_surface
from forcegp.simulation.kuka_surface import PointFriction, joint_friction_of

SCENES = {
    "stribeck": {"friction": "stribeck", "joint_friction": "stribeck"},
    "tilted": {"surface": "tilted", "friction": "coulomb"},
    "none": {"surface": "none", "joint_friction": "stribeck"},
}


def config(name: str) -> KukaSurfaceConfig:
    return KukaSurfaceConfig(**{"seconds": 1.5, "settle_seconds": 1.5, "seed": 5, **SCENES[name]})


@pytest.fixture(scope="module")
def scenes() -> dict[str, Dataset]:
    return {name: simulate_kuka_surface(config(name)) for name in SCENES}


def tensors(data: Dataset, *names: str) -> list[torch.Tensor]:
    return [torch.tensor(data.truth[name] if name in data.truth else getattr(data, name)) for name in names]


def tool_motion(data: Dataset) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Jacobian, velocity, normal and place of the tool point in every row."""
    q, v, u = tensors(data, "q", "v", "u")
    dynamics, (contact,) = data.model.dynamics(q, v, u), data.model.contacts
    jacobian = dynamics.state.kinematics.frame_jacobian(contact.frame, contact.point)[:, :3]
    place = contact.position(dynamics.state.kinematics)
    velocity = (jacobian @ v[..., None])[..., 0]
    return tuple(part.numpy() for part in (jacobian, velocity, dynamics.normals[:, 0], place))


@pytest.mark.parametrize("name", SCENES)
def test_the_equations_of_motion_hold_in_every_row(scenes, name):
    data = scenes[name]
    q, v, u, a, unknown = tensors(data, "q", "v", "u", "a", "Q_U")
    dynamics = data.model.dynamics(q, v, u)
    force = u + unknown
    if data.model.contacts:
        (multiplier,) = tensors(data, "lambda")
        force = force + (dynamics.A.mT @ multiplier[..., None])[..., 0]
    np.testing.assert_allclose(data.model.robot.inverse_dynamics(q, v, a), force, rtol=0, atol=1e-10)
    if name != "none":
        np.testing.assert_allclose((dynamics.A @ a[..., None])[..., 0], dynamics.b, rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", SCENES)
def test_parts_of_the_unknown_force_exist_where_the_force_does_and_add_up(scenes, name):
    data, made = scenes[name], config(name)
    parts = {part for part in data.truth if part.startswith("Q_U.")}
    expected = set() if made.surface == "none" else {"Q_U.tool-friction"}
    expected |= {"Q_U.joint-friction"} if made.joint_friction != "none" else set()
    assert parts == expected
    assert ("lambda" in data.truth) == ("force.tool-friction" in data.truth) == (made.surface != "none")
    assert len(data.model.contacts) == (made.surface != "none")
    np.testing.assert_allclose(sum(data.truth[part] for part in parts), data.truth["Q_U"], atol=1e-13)
    assert KukaSurfaceConfig(**data.metadata["config"]) == made


@pytest.mark.parametrize("name", ["stribeck", "tilted"])
def test_dry_friction_is_its_law_at_the_true_normal_force(scenes, name):
    data, made = scenes[name], config(name)
    jacobian, velocity, normal, _ = tool_motion(data)
    force, load = data.truth["force.tool-friction"], np.abs(data.truth["lambda"][:, 0])
    static = made.static_coefficient if made.friction == "stribeck" else made.coulomb_coefficient
    law = PointFriction(0.0, made.coulomb_coefficient, static, made.breakaway_velocity, made.friction_smoothing)
    tangential = velocity - (velocity * normal).sum(1)[:, None] * normal
    speed = np.linalg.norm(tangential, axis=1)
    np.testing.assert_allclose(np.linalg.norm(force, axis=1), law.coefficient(speed) * load, atol=1e-9)
    assert ((force * velocity).sum(1) <= 1e-12).all()
    np.testing.assert_allclose((force * normal).sum(1), 0.0, atol=1e-10)
    torques = (jacobian.transpose(0, 2, 1) @ force[..., None])[..., 0]
    np.testing.assert_allclose(torques, data.truth["Q_U.tool-friction"], atol=1e-10)
    assert 10.0 < np.median(load) < 40.0


def test_joint_friction_is_its_law(scenes):
    data = scenes["none"]
    np.testing.assert_array_equal(
        data.truth["Q_U.joint-friction"], joint_friction_of(config("none"), data.model.robot)(data.v, data.u)
    )


def test_free_motion_stays_above_the_table(scenes):
    data = scenes["none"]
    pose = data.model.robot.frame_pose(torch.tensor(data.q), "lbr_iiwa_link_7").numpy()
    height = (pose[:, :3, :3] @ [0.0, 0.0, 0.1] + pose[:, :3, 3])[:, 2]
    np.testing.assert_allclose(height, 0.055 + 0.05, atol=5e-3)
    assert data.model.contacts == ()


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"friction": "wet"}, "no friction .wet. in the tool"), ({"surface": "cone"}, "no surface 'cone'")],
)
def test_parts_that_do_not_fit_are_refused(changes, message):
    with pytest.raises(InvalidInput, match=message):
        KukaSurfaceConfig(**changes)


def test_friction_beyond_what_determines_the_normal_force_is_refused():
    extreme = {"coulomb_coefficient": 20.0, "static_coefficient": 20.0, "friction_smoothing": 1e-3}
    with pytest.raises(SimulationError, match="not determined"):
        simulate_kuka_surface(KukaSurfaceConfig(seconds=1.0, friction="stribeck", **extreme))
