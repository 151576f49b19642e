"""Rows of a recording as least squares sees them: residuals of torque or acceleration, with exact Jacobians.

    torque           r = Y(q, v, a) pi + M_0 a + t(x; v, a) - Q
    acceleration     r = a - a^,    dr/dpi = H Y(q, v, a^),    dr/dx = H dt/dx (v, a^)

Torque sensors at links see the same without gears: r = Y pi + t - Q at some joints, of laws and forces outside gears.
Friction g |u| under load makes u = z / (1 - g sign z). Where a and u are both noisy, the accelerations that were there
are those of errors in variables (Fuller, "Measurement Error Models", 1987, section 3.2), given the contacts.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.data import Dataset, with_memory
from forcegp.data.dataset import FORCE, IMU, TORQUE
from forcegp.data.imu import specific_force
from forcegp.errors import InvalidInput, require_type
from forcegp.evidence.bodies import standard_parameters
from forcegp.evidence.least_squares import NoiseLevels, Rows, orthonormal_columns, without
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.forces import Actuation, Law, RigidBodies
from forcegp.forces.actuation import OBSERVED
from forcegp.mechanics import ConstrainedDynamics, Contact, Held, State
from forcegp.mechanics.gauss_principle import REDUNDANCY_TOLERANCE
from forcegp.model import Model
from forcegp.robots import Kinematics
from forcegp.robots.inertia import pseudo_inertia_of_standard, standard_of_pseudo_inertia

Positions = Float[np.ndarray, "rows nq"]
Inputs = Float[np.ndarray, "rows nu"]


def motion_residuals(dataset: Dataset, model: Model) -> tuple[Rows, Rows]:
    """Residuals of joint forces, Q_K - M a (Nm or N), and of accelerations, measured less predicted.

    Forces of feet that stand are left out, where no sensor measured them; those of contacts that slide are
    not. Under friction that grows with |u| the force is what u exceeds the u by that the model needs.
    """
    dataset = with_memory(require_type("dataset", dataset, Dataset), model)
    q, v, u, a = (torch.tensor(np.array(getattr(dataset, x)), device=model.robot.device) for x in ("q", "v", "u", "a"))
    dynamics = model.dynamics(q, v, u)
    force, missed = dynamics.Q_K - (dynamics.M @ a[..., None])[..., 0], a - dynamics.acceleration_map().offset
    for friction in model.laws:
        if friction.under_load:
            ones, motor = friction.at_joints(torch.ones_like(a)), friction.at_motors
            idle, loaded = (friction.force(_under_load(dynamics.state, load)) for load in (0.0 * ones, ones))
            delivered, slope = motor(dynamics.state.delivered), motor(loaded - idle)
            without_load = delivered + slope * delivered.abs() - motor(force)  # z = u - g |u| - force
            force = dynamics.state.delivered - friction.at_joints(without_load / (1.0 + slope * without_load.sign()))
    for frame, values in sensed_of(dataset).items():
        force = force + (arm(dynamics.state.kinematics, model, frame) @ torch.tensor(values[..., None]).to(a))[..., 0]
    open_ = [k for k, contact in enumerate(model.contacts) if f"{FORCE}{contact.frame}" not in dataset.measured]
    if open_ and not any(slides(model.contacts[k]) for k in open_):
        A, b, _ = model.constraint(replace(dynamics.state, u=model.bearing(dynamics.state.u)))
        held, _ = independent_rows(A[:, open_].cpu().numpy(), b[:, open_].cpu().numpy())
        return without(force.cpu().numpy(), held.swapaxes(1, 2)), missed.cpu().numpy()
    return force.cpu().numpy(), missed.cpu().numpy()


SENSOR_SHARE = 0.02  # of what a sensor measures: its standard deviation, where nobody states it


def share_of(values: Float[np.ndarray, "rows k"]) -> float:
    """The noise of a sensor that measured these values, where nobody states it."""
    return max(SENSOR_SHARE * float(np.sqrt(np.square(values).mean())), 1e-9)


def sensed_of(log: Dataset) -> dict[str, Float[np.ndarray, "rows 3"]]:
    """What its force sensors measured, by frame."""
    return {name.removeprefix(FORCE): values for name, values in log.measured.items() if name.startswith(FORCE)}


def arm(kinematics: Kinematics, model: Model, frame: str) -> Float[Tensor, "rows nv 3"]:
    """Joint forces of a force on the robot at a frame, or at the point of its contacts. Raises InvalidInput."""
    points = {contact.point for contact in model.contacts if contact.frame == frame}
    if len(points) > 1:
        seen = f"a force at {frame!r} was measured, which is held at {len(points)} points"
        raise InvalidInput(f"{seen}: only a torque tells how they share it; hold one point.")
    [point] = points or {(0.0, 0.0, 0.0)}
    return kinematics.frame_jacobian(frame, point)[..., :3, :].mT


Response = Callable[[Float[np.ndarray, "rows nv *k"]], Float[np.ndarray, "rows nv *k"]]
"""What joint forces without friction in proportion to the load become with it, to first order."""


def _turned(T: Float[np.ndarray, "nv nv"] | None, values: Float[np.ndarray, "rows nv *k"]) -> np.ndarray:
    return values if T is None else np.einsum("kj,nk...->nj...", T, values)


def _under_load(state: State, load: Tensor) -> State:  # with actuators that deliver these joint forces
    return replace(state, delivered_by=lambda _: load)


FIRST = 1e-2  # of the root mean square of the residual forces, what rough searches take for noise of forces


@dataclass(frozen=True, eq=False)
class Motion:
    """Accelerations of the rows, and the torque that they need, but for what is estimated; then that at links.

    `regressor`: derivatives in standard parameters of estimated bodies; `fixed`: torque of others less given forces.
    """

    a: Rows
    regressor: Float[np.ndarray, "rows equations n 10"]
    fixed: Float[np.ndarray, "rows equations"]


class RecordedRows:
    """States of one log of a model, the given forces there, and the terms of the equation of motion.

    `loaded` tells whether payloads that are estimated were there. Contacts that slide are refused unless `any_contact`.
    `sensed` is what sensors measured, as `Dataset.measured`. `pushed` joints have torques that show nothing.
    """

    def __init__(
        self,
        space: ParameterSpace,
        q: Positions,
        v: Rows,
        u: Inputs,
        loaded: bool = True,
        any_contact: bool = False,
        strokes: Float[np.ndarray, "rows nv strokes"] | None = None,
        sensed: Mapping[str, Float[np.ndarray, "rows _"]] | None = None,
        pushed: Sequence[int] = (),
    ) -> None:
        model, robot = space.model, space.model.loaded_robot
        at_q, at_v, at_u = (torch.as_tensor(np.array(x), device=robot.device) for x in (q, v, u))
        self.space, self.loaded, self.q, self.v = space, loaded, np.array(q), np.array(v)
        past = None if strokes is None else torch.as_tensor(np.array(strokes), device=robot.device)
        self.state = replace(model.state(at_q, at_v, at_u), strokes=past)
        self.kinematics = self.state.kinematics
        self.delivered = self.state.delivered.cpu().numpy()
        A, b, _ = model.constraint(self.state)
        self.held, self.right = independent_rows(A.cpu().numpy(), b.cpu().numpy())
        """Orthonormal rows (rows, m, nv) with ``held a = right``; rows of zeros where nothing holds."""
        imus = {name: x for name, x in (sensed or {}).items() if name.startswith(IMU)}
        maps = [specific_force(self.kinematics, name) for name in imus]
        parts = [(x.matrix.cpu().numpy(), x.offset.cpu().numpy()) for x in maps]
        self.felt = np.concatenate([np.zeros((*self.v.shape[:1], 0, robot.nv)), *(J for J, _ in parts)], axis=1)
        """What IMUs measure of accelerations (rows, k, nv); of that their values are `felt_right`, with this noise."""
        left = [np.array(x) - offset for x, (_, offset) in zip(imus.values(), parts, strict=True)]
        self.felt_right = np.concatenate([np.zeros((len(self.v), 0)), *left], axis=1)
        stated = None if model.noise is None else model.noise.sensor  # of force sensors, then of IMUs and torques
        at_links = {name: x for name, x in (sensed or {}).items() if name.startswith(TORQUE)}
        own = [share_of(x) for x in imus.values() for _ in "xyz"] + [share_of(x) for x in at_links.values()]
        level = np.resize(np.atleast_1d(own if stated is None else stated)[-len(own) :], len(own))
        self.felt_noise, self.link_noise = np.split(level, [3 * len(imus)])
        self.links = [robot.joint_names.index(name.removeprefix(TORQUE)) for name in at_links]
        """Joints with a torque sensor at the link, which measured `at_links` (rows, k)."""
        self.equations = [*range(robot.nv), *self.links]
        self.at_links = np.concatenate([np.zeros((len(self.v), 0)), *at_links.values()], axis=1)
        self.sensed = sensed = {n.removeprefix(FORCE): x for n, x in (sensed or {}).items() if n.startswith(FORCE)}
        arms = {frame: arm(self.kinematics, model, frame).cpu().numpy() for frame in sensed}
        forces = (each @ sensed[frame][..., None] for frame, each in arms.items())
        self.at_contacts = sum(forces, np.zeros((*self.v.shape, 1)))[..., 0]
        """Joint forces of what sensors measured."""
        bearing = model.bearing(at_u)
        if more := bool((bearing != at_u).any()):
            A = model.constraint(replace(self.state, u=bearing))[0]
        self.open = self.held
        """Orthonormal rows (rows, m, nv): directions of joint forces that nothing measured, of contacts and pushes."""
        if sensed or pushed or more:
            hidden = A[:, [contact.frame not in sensed for contact in model.contacts]].cpu().numpy()
            axes = np.broadcast_to(np.eye(robot.nv)[list(pushed)], (len(A), len(pushed), robot.nv))
            rows = np.concatenate([hidden, axes], axis=1)
            self.open, _ = independent_rows(rows, np.zeros(rows.shape[:2]))
        self.force, self.in_gears, self.inertia = 0.0 * self.v, 0.0 * self.v, np.zeros((robot.nv, robot.nv))
        for force in kept_laws(space, any_contact, sensed):
            own = force.force(self.state).detach().cpu().numpy()
            self.force, self.in_gears = self.force + own, self.in_gears + force.in_gear * own
            added = force.added_inertia(robot)
            self.inertia = self.inertia + (0.0 if added is None else added.detach().cpu().numpy())
        self._armature = np.diag(robot.armature.cpu().numpy())
        self._carriers = [each.body for each in space.carried]
        self._there = np.array([1.0 if each.payload is None or loaded else 0.0 for each in space.carried])
        # standard parameters of bodies that are not estimated; those of a payload come on top
        self._stated = np.zeros((len(robot.layout.bodies), 10))
        self._stated[space.own] = standard_parameters(robot).reshape(-1, 10).cpu().numpy()
        own = [each.body for each in space.carried if each.payload is None]
        unloaded = standard_parameters(model.robot).reshape(-1, 10).cpu().numpy()
        self._stated[own] -= unloaded[[space.own.index(body) for body in own]]
        laws = [space.model.laws[term.law] for term in space.terms for _ in term.size]
        self._beyond = np.array([not law.in_gear for law in laws])
        """Of the coordinates of laws: which of them are at the links' side of gears, and other kinds."""
        self._under_load = np.array([law.under_load for law in laws])
        self._gains = np.array([isinstance(law, Actuation) for law in laws])
        self._caches: dict[bool, dict[Any, Any]] = {False: {}, True: {}}

    @cached_property
    def _sensing(self) -> tuple[Float[np.ndarray, "rows k nv"], Float[np.ndarray, "rows k"]]:
        """What makes sensed forces of A^T lambda, and those that were measured."""
        model = self.space.model
        if alone := self.sensed.keys() - {contact.frame for contact in model.contacts}:
            where = f"a force was measured at {', '.join(sorted(alone))}, where the model has no contact"
            raise InvalidInput(f"{where}: accelerations cannot teach numbers beside it; give Torques().")
        A, b, normals = model.constraint(self.state)
        M = torch.eye(A.shape[-1]).to(A)
        parts = ConstrainedDynamics(
            self.state, M.expand(*A.shape[:1], *M.shape), A, b, normals, torch.zeros_like(A[:, 0]), model.contacts
        )  # with M = 1 a multiplier is that of the joint force -A^T lambda
        maps = [-parts.force_at(frame).matrix for frame in self.sensed]
        forces = (parts.as_measured(frame, torch.tensor(np.array(x)).to(A)) for frame, x in self.sensed.items())
        return torch.cat(maps, 1).cpu().numpy(), torch.cat([*forces], 1).cpu().numpy()

    def moving(self, a: Rows, given: bool = True) -> Motion:
        """These rows with these accelerations; `given` takes off what sensors at contacts measured."""
        a = np.array(a)
        Y = self.kinematics.torque_regressor(torch.as_tensor(a, device=self.kinematics.robot.device)).cpu().numpy()
        fixed = Y.reshape(*a.shape, -1) @ self._stated.ravel() + a @ (self.inertia + self._armature) - self.force
        fixed = fixed - self.at_contacts if given else fixed
        regressor = np.ascontiguousarray(Y[:, self.equations][:, :, self._carriers]) * self._there[:, None]
        beside = (fixed - a @ (self.inertia + self._armature) + self.in_gears)[:, self.links] - self.at_links
        return Motion(a, regressor, np.concatenate([fixed, beside], axis=1))

    def by_body(self, a: Rows) -> Float[np.ndarray, "rows nv bodies"]:
        """What each body needs, without what is estimated of it."""
        Y = self.kinematics.torque_regressor(torch.as_tensor(np.array(a), device=self.kinematics.robot.device))
        return (Y.cpu().numpy() * self._stated).sum(-1)

    def by_center(self, a: Rows) -> Float[np.ndarray, "rows nv entries"]:
        """How that changes as the center of each body moves along x, y and z of its joint, per m."""
        Y = self.kinematics.torque_regressor(torch.as_tensor(np.array(a), device=self.kinematics.robot.device)).cpu()
        pseudo = pseudo_inertia_of_standard(torch.as_tensor(self._stated))
        moved = torch.zeros(3, 1, 4, 4, dtype=pseudo.dtype)
        moved[range(3), 0, range(3), 3] = 1.0
        slopes = standard_of_pseudo_inertia(moved @ pseudo + pseudo @ moved.mT)
        return torch.einsum("nibp,kbp->nibk", Y, slopes).flatten(2).numpy()

    def _terms(self, x: np.ndarray, a: Rows, loads: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """`ParameterSpace.torque` under the measured load, or under none; then what a load of 1 of all motors adds."""
        none, law, both = torch.zeros_like(self.state.v), self.space.under_load, None
        if loads and law is not None:
            both = _under_load(self.state, torch.stack([none, law.at_joints(none + 1.0)]))
        state = _under_load(self.state, none) if loads else self.state
        return self.space.torque(x, state, a, self._caches[loads], both)

    def in_torque(self, x: np.ndarray, motion: Motion) -> tuple[np.ndarray, np.ndarray, np.ndarray, Response]:
        """Residual (rows, equations), slopes in standard parameters and in x of laws, and du/dz of forces."""
        nv, parameters = motion.a.shape[1], self.space.standard_parameters(x)
        rigid = motion.fixed + motion.regressor.reshape(*motion.fixed.shape, -1) @ parameters.ravel()
        joints, regressor, law = rigid[:, :nv], motion.regressor, self.space.under_load
        (torque, *more), (in_x, *more_in_x) = self._terms(x, motion.a, True)
        beyond = in_x[:, self.links] * self._beyond
        r, response = joints + torque, lambda values: values
        if law is not None:
            T = None if law.transmission is None else np.asarray(torch.as_tensor(law.transmission).cpu())
            motor, joint = (partial(_turned, each) for each in (None if T is None else np.linalg.inv(T), T))
            delivered, of_gains = self.space.delivered(x, self.state, self.delivered), in_x[..., self._gains]
            z, g = motor(joints + torque + delivered), motor(more[0])
            sign = np.sign(z)
            left = 1.0 - g * sign
            u = z / left

            def borne(values: np.ndarray) -> np.ndarray:
                return joint(motor(values) / left.reshape(*left.shape, *(1,) * (values.ndim - 2)))

            response = borne if g.any() else response  # else regressors stay as they are, and their squares with them
            own = self._under_load
            in_x[..., self._gains] = 0.0  # z has what is delivered in it
            in_x[..., own] += joint((u * sign)[..., None] * motor(more_in_x[0][..., own]))
            r, in_x = joint(u) - delivered, response(in_x)
            in_x[..., self._gains] += of_gains
            own = response(regressor[:, :nv])
            regressor = np.concatenate([own, regressor[:, nv:]], axis=1) if self.links else own
        if self.links:
            beside, laws = rigid[:, nv:], self.space.model.laws
            for k, values in self.space.values(x).items():
                if not laws[k].in_gear:
                    beside = beside - laws[k].force_at(self.state, values).cpu().numpy()[:, self.links]
            r, in_x = np.concatenate([r, beside], axis=1), np.concatenate([in_x, beyond], axis=1)
        return r, regressor, in_x, response

    def acceleration(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """a^ (rows, nv), the mass matrices and H (rows, nv, nv). Raises NumericalError where a matrix is singular."""
        given = self._stated.copy()
        np.add.at(given, self._carriers, self.space.standard_parameters(x) * self._there[:, None])
        parts = self.kinematics.dynamics_of_bodies(torch.as_tensor(given, device=self.kinematics.robot.device))
        M, bias = (part.cpu().numpy() for part in parts)
        M = M + self.inertia + self.space.added_inertia(x)
        [torque], _ = self._terms(x, np.zeros_like(self.v))
        parts = (M, self.held, self.right, np.zeros((*self.right.shape, 3)), self.force - bias - torque)
        mass, A, b, normals, force = map(torch.as_tensor, parts)
        dynamics = ConstrainedDynamics(self.state, mass, A, b, normals, force)
        return dynamics.acceleration_map().offset.numpy(), M, dynamics.H.numpy()

    def in_acceleration(self, x: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residual a - a^ and its derivatives, as `in_torque`; then those of force sensors at contacts and of IMUs.

        With the torque t of the motion A^T lambda = M a^ + t, of which D makes the force of a sensor, and
        dr / dpi = -D (1 - M H) Y. What IMUs measure is affine in a^.
        """
        predicted, M, H = self.acceleration(x)
        [torque], [in_x] = self._terms(x, predicted)
        r, by, shape = [a - predicted], [H], predicted.shape
        Y = self.moving(predicted).regressor[:, : shape[1]]
        if self.sensed:
            fixed, (D, seen) = self.moving(predicted, given=False).fixed[:, : shape[1]], self._sensing
            rigid = fixed + Y.reshape(*shape, -1) @ self.space.standard_parameters(x).ravel()
            by.append(-D @ (np.eye(shape[1]) - M @ H))
            r.append(seen - (D @ (rigid + torque)[..., None])[..., 0])
        r = np.concatenate([*r, self.felt_right - (self.felt @ predicted[..., None])[..., 0]], axis=1)
        by = np.concatenate([*by, self.felt @ H], axis=1)
        return r, (by @ Y.reshape(*shape, -1)).reshape(*r.shape, *Y.shape[2:]), by @ in_x

    def rough_noise(self, x: np.ndarray, a: Rows) -> NoiseLevels:
        """Noise of accelerations alone, where searches start: with forces any mass of a base would be explained."""
        predicted, M, _ = self.acceleration(x)
        residual = a - predicted
        force = FIRST * np.sqrt(((M @ residual[..., None]) ** 2).mean((0, 2))).clip(1e-12)
        return NoiseLevels(np.sqrt((residual**2).mean(0)).clip(1e-12), force)

    def likely(self, x: np.ndarray, measured: Motion, noise: NoiseLevels) -> "LikelyAccelerations":
        """What was there where a and u are noisy, by the estimates at x, these levels of noise, contacts and IMUs."""
        # forces of joints that nothing measures, as those of a base, belong to a*, since they move the robot
        _, M, H = self.acceleration(x)
        needed, _, _, response = self.in_torque(x, measured)
        of_bodies = M - self.inertia - self._armature - self.space.added_inertia(x)
        M, a = np.concatenate([response(M), of_bodies[:, self.links]], axis=1), measured.a
        robot = self.space.model.robot
        of_joints = np.isin(robot.joint_names, robot.single_joint_names)
        e_a = np.diag(noise.acceleration**2) + (H * np.where(of_joints, 0.0, noise.force**2)) @ H
        A, right = np.concatenate([self.held, self.felt], 1), np.concatenate([self.right, self.felt_right], 1)
        idle = np.logical_not(self.held.any(axis=-1))
        least = np.concatenate([idle, np.broadcast_to(self.felt_noise**2, self.felt_right.shape)], axis=1)
        at_contacts = A @ e_a
        among = at_contacts @ A.swapaxes(1, 2) + least[:, :, None] * np.eye(A.shape[1])
        gain = np.linalg.solve(among, at_contacts).swapaxes(1, 2)
        moved = (gain @ (right[..., None] - A @ a[..., None]))[..., 0]
        e_a = e_a - gain @ at_contacts
        S = M @ e_a @ M.swapaxes(1, 2) + np.diag(np.append(np.where(of_joints, noise.force, 0.0), self.link_noise) ** 2)
        # directions of contact forces; without them S is singular where contacts hold
        open_ = self.open.swapaxes(1, 2)
        pushed = np.concatenate([response(open_), open_[:, self.links]], axis=1).swapaxes(1, 2)
        S = S + np.trace(S, axis1=1, axis2=2)[:, None, None] * pushed.swapaxes(1, 2) @ pushed
        whitening = np.linalg.inv(np.linalg.cholesky(S))
        whitening = without(whitening, orthonormal_columns(pushed @ whitening.swapaxes(1, 2)))
        at_contact = needed + (M @ moved[..., None])[..., 0]
        weighted = whitening.swapaxes(1, 2) @ (whitening @ at_contact[..., None])
        there = self.moving(a + moved - (e_a @ M.swapaxes(1, 2) @ weighted)[..., 0])
        return LikelyAccelerations(there, at_contact - self.in_torque(x, there)[0], whitening)


@dataclass(frozen=True, eq=False)
class LikelyAccelerations:
    """Motions with the accelerations a* where a and u are noisy.

    Of n equations, `offset` (rows, n): forces that the measured a needs less those of a*; `whitening`: L^-1, S = L L^T.
    """

    motion: Motion
    offset: Float[np.ndarray, "rows equations"]
    whitening: Float[np.ndarray, "rows equations equations"]

    @cached_property
    def white_regressor(self) -> Float[np.ndarray, "rows equations n 10"]:
        """`white` of the regressor; the same wherever a search is."""
        return self.white(self.motion.regressor)

    def white(self, values: Float[np.ndarray, "rows equations *k"]) -> np.ndarray:
        """Derivatives of forces as those of whitened residuals."""
        return (self.whitening @ values.reshape(*self.whitening.shape[:2], -1)).reshape(values.shape)


def kept_laws(space: ParameterSpace, any_contact: bool = False, sensed: Iterable[str] = ()) -> tuple[Law, ...]:
    """Laws not estimated, less the bias and what an observer found.

    Raises InvalidInput for models without a bias, and for contacts that slide where no force is `sensed`.
    """
    model = space.model
    frames = (contact.frame for contact in model.contacts if slides(contact) and contact.frame not in sensed)
    sliding = ", ".join(dict.fromkeys(frames))
    if sliding and not any_contact:
        seen = f"the robot touches something with {sliding} and slides on it, with friction that is not measured"
        advice = "learn from a motion in the air (model.with_contacts([])), or give the model an unknown force there."
        raise InvalidInput(f"{seen}; {advice}")
    if model.carries_known_forces:
        raise InvalidInput("the forces lack RigidBodies(); list it, since without gravity no number can be estimated.")
    skipped: Sequence[type[Law]] = (RigidBodies, *OBSERVED)
    estimated = {term.law for term in space.terms}
    return tuple(law for k, law in enumerate(model.laws) if type(law) not in skipped and k not in estimated)


def slides(contact: Contact) -> bool:
    """Whether friction can act along the contact: on a surface, other than at held points."""
    return not isinstance(contact.surface, Held)


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
