import dataclasses
import subprocess
import sys

import numpy as np
import pinocchio as pin
import pytest
import torch
from tests.data.samples import assert_equal

from forcegp.data import Dataset, units_for
from forcegp.errors import InvalidInput, SimulationError
from forcegp.mechanics import Plane
from forcegp.robots import Robot
from forcegp.simulation import KukaSurfaceConfig, QuadrotorConfig, simulate, simulate_kuka_surface
from forcegp.simulation.kuka_surface import TOOL_LINK, kuka_file, kuka_robot

SHORT = KukaSurfaceConfig(seconds=1.0, settle_seconds=1.0, seed=5)
"""Long enough to touch the surface, short enough to repeat."""


@pytest.fixture(scope="module")
def data() -> Dataset:
    return simulate_kuka_surface(KukaSurfaceConfig(seconds=5.0, seed=3))


@pytest.fixture(scope="module")
def short() -> Dataset:
    return simulate_kuka_surface(SHORT)


def tensors(data: Dataset, *names: str) -> list[torch.Tensor]:
    return [torch.tensor(data.truth[name] if name in data.truth else getattr(data, name)) for name in names]


def test_the_unknown_force_is_viscous_friction_at_the_tool_point(data):
    q, v, unknown = tensors(data, "q", "v", "Q_U")
    point = torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64)
    jacobian = data.model.robot.frame_jacobian(q, TOOL_LINK, point)[:, :3]
    np.testing.assert_allclose(unknown, (jacobian.mT @ (-1.0 * (jacobian @ v[..., None])))[..., 0], atol=1e-12)


def test_rows_follow_each_other_by_symplectic_euler(data):
    step = 1.0 / 240.0
    np.testing.assert_allclose(np.diff(data.time), step, rtol=1e-9)
    np.testing.assert_allclose(np.diff(data.v, axis=0), step * data.truth["a"][:-1], atol=1e-12)
    np.testing.assert_allclose(np.diff(data.q, axis=0), step * data.v[1:], atol=1e-13)


def test_limits_of_torque_are_kept(data):
    assert (np.abs(data.u + 0.5 * data.v) <= np.array([320, 320, 176, 176, 110, 40, 40])).all()


def test_a_step_is_the_acceleration_of_pinocchio(data):
    model = pin.buildModelFromXML(data.model.robot.urdf_text)
    model.gravity.linear = np.array([0.0, 0.0, -9.8])
    q, v, u, a, unknown, multiplier = tensors(data, "q", "v", "u", "a", "Q_U", "lambda")
    forces = (u + unknown + (data.model.dynamics(q, v, u).A.mT @ multiplier[..., None])[..., 0]).numpy()
    for row in range(0, len(data), 60):
        expected = pin.aba(model, model.createData(), data.q[row], data.v[row], forces[row])
        np.testing.assert_allclose(a[row], expected, rtol=1e-9, atol=1e-8)


def test_the_robot_is_the_original_with_another_tool_and_no_files():
    original, changed = Robot.from_urdf(kuka_file()), kuka_robot(KukaSurfaceConfig(tool_mass=3.5))
    assert changed.joints == original.joints
    for number in range(1, 7):
        links = [robot.link(f"lbr_iiwa_link_{number}") for robot in (changed, original)]
        for one, other in zip(*(vars(link).values() for link in links), strict=True):
            np.testing.assert_array_equal(one, other)
    tool = changed.link(TOOL_LINK)
    assert (tool.mass, *tool.center_of_mass) == (3.5, 0.0, 0.0, 0.02)
    np.testing.assert_allclose(tool.inertia, np.diag([0.005, 0.0036, 0.0047]))
    assert "mesh" not in changed.urdf_text.partition("<robot")[2]
    for text in (changed.urdf_text, kuka_file().read_text()):
        assert "THIS SOFTWARE IS PROVIDED BY THE COPYRIGHT HOLDERS" in text


# ---------------------------------------------------------------- the Dataset


def test_it_describes_itself(data):
    assert data.units == units_for(data.model.robot)
    assert data.time_ordered
    (contact,) = data.model.contacts
    assert (contact.frame, contact.surface) == (TOOL_LINK, Plane((0.0, 0.0, 1.0), 0.055))
    assert KukaSurfaceConfig(**data.metadata["config"]) == KukaSurfaceConfig(seconds=5.0, seed=3)


