"""The unrolled algorithms against the tensor ones and Pinocchio, on every kind of joint, and what must hold anyway."""

import numpy as np
import pytest
import torch
from tests.robots.pinocchio_oracle import Oracle
from tests.robots.robot_models import CHAIN, FRAMES, MODELS, TREE

from forcegp.errors import InvalidInput
from forcegp.robots import Robot, scalar_algebra
from forcegp.robots.inertia import pseudo_inertia_from_parameters
from forcegp.robots.unrolled import UnrolledRobot
from forcegp.robots.unrolled_kinematics import UnrolledKinematics

COUNT = 6
POINT = (0.07, -0.11, 0.23)


def stacked(values, batch=(COUNT,)):
    """A nested list of scalars as one tensor (*batch, ...)."""
    if isinstance(values, list):
        return torch.stack([stacked(value, batch) for value in values], dim=len(batch))
    return torch.as_tensor(values, dtype=torch.float64).expand(batch)


def close(ours, theirs, tolerance=1e-10):
    scale = float(torch.as_tensor(theirs).abs().max())
    torch.testing.assert_close(stacked(ours), torch.as_tensor(theirs), rtol=0, atol=tolerance * scale)


@pytest.fixture(params=[*MODELS, "tree with armature", "tree locked", "chain in odd gravity"])
def case(request):
    """A robot, its URDF text, the name of a frame, and random states as tensors (COUNT, nv)."""
    options = {
        "tree with armature": {"armature": {"torso": 0.3, "left_gripper": 1.7, "right_wrist": 0.02}},
        "tree locked": {"locked": {"right_shoulder": 2.3, "left_gripper": 0.03}},
        "chain in odd gravity": {"gravity": (1.0, -7.0, 3.0), "armature": (0.5, 0.1, 0.2, 0.05)},
    }.get(request.param, {})
    model = request.param.split()[0]
    text = MODELS[model]()
    robot = Robot.from_urdf_text(text, **options)
    states = torch.tensor(np.random.default_rng(7).normal(scale=1.5, size=(3, COUNT, robot.nv)))
    return robot, text, FRAMES[model], *states


def test_dynamics_equal_those_of_the_robot(case):
    robot, _, _, q, v, a = case
    at = UnrolledKinematics(UnrolledRobot(robot), q.unbind(-1), v.unbind(-1))
    close(at.mass_matrix(), robot.mass_matrix(q))
    close(at.bias_forces(), robot.bias_forces(q, v))
    close(at.gravity_forces(), robot.gravity_forces(q))
    close(at.inverse_dynamics(a.unbind(-1)), robot.inverse_dynamics(q, v, a))
    close(at.forward_dynamics(a.unbind(-1)), robot.forward_dynamics(q, v, a))


def test_dynamics_equal_those_of_pinocchio(case):
    robot, text, _, q, v, a = case
    oracle = Oracle(text, robot)
    at = UnrolledKinematics(UnrolledRobot(robot), q.unbind(-1), v.unbind(-1))
    every = list(zip(q.numpy(), v.numpy(), a.numpy(), strict=True))
    close(at.mass_matrix(), np.stack([oracle.mass_matrix(x) for x, _, _ in every]))
    close(at.inverse_dynamics(a.unbind(-1)), np.stack([oracle.inverse_dynamics(*x) for x in every]))
    close(at.forward_dynamics(a.unbind(-1)), np.stack([oracle.forward_dynamics(*x) for x in every]))


@pytest.mark.parametrize("point", [None, POINT])
def test_points_equal_those_of_the_robot(case, point):
    robot, _, frame, q, v, _ = case
    at = UnrolledKinematics(UnrolledRobot(robot), q.unbind(-1), v.unbind(-1))
    pose = robot.frame_pose(q, frame)
    local = torch.tensor(point or (0.0, 0.0, 0.0), dtype=torch.float64)
    close(at.point(frame, point), pose[:, :3, :3] @ local + pose[:, :3, 3])
    close(at.point_jacobian(frame, point), robot.frame_jacobian(q, frame, point)[:, :3])
    close(at.point_bias_acceleration(frame, point), robot.frame_bias_acceleration(q, v, frame, point)[:, :3])


def test_points_fixed_in_the_world():
    robot = Robot.from_urdf_text(TREE)
    q = torch.zeros(robot.nv, COUNT, dtype=torch.float64)
    at = UnrolledKinematics(UnrolledRobot(robot), list(q), list(q))
    expected = robot.frame_pose(q.mT, "base")[0, :3, 3]
    assert at.point("base") == pytest.approx(expected.tolist())
    assert at.point_jacobian("base") == [[0.0] * robot.nv] * 3
    assert at.point_bias_acceleration("base", POINT) == [0.0] * 3


def test_other_inertias_take_the_place_of_the_robots():
    robot = Robot.from_urdf_text(CHAIN)
    generator = torch.Generator().manual_seed(1)
    q, v = torch.randn(2, COUNT, robot.nv, generator=generator, dtype=torch.float64)
    inertials = {"hub": torch.randn(COUNT, 10, generator=generator, dtype=torch.float64)}
    bodies = robot.body_inertias(inertials).expand(-1, -1, -1, COUNT)
    at = UnrolledKinematics(UnrolledRobot(robot), q.unbind(-1), v.unbind(-1))
    given = [[list(row) for row in body] for body in bodies]
    close(at.mass_matrix(given), robot.mass_matrix(q, inertials))
    close(at.bias_forces(given), robot.bias_forces(q, v, inertials))


