"""Motions by the implicit midpoint rule, of many windows at once, with derivatives in start and parameters.

Linearised at a guess of the middle of every step, the rule is one affine recursion along each window; repeated, this is
Newton's method on all steps at once (lifted: Bock & Plitt 1984; Albersmeyer & Diehl 2010).
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from forcegp.integration.integrators import VECTORS, implicit_midpoint

MOST_PASSES = 20
TOLERANCE = 1e-9  # change of a middle velocity, relative to the largest, at which the motions are found


@dataclass(frozen=True, eq=False)
class Linear:
    """Accelerations (n, nv), and derivatives in q, v (n, nv, nv) and parameters (n, nv, P)."""

    a: Float[Tensor, "*n nv"]
    a_q: Float[Tensor, "*n nv nv"]
    a_v: Float[Tensor, "*n nv nv"]
    a_p: Float[Tensor, "*n nv P"] | None = None


@dataclass(frozen=True, eq=False)
class Accelerations:
    """Accelerations (n, nv) of states (q, v, u), differentiable, and their `Linear`, with or without parameters."""

    mean: Callable[[Tensor, Tensor, Tensor], Tensor]
    linear: Callable[[Tensor, Tensor, Tensor, bool], Linear]


@dataclass(frozen=True, eq=False)
class WindowMotions:
    """Motions of K windows of T steps: states, the middles of the steps, whether Newton's method found them.

    `in_start` and `in_parameters` are derivatives of q in (q_0, v_0) and in p.
    """

    q: Float[Tensor, "K rows nq"]
    v: Float[Tensor, "K rows nv"]
    middle_q: Float[Tensor, "K T nq"]
    middle_v: Float[Tensor, "K T nv"]
    found: Bool[Tensor, " K"]
    in_start: Float[Tensor, "K rows nv _"] | None = None
    in_parameters: Float[Tensor, "K rows nv P"] | None = None


def window_motions(
    accelerations: Accelerations,
    q0: Float[Tensor, "K nq"],
    v0: Float[Tensor, "K nv"],
    u: Float[Tensor, "K T nu"],
    h: float,
    guess: tuple[Float[Tensor, "K T nq"], Float[Tensor, "K T nv"]],
    *,
    patient: bool = True,
) -> WindowMotions:
    """The motions from (q0, v0) under u, from a guess of the middles, and their derivatives.

    Windows that `MOST_PASSES` do not find are stepped through if `patient`; where that fails, too, `found` is False.
    """
    middle_q, middle_v = (x.clone() for x in guess)
    found, left = torch.zeros(len(q0), dtype=torch.bool, device=q0.device), torch.arange(len(q0), device=q0.device)
    for _ in range(MOST_PASSES):  # of those that are not found: a turn of dry friction is met one pass after the other
        middles = middle_q[left], middle_v[left]
        there_q, there_v = _pass(accelerations, q0[left], v0[left], u[left], middles, h, False)[2:4]
        change = (there_v - middle_v[left]).abs().flatten(1).amax(1)
        middle_q[left], middle_v[left] = there_q, there_v
        found[left] = change <= TOLERANCE * (1.0 + there_v.abs().flatten(1).amax(1))
        left = left[~found[left] & change.isfinite()]
        if not len(left):
            break
    if len(left) and patient:
        there_q, there_v, ended = _step_by_step(accelerations, q0[left], v0[left], u[left], h)
        found[left] = ended
        middle_q[left[ended]], middle_v[left[ended]] = there_q[ended], there_v[ended]
    q, v, *_, slopes = _pass(accelerations, q0, v0, u, (middle_q, middle_v), h, True)
    start = 2 * v0.shape[-1]
    return WindowMotions(q, v, middle_q, middle_v, found, slopes[..., :start], slopes[..., start:])


def _step_by_step(
    accelerations: Accelerations, q: Tensor, v: Tensor, u: Tensor, h: float
) -> tuple[Float[Tensor, "K T nq"], Float[Tensor, "K T nv"], Bool[Tensor, " K"]]:
    """The middles of motions, by Newton's method with shorter steps, and which of them have an end."""
    positions, velocities, ended = [], [], torch.ones(len(q), dtype=torch.bool, device=q.device)
    for force in u.unbind(1):
        moved = implicit_midpoint(VECTORS, lambda q, v, u=force: accelerations.mean(q, v, u), q, v, h)
        ended &= moved.found
        middle = torch.where(ended[:, None], 0.5 * (v + moved.v), v)  # the others only stay finite
        positions.append(q + 0.5 * h * middle)
        velocities.append(middle)
        q, v = q + h * middle, 2.0 * middle - v
        if not bool(ended.any()):
            return q[:, None], v[:, None], ended
    return torch.stack(positions, dim=1), torch.stack(velocities, dim=1), ended


def _pass(
    model: Accelerations, q0: Tensor, v0: Tensor, u: Tensor, middles: tuple[Tensor, Tensor], h: float, full: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """q, v (K, T+1, nv) of linearised steps, their middles, and if `full` derivatives of q (K, T+1, nv, 2 nv + P)."""
    nv, half = v0.shape[-1], 0.5 * h
    identity = torch.eye(nv, dtype=q0.dtype, device=q0.device)
    middle_q, middle_v = middles
    at = model.linear(middle_q.flatten(0, 1), middle_v.flatten(0, 1), u.flatten(0, 1), full)
    a, a_q, a_v = (x.unflatten(0, u.shape[:2]) for x in (at.a, at.a_q, at.a_v))
    constant = half * (a - (a_q @ middle_q[..., None] + a_v @ middle_v[..., None])[..., 0])
    inverse = torch.linalg.inv(identity - half * (a_v + half * a_q))
    # columns: the state, and where parameters are asked for its derivatives in q0, v0 and p
    q, v, inputs = q0[..., None], v0[..., None], constant[..., None]
    if at.a_p is not None:
        nothing = q0.new_zeros(len(q0), nv, at.a_p.shape[-1])
        eye, zero = identity.expand(len(q0), nv, nv), q0.new_zeros(len(q0), nv, nv)
        q, v = torch.cat([q, eye, zero, nothing], dim=-1), torch.cat([v, zero, eye, nothing], dim=-1)
        inputs = torch.cat([inputs, a.new_zeros(*a.shape, 2 * nv), half * at.a_p.unflatten(0, u.shape[:2])], dim=-1)
    # v_m = Z (v + h/2 a_q q + inputs): products that do not depend on the state first, for all steps at once
    of_q, of_inputs = half * inverse @ a_q, inverse @ inputs
    rows_q, rows_v = [q], [v[..., 0]]
    for Z, Z_q, given in zip(inverse.unbind(1), of_q.unbind(1), of_inputs.unbind(1), strict=True):
        middle = Z @ v + Z_q @ q + given
        q, v = q + h * middle, 2.0 * middle - v
        rows_q.append(q)
        rows_v.append(v[..., 0])
    all_q, all_v = torch.stack(rows_q, dim=1), torch.stack(rows_v, dim=1)
    q = all_q[..., 0]
    return q, all_v, (q[:, 1:] + q[:, :-1]) / 2.0, (q[:, 1:] - q[:, :-1]) / h, all_q[..., 1:]