# ---------------------------------------------------------------- seeds


def test_the_noise_leaves_the_motion_as_it_is(short):
    silent = simulate_kuka_surface(dataclasses.replace(SHORT, noise=0.0))
    assert silent.noise_std is None
    np.testing.assert_array_equal(silent.a, silent.truth["a"])
    for name in ("q", "v", "u"):
        np.testing.assert_array_equal(getattr(silent, name), getattr(short, name))
    loud = simulate_kuka_surface(dataclasses.replace(SHORT, noise=0.2))
    np.testing.assert_allclose(loud.a - silent.a, 2 * (short.a - silent.a), atol=1e-12)


# ---------------------------------------------------------------- what it refuses


@pytest.mark.parametrize(
    ("config", "field", "least", "most"),
    [
        (KukaSurfaceConfig, "seconds", 0.1, 1e5), (KukaSurfaceConfig, "noise", 0.0, 1e9),
        (KukaSurfaceConfig, "seed", 0, 2**63 - 1), (KukaSurfaceConfig, "episodes", 1, 10_000),
        (KukaSurfaceConfig, "time_step", 1e-5, 0.01), (KukaSurfaceConfig, "settle_seconds", 0.5, 1e3),
        (KukaSurfaceConfig, "tool_mass", 1e-12, 1e9), (QuadrotorConfig, "wind", 0.0, 15.0),
        (QuadrotorConfig, "lag", 0.005, 0.2),
    ],
)  # fmt: skip
def test_numbers_are_taken_from_their_range_only(config, field, least, most):
    step = 1 if isinstance(least, int) else 1e-14 + 1e-9 * least
    for value in (least, most):
        assert getattr(config(**{field: value}), field) == value
    for value in (least - step, most + 1e7 * step, float("nan")):
        with pytest.raises(InvalidInput, match=f"^{field}.* from |^{field}.* >"):
            config(**{field: value})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"segment_seconds": (50.0, 50.0), "least_acceleration": 1e-3}, "episode 0: no contact within"),
        ({"torque_limits": (1e9,) * 7, "controller_omega": 2000.0}, "episode 0 diverged after"),
    ],
)
def test_data_of_no_use_are_not_returned(changes, message):
    with pytest.raises(SimulationError, match=message):
        simulate_kuka_surface(type("Odd", (KukaSurfaceConfig,), changes)(**dataclasses.asdict(SHORT)))


def test_scenarios_are_found_by_name(short):
    assert_equal(simulate("kuka-surface", **dataclasses.asdict(SHORT)), short)
    with pytest.raises(InvalidInput, match="no scenario 'mars'"):
        simulate("mars")


def test_listing_scenarios_and_their_options_loads_no_library():
    code = (
        "import sys; from forcegp.simulation import SCENARIOS; SCENARIOS['kuka-surface'][0](); "
        "print(*{name.partition('.')[0] for name in sys.modules})"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"numpy", "torch", "h5py"} & set(run.stdout.split())


# ---------------------------------------------------------------- the paper's data


@pytest.fixture(scope="module")
def paper(shared) -> dict[str, np.ndarray]:
    with np.load(shared("reference/kuka_paper.npz")) as file:
        return dict(file)


def test_the_robot_of_the_scenario_is_the_papers(paper, data):
    robot = kuka_robot(KukaSurfaceConfig())
    q, v, u = (torch.tensor(paper[f"test_{name}"]) for name in "qvu")
    np.testing.assert_allclose(robot.mass_matrix(q), paper["test_M"], atol=1e-9)
    np.testing.assert_allclose(robot.bias_forces(q, v), -paper["test_f"] - paper["test_g"], atol=1e-9)
    dynamics = data.model.dynamics(q, v, u)
    np.testing.assert_allclose(dynamics.A, paper["test_A"], atol=1e-9)
    np.testing.assert_allclose(dynamics.b, paper["test_b"], atol=1e-9)
    unknown = torch.tensor(paper["test_Q_U"])
    np.testing.assert_allclose(dynamics.acceleration(unknown), paper["test_a"], atol=1e-8)
    np.testing.assert_allclose(dynamics.multiplier(unknown), paper["test_lambda"], atol=1e-8)
