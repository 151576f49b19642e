"""The unrolled algorithms against the tensor ones and Pinocchio, on every kind of joint, and what must hold anyway."""

import numpy as np
import pytest
import torch
from tests.robots.robot_models import MODELS, TREE

from forcegp.codegen.graph import Graph, evaluated, node_of
from forcegp.robots import Robot
from forcegp.robots.compiled import UnrolledKinematics, UnrolledRobot, factorize, solve_factorized

COUNT = 6


class Scalars:
    """Rows of numbers (COUNT, n) as expressions, and arrays of expressions as numbers (COUNT, ...)."""

    def __init__(self, *rows):
        self.graph, self.values = Graph(), [column for given in rows for column in np.asarray(given).T]
        self.given = [self.graph.more_inputs(np.shape(given)[1]) for given in rows]

    def numbers(self, array):
        nodes = [node_of(self.graph, scalar) for scalar in array.flat]
        found = [np.broadcast_to(x, COUNT) for x in evaluated(self.graph, nodes, self.values)]
        return np.stack(found, axis=-1).reshape(COUNT, *array.shape)


def close(ours, theirs, tolerance=1e-10):
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=tolerance * np.abs(np.asarray(theirs)).max())


@pytest.fixture(params=[*MODELS, "tree with armature", "tree locked", "chain in odd gravity"])
def case(request):
    """A robot, its URDF text, and random states as tensors (COUNT, nv)."""
    options = {
        "tree with armature": {"armature": {"torso": 0.3, "left_gripper": 1.7, "right_wrist": 0.02}},
        "tree locked": {"locked": {"right_shoulder": 2.3, "left_gripper": 0.03}},
        "chain in odd gravity": {"gravity": (1.0, -7.0, 3.0), "armature": (0.5, 0.1, 0.2, 0.05)},
    }.get(request.param, {})
    text = MODELS[request.param.split()[0]]()
    robot = Robot.from_urdf_text(text, **options)
    states = torch.tensor(np.random.default_rng(7).normal(scale=1.5, size=(3, COUNT, robot.nv)))
    return robot, text, *states


def test_structure_stays_structure():
    """Joints on different branches are coupled by the float 0.0, and nothing fills in when M is factorised."""
    robot = Robot.from_urdf_text(TREE)
    q = torch.randn(COUNT, robot.nv, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    scalars = Scalars(q)
    M = UnrolledKinematics(UnrolledRobot(robot), *scalars.given).mass_matrix()
    L, D = factorize(M)
    related = robot.tree.related[..., 0].bool().numpy()
    assert np.array_equal(M != 0.0, related)
    assert np.array_equal(L != 0.0, np.tril(related))
    L, D = scalars.numbers(L), scalars.numbers(D)
    close(np.swapaxes(L, 1, 2) @ (D[:, :, None] * L), robot.mass_matrix(q))


def test_solvers_against_dense_ones():
    rng = np.random.default_rng(5)
    root = rng.normal(size=(COUNT, 5, 5))
    matrix, b = root @ root.swapaxes(1, 2) + np.eye(5), rng.normal(size=(COUNT, 5))
    scalars = Scalars(matrix.reshape(COUNT, 25), b)
    entries, right = (np.array(given, dtype=object) for given in scalars.given)
    L, D = factorize(entries.reshape(5, 5))
    solution = solve_factorized(L, 1.0 / D, right)
    close(scalars.numbers(solution), np.linalg.solve(matrix, b[..., None])[..., 0])
