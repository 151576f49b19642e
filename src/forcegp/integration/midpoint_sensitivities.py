"""Motions by the implicit midpoint rule, of many windows at once, with derivatives in start and parameters.

With a step h and a constant u in each, the middle of a step obeys (`ImplicitMidpoint`)

    v_m = v + h/2 a(q + h/2 v_m, v_m, u; p),    q+ = q + h v_m,    v+ = 2 v_m - v.

Linearised at a guess (q_m, v_m) of the middle of every step, this is one affine recursion along each window,

    (1 - h/2 a_v - h^2/4 a_q) v_m = v + h/2 (a - a_q (q_m - q) - a_v v_m + a_p dp)    (right side at the guess),

whose pass gives new guesses of all middles, and the derivatives of the motion in its start and in p as well. Repeated,
it is Newton's method on all steps of all windows at once (the lifted or multiple-shooting method of Bock & Plitt 1984;
Albersmeyer & Diehl, "The lifted Newton method", SIAM J. Optim. 2010): accelerations are asked for all steps together,
and a motion that explicit steps would lose is found, because the guess comes from a recording.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from forcegp.integration.integrators import find_roots

MOST_PASSES = 20
TOLERANCE = 1e-9
"""Change of a middle velocity, relative to the largest, at which the motions are found."""


@dataclass(frozen=True, eq=False)
class Linear:
    """Accelerations (n, nv) at states, and derivatives in q, v (n, nv, nv) and parameters (n, nv, P)."""

    a: Float[Tensor, "*n nv"]
    a_q: Float[Tensor, "*n nv nv"]
    a_v: Float[Tensor, "*n nv nv"]
    a_p: Float[Tensor, "*n nv P"] | None = None


@dataclass(frozen=True, eq=False)
class Accelerations:
    """The accelerations of states (q, v, u), each (n, nv), which torch can differentiate, and their `Linear`.

    `linear` is asked with and without derivatives in the parameters.
    """

    mean: Callable[[Tensor, Tensor, Tensor], Tensor]
    linear: Callable[[Tensor, Tensor, Tensor, bool], Linear]


@dataclass(frozen=True, eq=False)
class WindowMotions:
    """Motions of K windows of T steps: states, the middles of the steps, whether Newton's method found them.

    `in_start` and `in_parameters` are the derivatives of q in (q_0, v_0) and in p.
    """

    q: Float[Tensor, "K rows nv"]
    v: Float[Tensor, "K rows nv"]
    middle_q: Float[Tensor, "K T nv"]
    middle_v: Float[Tensor, "K T nv"]
    found: Bool[Tensor, " K"]
    in_start: Float[Tensor, "K rows nv 2*nv"] | None = None
    in_parameters: Float[Tensor, "K rows nv P"] | None = None


def window_motions(
    accelerations: Accelerations,
    q0: Float[Tensor, "K nv"],
    v0: Float[Tensor, "K nv"],
    u: Float[Tensor, "K T nv"],
    h: float,
    guess: tuple[Float[Tensor, "K T nv"], Float[Tensor, "K T nv"]],
    *,
    derivatives: bool,
    patient: bool = True,
) -> WindowMotions:
    """The motions from (q0, v0) under u, from a guess of the middles, and their derivatives where those are asked for.

    Windows that `MOST_PASSES` do not find are stepped through if `patient`; where that fails, too, `found` is False.
    """
    middle_q, middle_v = (x.clone() for x in guess)
    found = torch.zeros(len(q0), dtype=torch.bool, device=q0.device)
    left = torch.arange(len(q0), device=q0.device)
    for _ in range(MOST_PASSES):  # of those that are not found: a turn of dry friction is met one pass after the other
        at = _at(accelerations, middle_q[left], middle_v[left], u[left], False)
        q, v, _ = _pass(at, q0[left], v0[left], middle_q[left], middle_v[left], h)
        there_q, there_v = (q[:, 1:] + q[:, :-1]) / 2.0, (q[:, 1:] - q[:, :-1]) / h
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
    at = _at(accelerations, middle_q, middle_v, u, derivatives)
    q, v, slopes = _pass(at, q0, v0, middle_q, middle_v, h)
    if not derivatives:
        return WindowMotions(q, v, middle_q, middle_v, found)
    start = 2 * q0.shape[-1]
    return WindowMotions(q, v, middle_q, middle_v, found, slopes[..., :start], slopes[..., start:])


def _step_by_step(
    accelerations: Accelerations, q: Tensor, v: Tensor, u: Tensor, h: float
) -> tuple[Float[Tensor, "K T nv"], Float[Tensor, "K T nv"], Bool[Tensor, " K"]]:
    """The middles of motions, by Newton's method with shorter steps, and which of them have an end."""
    positions, velocities, ended = [], [], torch.ones(len(q), dtype=torch.bool, device=q.device)
    for force in u.unbind(1):
        residual, linearize = _step(accelerations, q, v, force, h)
        middle, found = find_roots(residual, v, linearize)
        ended &= found
        middle = torch.where(ended[:, None], middle, v)  # the others only stay finite
        positions.append(q + 0.5 * h * middle)
        velocities.append(middle)
        q, v = q + h * middle, 2.0 * middle - v
        if not bool(ended.any()):
            return u.new_zeros(u.shape), u.new_zeros(u.shape), ended
    return torch.stack(positions, dim=1), torch.stack(velocities, dim=1), ended


