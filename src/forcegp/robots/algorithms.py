"""Rigid-body algorithms as pure functions of batched tensors, in world axes about the world's origin.

A twist is the 3x4 matrix ``[[w]x, v]`` (the upper rows of an element of se(3)), with ``w`` the angular velocity and ``v`` the
velocity of the body point that passes the origin. The pseudo-inertia of a body in the world is ``P_w = T P T^T``. With both,

    M_ij   = < S_i, S_j P_c,j >      for joint i above or equal to joint j, P_c,j summed over what joint j moves
    tau_i  = < S_i, sum_k A_k P_k >  over the bodies k that joint i moves

where <., .> is the sum of products of entries and ``A_k = T''_k T_k^-1`` the acceleration of body k. These are the composite
rigid body and recursive Newton-Euler algorithms (Featherstone, "Rigid Body Dynamics Algorithms", 2008, ch. 5 and 6) with
their recursions over the tree written as products with the (n, n) descendant matrix.

Joints lead: tensors over joints or bodies have shape (n, *batch, ...), so that those products are single matrix products.
All functions are compositions of differentiable operations without branches on values, so vmap, jacrev, jacfwd and repeated
differentiation apply.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import NumericalError
from forcegp.robots.tree import Tree


def body_poses(tree: Tree, q: Float[Tensor, "*batch n"]) -> Float[Tensor, "n *batch 4 4"]:
    """Pose T of every body frame in the world."""
    position = q.movedim(-1, 0)
    features = [position.sin(), position.cos()] if tree.all_revolute else [position.sin(), position.cos(), position]
    stacked = torch.stack(features, dim=-1)
    batch = position.shape[1:]
    local = torch.baddbmm(tree.rest, stacked.reshape(len(position), batch.numel(), len(features)), tree.motion)
    local = local.reshape(*position.shape, 4, 4)
    pose = local[tree.levels[0].joints]
    laid = [pose]
    for level in tree.levels[1:]:
        above = pose if level.parents is None else pose[level.parents]
        pose = above @ local[level.joints]
        laid.append(pose)
    poses = torch.cat(laid)
    return poses if tree.order is None else poses[tree.order]


def joint_twists(tree: Tree, poses: Float[Tensor, "n *batch 4 4"]) -> Float[Tensor, "n *batch 3 4"]:
    """Twist S_i of each body per unit velocity of its joint."""
    axis, point = poses[..., :3, 2], poses[..., :3, 3]
    moment = torch.linalg.cross(point, axis)
    if tree.all_revolute:
        twist = torch.cat([axis, moment], dim=-1)
    else:
        revolute = tree.revolute.reshape(-1, *(1 for _ in poses.shape[1:-1]))
        twist = torch.cat([revolute * axis, revolute * moment + (1.0 - revolute) * axis], dim=-1)
    return (twist @ tree.twist_basis).unflatten(-1, (3, 4))


def _over_joints(matrix: Tensor, values: Tensor) -> Tensor:
    """``sum_k matrix[i, k] values[k]`` over the leading (joint) dimension."""
    return (matrix @ values.flatten(1)).unflatten(1, values.shape[1:])


def body_accelerations(
    tree: Tree,
    twists: Float[Tensor, "n *batch 3 4"],
    v: Float[Tensor, "*batch n"] | None,
    a: Float[Tensor, "*batch n"] | None = None,
) -> Float[Tensor, "n *batch 3 4"]:
    """Accelerations ``A = T'' T^-1`` of all bodies, without gravity; ``v`` or ``a`` of None are zero.

    With V the body's and V_p its parent body's twist, ``A = A_p + (V_p + V) S v + S a``: differentiating ``T' = V T`` twice
    along a chain, the bracket and the squared terms collapse to that one product.
    """
    step = None
    if v is not None:
        moving = twists * v.movedim(-1, 0)[..., None, None]
        step = _over_joints(tree.velocity_sum, moving)[..., :3] @ moving
    if a is not None:
        driven = twists * a.movedim(-1, 0)[..., None, None]
        step = driven if step is None else step + driven
    return _over_joints(tree.descendants.mT, torch.zeros_like(twists) if step is None else step)


def world_inertias(
    poses: Float[Tensor, "n *batch 4 4"], inertias: Float[Tensor, "n *bodies 4 4"]
) -> Float[Tensor, "n *batch 4 4"]:
    """Pseudo-inertias ``T P T^T``; ``inertias`` are (n, 4, 4), shared by the batch, or (n, *batch, 4, 4)."""
    if inertias.dim() == 3:
        half = (poses.flatten(1, -2) @ inertias).view_as(poses)
    else:
        half = poses @ inertias
    return half @ poses.mT


def composite_inertias(tree: Tree, inertias: Float[Tensor, "n *batch 4 4"]) -> Float[Tensor, "n *batch 4 4"]:
    """Pseudo-inertia of everything that each joint moves."""
    return _over_joints(tree.descendants, inertias)


def mass_matrix(
    tree: Tree, twists: Float[Tensor, "n *batch 3 4"], composite: Float[Tensor, "n *batch 4 4"]
) -> Float[Tensor, "*batch n n"]:
    """Joint-space inertia matrix, armature included on the diagonal."""
    momentum = (twists @ composite).flatten(-2).movedim(0, -2)
    above = twists.flatten(-2).movedim(0, -2) @ momentum.mT
    # right where the row's joint moves the column's body; elsewhere its transpose is, or neither (different branches)
    out = torch.where(tree.descendants > 0, above, above.mT)
    if not tree.is_chain:
        out = out * tree.related
    return out + torch.diag(tree.armature) if tree.has_armature else out


def joint_forces(
    tree: Tree,
    twists: Float[Tensor, "n *batch 3 4"],
    accelerations: Float[Tensor, "n *batch 3 4"],
    inertias: Float[Tensor, "n *batch 4 4"],
) -> Float[Tensor, "*batch n"]:
    """Joint forces that accelerate the bodies so (without armature)."""
    wrench = _over_joints(tree.descendants, accelerations @ inertias)
    return (twists * wrench).sum((-2, -1)).movedim(0, -1)


def gravity_forces(
    tree: Tree, twists: Float[Tensor, "n *batch 3 4"], composite: Float[Tensor, "n *batch 4 4"]
) -> Float[Tensor, "*batch n"]:
    """Joint forces that hold the robot still: ``-g . (S_i P_c,i)`` with the first moment and mass in P's last column."""
    lifted = (twists @ composite[..., 3:]).squeeze(-1)
    return -(lifted @ tree.gravity).movedim(0, -1)


def with_gravity(tree: Tree, accelerations: Float[Tensor, "n *batch 3 4"]) -> Float[Tensor, "n *batch 3 4"]:
    """Accelerations relative to free fall."""
    fall = torch.nn.functional.pad(tree.gravity[:, None], (3, 0))
    return accelerations - fall


def solve_mass_matrix(mass: Float[Tensor, "*batch n n"], force: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch n"]:
    """``M^-1 force`` by Cholesky; :class:`~forcegp.errors.NumericalError` where M is not positive definite."""
    try:
        factor = torch.linalg.cholesky(mass)
    except torch.linalg.LinAlgError as error:
        raise NumericalError(
            "the mass matrix is not positive definite: either q or the inertial parameters hold NaN or infinity, or a body's "
            "mass lies on its joint axis alone; check the inputs, or give that joint armature."
        ) from error
    return torch.cholesky_solve(force[..., None], factor).squeeze(-1)
