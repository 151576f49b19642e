"""Rows of a recording as least squares sees them: residuals of torque or acceleration, with exact Jacobians.

With the standard parameters pi of the bodies, the joint terms t(x; v, a) and the forces Q that are given,

    torque           r = Y(q, v, a) pi + M_0 a + t(x; v, a) - Q
    acceleration     r = a - a^,    a^ = (M(pi) + M_0 + M_t(x))^-1 (Q - bias(pi) - t(x; v, 0))

where M_0 is the inertia of what is listed and not estimated. Differentiating M a^ = Q - bias - t,

    dr/dpi = M^-1 Y(q, v, a^),    dr/dx = M^-1 dt/dx (v, a^).

Feet that stand, closed loops and wheels add A^T lambda to Q, with A a = b and unknown lambda. Accelerations are then
those of Gauss' principle, and H stands in the place of M^-1. Of the torques only the part that is orthogonal to the
rows of A, row by row of the recording, is an equation without lambda.

Friction g(x; v) |u| under load makes u the solution of u = z + g |u|, with z all other terms:

    u = z / (1 - g s),    s = sign z = sign u for |g| < 1,    du/dx = (dz/dx + u s dg/dx) / (1 - g s).

The measured |u| in its place would explain the measured torque by itself: g tends to 1, whatever the robot is.

Where a and u are both noisy, the a* that was there is unknown as well. Over it, (e_a / sigma_a)^2 + (e_F / sigma_F)^2
is least at

    r^T S^-1 r,    S = M diag(sigma_a^2) M^T + diag(sigma_F^2),    a* = a - diag(sigma_a^2) M^T S^-1 r

(errors in variables: Fuller, "Measurement Error Models", 1987, section 3.2). As S changes with pi, its derivative in pi
is 2 Y(q, v, a*)^T S^-1 r. Least squares of torque take Y(q, v, a) there, whose noise draws inertias to zero: without a
bound where rows are homogeneous in them, as those of a base without actuators are. Where contacts hold, A a* = b: a and
its covariance are those under that condition.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float

from forcegp.analytical.joint_terms import JointTerms
from forcegp.analytical.least_squares import BEND, NoiseLevels, orthonormal_columns, without
from forcegp.data import Dataset
from forcegp.errors import InvalidInput, NumericalError, require_type
from forcegp.mechanics import (
    Contact,
    Held,
    KnownForce,
    LoadJointFriction,
    LoopClosure,
    MechanicalSystem,
    RigidBodyBias,
    RollingContact,
)
from forcegp.mechanics.gauss_principle import REDUNDANCY_TOLERANCE
from forcegp.mechanics.thrusters import OBSERVED


def motion_residuals(
    dataset: Dataset, system: MechanicalSystem
) -> tuple[Float[np.ndarray, "rows nv"], Float[np.ndarray, "rows nv"]]:
    """Residuals of joint forces, Q_K - M a (Nm or N), and of accelerations, measured less predicted.

    What A^T lambda can explain, the forces of feet that stand, of loops and of wheels, is left out of the force
    residual; under contacts that slide it holds the contact forces as well. Under friction that grows with |u| it is
    what the measured u exceeds the u by that the model needs (`recorded_rows`), for the friction of the measured |u|
    shrinks the residual of any model.
    """
    require_type("dataset", dataset, Dataset)
    q, v, u, a = (torch.tensor(np.array(getattr(dataset, x)), device=system.robot.device) for x in ("q", "v", "u", "a"))
    dynamics = system.dynamics(q, v, u)
    force = dynamics.Q_K - (dynamics.M @ a[..., None])[..., 0]
    for friction in system.known_forces:
        if isinstance(friction, LoadJointFriction):
            ones, delivered = torch.ones_like(a), dynamics.state.delivered
            idle, loaded = (
                friction.force(replace(dynamics.state, u=load, delivered_by=None)) for load in (0.0 * ones, ones)
            )
            without_load = delivered + (loaded - idle) * delivered.abs() - force  # z = u - g |u| - force
            force = dynamics.state.delivered - without_load / (1.0 + (loaded - idle) * without_load.sign())
    if system.contacts and not any(slides(contact) for contact in system.contacts):
        held, _ = independent_rows(dynamics.A.cpu().numpy(), dynamics.b.cpu().numpy())
        return without(force.cpu().numpy(), held.swapaxes(1, 2)), (a - dynamics.acceleration_map().offset).cpu().numpy()
    return force.cpu().numpy(), (a - dynamics.acceleration_map().offset).cpu().numpy()


def residual_scores(
    force: Float[np.ndarray, "rows nv"], acceleration: Float[np.ndarray, "rows nv"], dataset: Dataset
) -> dict[str, list[float]]:
    """Per joint: rms of both residuals, and that of the acceleration over its standard deviation (nRMSE)."""
    rms = np.sqrt((acceleration**2).mean(0))
    spread = dataset.a.std(0)
    return {
        "force_rms": np.sqrt((force**2).mean(0)).tolist(),
        "acceleration_rms": rms.tolist(),
        "acceleration_nrmse": np.divide(rms, spread, out=np.full_like(rms, np.nan), where=spread > 0.0).tolist(),
    }


FIRST = 1e-2
"""Of the root mean square of the residual forces, what rough searches take for noise of forces."""
Positions = Float[np.ndarray, "rows nq"]
Rows = Float[np.ndarray, "rows nv"]
Inputs = Float[np.ndarray, "rows nu"]


class RecordedRows:
    """States of a robot, the given forces there, and the terms of the equation of motion."""

    def __init__(self, system: MechanicalSystem, terms: JointTerms, q: Positions, v: Rows, u: Inputs):
        robot = system.robot
        given = kept_forces(system, terms)
        at_q, at_v, at_u = (torch.as_tensor(np.array(x), device=robot.device) for x in (q, v, u))
        state = system.state(at_q, at_v, at_u)
        self.kinematics, self.terms, self.v = state.kinematics, terms, np.array(v)
        self.delivered = state.delivered.cpu().numpy()
        self.load = abs(self.delivered)
        A, b, _ = system.constraint(state)
        self.held, self.right = independent_rows(A.cpu().numpy(), b.cpu().numpy())
        """Orthonormal rows (rows, m, nv) with ``held a = right``; rows of zeros where nothing holds."""
        self.force = np.zeros_like(self.v)
        self.inertia = np.zeros((robot.nv, robot.nv))
        for force in given:
            self.force = self.force + force.force(state).detach().cpu().numpy()
            added = force.added_inertia()
            self.inertia = self.inertia + (0.0 if added is None else added.detach().cpu().numpy())
        self._armature = np.diag(robot.armature.cpu().numpy())

    def regressor(self, a: Rows, bodies: Sequence[int] = ()) -> Float[np.ndarray, "rows nv bodies 10"]:
        """Y at these states and accelerations, of the bodies with mass or of these."""
        at = torch.as_tensor(np.array(a), device=self.kinematics.robot.device)
        return self.kinematics.torque_regressor(at).cpu().numpy()[:, :, bodies or self.terms.bodies]

    def without_contacts(self, values: Float[np.ndarray, "rows nv *k"]) -> Float[np.ndarray, "rows nv *k"]:
        """The part of joint forces (first axis after the rows) that no lambda can explain."""
        return without(values, self.held.swapaxes(1, 2))

    def needed_torque(self, parameters: np.ndarray, x: np.ndarray, a: np.ndarray) -> np.ndarray:
        """The force Q (rows, nv) under which the model accelerates by a."""
        return self._needed(parameters, x, a, self.regressor(a))[0]

    def _needed(
        self, parameters: np.ndarray, x: np.ndarray, a: np.ndarray, regressor: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`needed_torque`, its derivatives in z (rows, nv), the torque without load, and in x (rows, nv, k)."""
        torque, in_x = self.terms.torque(x, self.v, a, np.zeros_like(self.load))
        rigid = regressor.reshape(*a.shape, -1) @ parameters.ravel() + a @ (self.inertia + self._armature)
        if LoadJointFriction not in self.terms.kinds:
            return rigid + torque, np.ones_like(self.v), in_x
        loaded, loaded_in_x = self.terms.torque(x, self.v, a, np.ones_like(self.load))
        others = self.force - self.delivered
        z, g = rigid + torque - others, loaded - torque
        sign = np.sign(z)
        left = 1.0 - g * sign
        u = z / left
        return u + others, 1.0 / left, (in_x + (u * sign)[..., None] * (loaded_in_x - in_x)) / left[..., None]

    def acceleration(self, parameters: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """a^ (rows, nv), the mass matrices and H (rows, nv, nv). Raises NumericalError where a matrix is singular."""
        given = torch.zeros(len(self.kinematics.robot.layout.bodies), 10, dtype=torch.float64)
        given[self.terms.bodies] = torch.as_tensor(parameters)
        parts = self.kinematics.dynamics_of_bodies(given.to(self.kinematics.robot.device))
        M, bias = (part.cpu().numpy() for part in parts)
        M = M + self.inertia + self.terms.added_inertia(x)
        torque, _ = self.terms.torque(x, self.v, np.zeros_like(self.v), self.load)
        A, idle = self.held, np.logical_not(self.held.any(axis=-1))
        try:
            H = np.linalg.inv(M)
            through = A @ H
            among = through @ A.swapaxes(1, 2) + idle[:, :, None] * np.eye(A.shape[1])
            lifted = np.linalg.solve(among, np.concatenate([through, self.right[..., None]], axis=-1))
        except np.linalg.LinAlgError:
            raise NumericalError(
                "the mass matrix of the estimates is singular at a row; use inertias='consistent'."
            ) from None
        acceleration = (through.swapaxes(1, 2) @ lifted[..., -1:])[..., 0]
        H = H - through.swapaxes(1, 2) @ lifted[..., :-1]
        return acceleration + (H @ (self.force - bias - torque)[..., None])[..., 0], M, H

    def in_torque(
        self, parameters: np.ndarray, x: np.ndarray, a: np.ndarray, regressor: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residual (rows, nv) and its derivatives in the parameters (rows, nv, bodies, 10) and in x (rows, nv, k)."""
        needed, in_z, in_x = self._needed(parameters, x, a, regressor)
        if LoadJointFriction in self.terms.kinds:
            regressor = in_z[..., None, None] * regressor
        return needed - self.force, regressor, in_x

    def in_acceleration(
        self, parameters: np.ndarray, x: np.ndarray, a: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `in_torque`, of a - a^."""
        predicted, _, H = self.acceleration(parameters, x)
        Y = self.regressor(predicted)
        _, in_x = self.terms.torque(x, self.v, predicted, self.load)
        return a - predicted, (H @ Y.reshape(*predicted.shape, -1)).reshape(Y.shape), H @ in_x

    def likely(
        self,
        parameters: np.ndarray,
        x: np.ndarray,
        a: np.ndarray,
        regressor: np.ndarray,
        near: NoiseLevels | None = None,
        least: NoiseLevels | None = None,
        robust: bool = False,
        rough: bool = False,
    ) -> "LikelyAccelerations":
        """What was there where a and u are noisy, by these estimates. Levels are sought `near` others, above `least`.

        With `robust`, rows beyond what these levels explain count less, by the Cauchy loss log(1 + (rms / BEND)^2).
        With `rough`, all residuals are noise of accelerations, as starts of all searches are: forces that nothing
        measures would explain any mass of a base there. Else these forces belong to a*, since they move the robot.
        """
        predicted, M, H = self.acceleration(parameters, x)
        if rough:
            residual = a - predicted
            force = FIRST * np.sqrt(((M @ residual[..., None]) ** 2).mean((0, 2))).clip(1e-12)
            noise = NoiseLevels(np.sqrt((residual**2).mean(0)).clip(1e-12), force)
        else:
            noise = NoiseLevels.of(a - predicted, M, H, near, robust)
        if least is not None:
            noise = NoiseLevels(np.fmax(noise.acceleration, least.acceleration), np.fmax(noise.force, least.force))
        needed, in_z, _ = self._needed(parameters, x, a, regressor)
        M = in_z[..., None] * M
        of_joints = np.isin(np.arange(M.shape[-1]), self.terms.rows)
        e_a = np.diag(noise.acceleration**2) + (H * np.where(of_joints, 0.0, noise.force**2)) @ H
        A, idle = self.held, np.logical_not(self.held.any(axis=-1))
        at_contacts = A @ e_a
        among = at_contacts @ A.swapaxes(1, 2) + idle[:, :, None] * np.eye(A.shape[1])
        gain = np.linalg.solve(among, at_contacts).swapaxes(1, 2)
        moved = (gain @ (self.right[..., None] - A @ a[..., None]))[..., 0]
        e_a = e_a - gain @ at_contacts
        S = M @ e_a @ M.swapaxes(1, 2) + np.diag(np.where(of_joints, noise.force**2, 0.0))
        pushed = A * in_z[:, None]  # directions of contact forces; without them S is singular where contacts hold
        S = S + np.trace(S, axis1=1, axis2=2)[:, None, None] * pushed.swapaxes(1, 2) @ pushed
        whitening = np.linalg.inv(np.linalg.cholesky(S))
        whitening = without(whitening, orthonormal_columns(pushed @ whitening.swapaxes(1, 2)))
        at_contact = needed + (M @ moved[..., None])[..., 0]
        white = whitening @ (at_contact - self.force)[..., None]
        weighted = whitening.swapaxes(1, 2) @ white
        there = a + moved - (e_a @ M.swapaxes(1, 2) @ weighted)[..., 0]
        at_there = self.regressor(there)
        if robust:  # of whole rows, since Y(a*) is the slope of their squares, not of single entries
            equations = a.shape[1] - self.held.any(-1).sum(1)
            mean_square = (white**2).sum((1, 2)) / np.maximum(equations, 1)
            whitening = whitening / np.sqrt(1.0 + mean_square / BEND**2)[:, None, None]
        return LikelyAccelerations(
            there, at_there, at_contact - self._needed(parameters, x, there, at_there)[0], whitening, noise
        )


@dataclass(frozen=True, eq=False)
class LikelyAccelerations:
    """Accelerations a* where a and u are noisy, and Y there.

    `offset` (rows, nv) are the forces that the measured a needs, once it obeys the contacts, less those of a*.
    `whitening` (rows, nv, nv) are L^-1 with S = L L^T, without the directions of contact forces.
    """

    a: Rows
    regressor: Float[np.ndarray, "rows nv bodies 10"]
    offset: Rows
    whitening: Float[np.ndarray, "rows nv nv"]
    noise: NoiseLevels

    @cached_property
    def white_regressor(self) -> Float[np.ndarray, "rows nv bodies 10"]:
        """`white` of the regressor; the same wherever a search is."""
        return self.white(self.regressor)

    def white(self, values: Float[np.ndarray, "rows nv *k"]) -> Float[np.ndarray, "rows nv *k"]:
        """Derivatives of forces as those of whitened residuals."""
        return (self.whitening @ values.reshape(*self.a.shape, -1)).reshape(values.shape)


def kept_forces(system: MechanicalSystem, terms: JointTerms) -> tuple[KnownForce, ...]:
    """Known forces not estimated, less the bias and what an observer found.

    Raises InvalidInput for systems without a bias, and for contacts that slide.
    """
    sliding = ", ".join(dict.fromkeys(contact.frame for contact in system.contacts if slides(contact)))
    if sliding:
        raise InvalidInput(
            f"the robot touches something with {sliding} and slides on it, with friction that is not measured; "
            "identify it from a motion in the air (system.with_contacts([])), or use StructuredGP.identify."
        )
    if not any(type(force) is RigidBodyBias for force in system.known_forces):
        raise InvalidInput("the known forces lack RigidBodyBias(); list it, since its parameters are estimated.")
    skipped: Sequence[type[KnownForce]] = (RigidBodyBias, *OBSERVED, *terms.kinds)
    return tuple(force for force in system.known_forces if type(force) not in skipped)


def slides(contact: Contact) -> bool:
    """Whether friction can act along the contact: on a surface, other than at held points, loops and wheels."""
    return not isinstance(contact, LoopClosure | RollingContact) and not isinstance(contact.surface, Held)


def independent_rows(
    A: Float[np.ndarray, "rows m nv"], b: Float[np.ndarray, "rows m"]
) -> tuple[Float[np.ndarray, "rows r nv"], Float[np.ndarray, "rows r"]]:
    """``A a = b`` with orthonormal rows, r of the largest rank; of smaller ranks the last ones are zero."""
    if not A.shape[1]:
        return A, b
    left, sizes, right = np.linalg.svd(A, full_matrices=False)
    counts = sizes > REDUNDANCY_TOLERANCE * np.maximum(sizes[:, :1], np.finfo(np.float64).tiny)
    most = int(counts.sum(1).max())
    scaled = (left.swapaxes(1, 2) @ b[..., None])[..., 0] / np.where(counts, sizes, 1.0)
    return (right * counts[..., None])[:, :most], (scaled * counts)[:, :most]