def _step(
    accelerations: Accelerations, q: Tensor, v: Tensor, u: Tensor, h: float
) -> tuple[Callable[[Tensor], Tensor], Callable[[Tensor], tuple[Tensor, Tensor]]]:
    """What a step's middle velocity must bring to zero, and the same with its Jacobian."""

    def residual(at: Tensor) -> Tensor:
        return at - v - 0.5 * h * accelerations.mean(q + 0.5 * h * at, at, u)

    def linearize(at: Tensor) -> tuple[Tensor, Tensor]:
        here = accelerations.linear(q + 0.5 * h * at, at, u, False)
        identity = torch.eye(at.shape[-1], dtype=at.dtype, device=at.device)
        return at - v - 0.5 * h * here.a, identity - 0.5 * h * (0.5 * h * here.a_q + here.a_v)

    return residual, linearize


def _at(accelerations: Accelerations, q: Tensor, v: Tensor, u: Tensor, parameters: bool) -> Linear:
    """With dimensions (K, T, ...)."""
    found = accelerations.linear(q.flatten(0, 1), v.flatten(0, 1), u.flatten(0, 1), parameters)
    a, a_q, a_v = (x.unflatten(0, q.shape[:2]) for x in (found.a, found.a_q, found.a_v))
    return Linear(a, a_q, a_v, None if found.a_p is None else found.a_p.unflatten(0, q.shape[:2]))


def _pass(
    at: Linear, q0: Tensor, v0: Tensor, middle_q: Tensor, middle_v: Tensor, h: float
) -> tuple[Tensor, Tensor, Tensor]:
    """q, v (K, T+1, nv) of the linearised steps, and the derivatives of q (K, T+1, nv, 2 nv + P)."""
    nv, half = q0.shape[-1], 0.5 * h
    identity = torch.eye(nv, dtype=q0.dtype, device=q0.device)
    inverse = torch.linalg.inv(identity - half * at.a_v - half**2 * at.a_q)
    constant = half * (at.a - (at.a_q @ middle_q[..., None] + at.a_v @ middle_v[..., None])[..., 0])
    # columns: the state, and where parameters are asked for its derivatives in q0, v0 and p
    q, v = q0[..., None], v0[..., None]
    inputs = constant[..., None]
    if at.a_p is not None:
        nothing = q0.new_zeros(len(q0), nv, at.a_p.shape[-1])
        eye, zero = identity.expand(len(q0), nv, nv), q0.new_zeros(len(q0), nv, nv)
        q, v = torch.cat([q, eye, zero, nothing], dim=-1), torch.cat([v, zero, eye, nothing], dim=-1)
        wide = at.a.new_zeros(*at.a.shape, 2 * nv)
        inputs = torch.cat([inputs, wide, half * at.a_p], dim=-1)
    # v_m = Z (v + h/2 a_q q + inputs): products that do not depend on the state first, for all steps at once
    of_q, of_inputs = half * inverse @ at.a_q, inverse @ inputs
    rows_q, rows_v = [q], [v[..., 0]]
    for Z, Z_q, given in zip(inverse.unbind(1), of_q.unbind(1), of_inputs.unbind(1), strict=True):
        middle = Z @ v + Z_q @ q + given
        q = q + h * middle
        v = 2.0 * middle - v
        rows_q.append(q)
        rows_v.append(v[..., 0])
    all_q = torch.stack(rows_q, dim=1)
    return all_q[..., 0], torch.stack(rows_v, dim=1), all_q[..., 1:]