def test_structure_stays_structure():
    """Joints on different branches are coupled by the float 0.0, and nothing fills in when M is factorised."""
    robot = Robot.from_urdf_text(TREE)
    q = torch.randn(COUNT, robot.nv, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    M = UnrolledKinematics(UnrolledRobot(robot), q.unbind(-1)).mass_matrix()
    L, D = scalar_algebra.factorize(M)
    zero = [[scalar_algebra.is_zero(x) for x in row] for row in M]
    related = robot.tree.related[..., 0].bool()
    assert torch.equal(~torch.tensor(zero), related)
    assert torch.equal(~torch.tensor([[scalar_algebra.is_zero(x) for x in row] for row in L]), related.tril())
    L, D = stacked(L), stacked(D)
    torch.testing.assert_close(L.mT @ D.diag_embed() @ L, robot.mass_matrix(q))


def test_coarser_rounding_drops_what_angles_of_twelve_digits_leave():
    """The iiwa's file turns by 1.57079632679, so that 5e-12 stands where zeros are meant."""
    robot = Robot.from_urdf_text(MODELS["iiwa"]())
    q = torch.randn(COUNT, robot.nv, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    fine, coarse = (UnrolledRobot(robot, rounding=rounding) for rounding in (1e-15, 1e-11))
    entries = [[x for joint in of.joints for row in joint.rotation for x in row] for of in (fine, coarse)]
    assert entries[0].count(0.0) < entries[1].count(0.0) == 6 * robot.nv  # the turns are signed permutations
    close(UnrolledKinematics(coarse, q.unbind(-1)).mass_matrix(), robot.mass_matrix(q))


def test_states_given_as_floats_are_constants():
    robot = Robot.from_urdf_text(CHAIN)
    at = UnrolledKinematics(UnrolledRobot(robot), [0.1, 0.0, 0.3, -0.4], [0.0, 1.0, 0.0, 2.0])
    q, v = torch.tensor([[0.1, 0.0, 0.3, -0.4], [0.0, 1.0, 0.0, 2.0]], dtype=torch.float64)
    assert all(isinstance(x, float) for x in at.bias_forces())
    assert at.bias_forces() == pytest.approx(robot.bias_forces(q, v).tolist(), rel=1e-11)


def test_gradients_against_differences():
    robot = Robot.from_urdf_text(CHAIN)
    unrolled = UnrolledRobot(robot)
    generator = torch.Generator().manual_seed(3)
    q, v, tau = torch.randn(3, robot.nv, generator=generator, dtype=torch.float64).requires_grad_().unbind(0)
    parameters = (0.3 * torch.randn(robot.nv, 10, generator=generator, dtype=torch.float64)).requires_grad_()

    def accelerations(q, v, tau, parameters):
        bodies = [[list(row) for row in body] for body in pseudo_inertia_from_parameters(parameters)]
        return torch.stack(UnrolledKinematics(unrolled, list(q), list(v)).forward_dynamics(list(tau), bodies))

    assert torch.autograd.gradcheck(accelerations, (q, v, tau, parameters))


@pytest.mark.parametrize("text", [TREE, CHAIN], ids=["tree", "chain"])
def test_inverse_of_forward_dynamics_and_positive_mass(text):
    robot = Robot.from_urdf_text(text)
    q, v, tau = torch.randn(3, COUNT, robot.nv, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    at = UnrolledKinematics(UnrolledRobot(robot), q.unbind(-1), v.unbind(-1))
    close(at.inverse_dynamics(at.forward_dynamics(tau.unbind(-1))), tau)
    M = stacked(at.mass_matrix())
    assert torch.equal(M, M.mT)
    assert torch.linalg.eigvalsh(M).min() > 0.0


def test_solvers_against_dense_ones():
    generator = torch.Generator().manual_seed(5)
    root = torch.randn(COUNT, 5, 5, generator=generator, dtype=torch.float64)
    matrix = root @ root.mT + torch.eye(5, dtype=torch.float64)
    b = torch.randn(COUNT, 5, generator=generator, dtype=torch.float64)
    rows = [list(row.unbind(-1)) for row in matrix.unbind(-2)]
    solution = torch.linalg.solve(matrix, b)
    close(scalar_algebra.solve_factorized(*scalar_algebra.factorize(rows), list(b.unbind(-1))), solution)


def test_wrong_numbers_of_scalars():
    unrolled = UnrolledRobot(Robot.from_urdf_text(CHAIN))
    with pytest.raises(InvalidInput, match="q holds 2 scalars; chain has 4 joints"):
        UnrolledKinematics(unrolled, [0.0, 0.0])
    with pytest.raises(InvalidInput, match="v holds 3 scalars"):
        UnrolledKinematics(unrolled, [0.0] * 4, [0.0] * 3)
    at = UnrolledKinematics(unrolled, [0.0] * 4)
    with pytest.raises(InvalidInput, match=r"bias_forces needs velocities; .*UnrolledKinematics\(unrolled, q, v\)"):
        at.bias_forces()
    with pytest.raises(InvalidInput, match=r"inertias .*1 .*4x4 .*4 in all"):
        at.mass_matrix([[[1.0]]])
    with pytest.raises(InvalidInput, match="point holds 2 scalars"):
        at.point("tool", [0.0, 0.0])
