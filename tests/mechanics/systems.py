"""Robots under contacts, states that fit them, and the dense equations that Gauss' principle must solve."""

from functools import cache

import torch
from tests.inference.problems import normal
from tests.robots.robot_models import FRAMES, MODELS

from forcegp.forces import Actuation, RigidBodies
from forcegp.mechanics import Contact, ImplicitSurface, Plane, Sphere
from forcegp.model import Model
from forcegp.robots import Robot

POINT = (0.02, -0.03, 0.1)
CORNERS = [(0.05, 0.05, 0.1), (0.05, -0.05, 0.1), (-0.05, 0.05, 0.1), (-0.05, -0.05, 0.1)]


@cache
def robot(model: str) -> Robot:
    return Robot.from_urdf_text(MODELS[model]())


def surfaces() -> dict[str, object]:
    return {
        "plane": Plane((0.2, -0.1, 1.0), 0.055), "sphere": Sphere((0.1, 0.3, -0.2), 0.4),
        "ball": Sphere((0.0, 0.5, 0.1), 0.2),
        "waves": ImplicitSurface(lambda p: 2.0 * p[2] - 0.1 * torch.sin(3.0 * p[0]) * p[1]),
    }  # fmt: skip


def contacts(kind: str, frame: str) -> tuple[Contact, ...]:
    """By name: none, one, three independent, the same twice, four corners of a plate on a plane (rank 3)."""
    plane, sphere, ball, _ = surfaces().values()
    return {
        "none": (), "one": (Contact(frame, POINT, plane),),
        "three": (
            Contact(frame, POINT, plane), Contact(frame, (0.0, 0.1, 0.0), sphere),
            Contact(frame, (-0.1, 0.0, 0.05), ball),
        ),
        "same twice": (Contact(frame, POINT, sphere), Contact(frame, POINT, sphere)),
        "four corners": tuple(Contact(frame, corner, plane) for corner in CORNERS),
    }[kind]  # fmt: skip


INDEPENDENT, REDUNDANT = ["none", "one", "three"], ["same twice", "four corners"]


def model_with(model: str = "iiwa", kind: str = "one", **options: object) -> Model:
    """Without friction that the URDF may state."""
    return Model(robot(model), contacts(kind, FRAMES[model]), **{"forces": (Actuation(), RigidBodies()), **options})


def states(nv: int, *batch: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Random q, v, u in rad, rad/s and Nm (m, m/s and N)."""
    q, v, u = (normal(*batch, nv, seed=10 * seed + k) for k in range(3))
    return 0.8 * q, 0.7 * v, 5.0 * u


def regular_states(built: Model, count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Of many random states those farthest from postures where the contacts lose rank, and any method its digits."""
    candidates = states(built.robot.nv, 20 * count)
    A = built.dynamics(*candidates).A
    if not built.contacts:
        return tuple(x[:count] for x in candidates)
    singular = torch.linalg.svdvals(A)
    smallest = torch.where(singular > 1e-9 * singular[:, :1], singular, torch.inf).amin(-1)
    return tuple(x[(smallest / singular[:, 0]).topk(count).indices] for x in candidates)


def solve_kkt(M, Q, A, b):
    """a and lambda from [[M, -A^T], [A, 0]] [a; lambda] = [Q; b], dense; of minimum norm where A is redundant."""
    m, nv = A.shape[-2:]
    matrix = torch.cat([torch.cat([M, -A.mT], -1), torch.cat([A, A.new_zeros(*M.shape[:-2], m, m)], -1)], -2)
    right = torch.cat([Q, b], -1)[..., None]
    full_rank = m == 0 or int(torch.linalg.matrix_rank(A, rtol=1e-9).min()) == m
    if full_rank:
        solution = torch.linalg.solve(matrix, right)[..., 0]
    else:
        solution = torch.linalg.lstsq(matrix, right, rcond=1e-12, driver="gelsd").solution[..., 0]
    return solution[..., :nv], solution[..., nv:]


def assert_close(given, expected, tolerance: float) -> None:
    """Relative to the largest entry of what is expected."""
    assert given.shape == expected.shape
    if expected.numel():
        error = float((given - expected).detach().abs().max())
        assert error <= tolerance * max(1.0, float(expected.detach().abs().max())), error


def assert_derivatives(function, *arguments: torch.Tensor, step: float = 1e-5, tolerance: float = 1e-6) -> None:
    """Jacobians of `function` (to one vector) by autograd against central differences, relative to their largest entry.

    `torch.autograd.gradcheck` wants every entry right to an absolute tolerance, which rounding of large outputs hides.
    """
    jacobians = torch.autograd.functional.jacobian(function, arguments)
    for k, (argument, jacobian) in enumerate(zip(arguments, jacobians, strict=True)):
        columns = []
        for unit in step * torch.eye(argument.numel(), dtype=torch.float64):
            ahead, behind = (
                function(*arguments[:k], argument + sign * unit.view_as(argument), *arguments[k + 1 :])
                for sign in (1, -1)
            )
            columns.append((ahead - behind) / (2.0 * step))
        assert_close(jacobian.flatten(1), torch.stack(columns, dim=-1), tolerance)
