"""A model that MuJoCo compiled, as URDF elements and rotor inertias (:mod:`forcegp.robots.mjcf`)."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from forcegp.errors import RobotModelError
from forcegp.robots.arguments import Problems
from forcegp.robots.inertia import rotation_about, rpy_from_rotation, transform
from forcegp.robots.manifold import VELOCITIES
from forcegp.robots.urdf import numbers
from forcegp.robots.urdf_file import inertial_element

KINDS = {0: "floating", 2: "prismatic", 3: "revolute"}  # of MuJoCo's joints (mjtJoint) in URDF
WORLD = "world"


@dataclass(frozen=True)
class Motor:
    """Joint forces by joint, or a wrench (N, Nm) about the origin of a link, of one unit of an actuator's input."""

    name: str
    column: dict[str, float]
    link: str = ""
    wrench: tuple[float, ...] = ()


@dataclass(frozen=True)
class Translation:
    """A compiled MJCF file as what a :class:`~forcegp.robots.Robot` is made of."""

    urdf: str
    gravity: np.ndarray
    locked: dict[str, float]
    loops: tuple[tuple[str, str, str], ...] = ()
    """Names of equalities that hold two links together, and these."""
    motors: tuple[Motor, ...] = ()
    """All, if some act at sites of bodies."""
    springs: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Stiffness (Nm/rad or N/m) and position at rest of joints that turn or slide."""


class CompiledModel:
    """A compiled model, and the URDF elements that are made of it."""

    def __init__(self, mujoco: Any, model: Any, name: str, for_system: bool, problems: Problems) -> None:
        self.mujoco, self.model, self.for_system, self.problems = mujoco, model, for_system, problems
        self.name = name
        self.elements: list[str] = []
        self.links: set[str] = set()
        self.couplings: dict[int, tuple[int, float, float]] = {}
        self.locked: dict[int, float] = {}
        self.bodies = [self._named(model.body(k).name or f"body_{k}", self.links) for k in range(model.nbody)]
        self.taken_joints: set[str] = set()
        self.joints = []
        for k in range(model.njnt):
            kind, body = ("free", "ball", "slide", "hinge")[model.jnt_type[k]], self.bodies[model.jnt_bodyid[k]]
            if kind == "ball":
                raise RobotModelError(f"{problems.source}: body {body!r} has a ball joint; give it three hinges.")
            self.joints.append(self._named(model.joint(k).name or f"{body}_{kind}", self.taken_joints))

    def translation(self) -> Translation:
        """Links and joints; notes of what is left out."""
        self._couple()
        self._link(WORLD)
        for body in range(1, self.model.nbody):
            self._body(body)
        for site in range(self.model.nsite):
            if name := self.model.site(site).name:
                body, frame = self.bodies[self.model.site_bodyid[site]], self._named(name, self.links)
                self._fixed(body, frame, self._pose(self.model.site_pos[site], self.model.site_quat[site]))
        loops, motors = tuple(self._loops()), self._motors() if self.for_system else ()
        self._note_losses(bool(motors))
        disabled = self.model.opt.disableflags & int(self.mujoco.mjtDisableBit.mjDSBL_GRAVITY)
        gravity = np.zeros(3) if disabled else np.array(self.model.opt.gravity)
        text = "\n".join([f"<robot name={quoteattr(self.name)}>", *self.elements, "</robot>\n"])
        locked = {self.joints[joint]: value for joint, value in self.locked.items()}
        model, sprung = self.model, [k for k in range(self.model.njnt) if self.for_system and self._is_sprung(k)]
        rest = {k: float(model.qpos_spring[model.jnt_qposadr[k]]) for k in sprung}
        springs = {self.joints[k]: (float(model.jnt_stiffness[k]), rest[k]) for k in sprung}
        return Translation(text, gravity, locked, loops, motors, springs)

    @staticmethod
    def _named(name: str, taken: set[str]) -> str:  # or one with a number where it is taken
        found, number = name, 1
        while found in taken:
            number += 1
            found = f"{name}_{number}"
        taken.add(found)
        return found

    def _pose(self, position: Any, quaternion: Any) -> np.ndarray:
        rotation = np.zeros(9)
        self.mujoco.mju_quat2Mat(rotation, np.array(quaternion, dtype=np.float64))
        return transform(rotation.reshape(3, 3), position)

    def _link(self, name: str, inside: str = "") -> None:
        self.elements.append(f"  <link name={quoteattr(name)}{f'>{inside}</link>' if inside else '/>'}")

    def _fixed(self, parent: str, child: str, pose: np.ndarray, inside: str = "") -> None:
        self._link(child, inside)
        self._joint(self._named(f"{child}_fixed", self.taken_joints), "fixed", parent, child, pose, "")

    def _joint(self, name: str, kind: str, parent: str, child: str, origin: np.ndarray, more: str) -> None:
        xyz, rpy = numbers(origin[:3, 3]), numbers(rpy_from_rotation(origin[:3, :3]))
        links = f"<parent link={quoteattr(parent)}/><child link={quoteattr(child)}/>"
        inside = f'{links}<origin xyz="{xyz}" rpy="{rpy}"/>{more}'
        self.elements.append(f'  <joint name={quoteattr(name)} type="{kind}">{inside}</joint>')

    def _body(self, body: int) -> None:
        model, name = self.model, self.bodies[body]
        upper, at = self.bodies[model.body_parentid[body]], self._pose(model.body_pos[body], model.body_quat[body])
        inside, first = self._inertial(body), model.body_jntadr[body]
        for joint in range(first, first + model.body_jntnum[body]):
            kind, anchor = KINDS[model.jnt_type[joint]], np.array(model.jnt_pos[joint])
            axis, start = np.array(model.jnt_axis[joint]), model.qpos0[model.jnt_qposadr[joint]]
            if kind == "floating":  # its position is that in the world
                at, anchor = np.eye(4), np.zeros(3)
            at = at @ transform(np.eye(3), anchor)
            if kind == "revolute":
                at = at @ transform(rotation_about(axis, -start), np.zeros(3))
            elif kind == "prismatic":
                at = at @ transform(np.eye(3), -start * axis)
            last = joint + 1 == first + model.body_jntnum[body] and not anchor.any()
            child = name if last else self._named(f"{self.joints[joint]}_link", self.links)
            self._link(child, inside if last else "")
            turns = "continuous" if kind == "revolute" and not model.jnt_limited[joint] else kind
            self._joint(self.joints[joint], turns, upper, child, at, self._parts(joint, kind))
            upper, at = child, transform(np.eye(3), -anchor)
        if upper != name:
            self._fixed(upper, name, at, inside)

    def _inertial(self, body: int) -> str:
        model = self.model
        if not model.body_mass[body] > 0.0:
            return ""
        pose = self._pose(model.body_ipos[body], model.body_iquat[body])
        inertia = pose[:3, :3] @ np.diag(model.body_inertia[body]) @ pose[:3, :3].T
        return inertial_element(model.body_mass[body], pose[:3, 3], inertia)

    def _parts(self, joint: int, kind: str) -> str:
        model, dof, parts = self.model, self.model.jnt_dofadr[joint], []
        if kind in ("revolute", "prismatic"):
            parts.append(f'<axis xyz="{numbers(model.jnt_axis[joint])}"/>')
            lower, upper = model.jnt_range[joint]
            limits = {"lower": lower, "upper": upper} if model.jnt_limited[joint] else {}
            limits |= {"effort": effort} if np.isfinite(effort := self._effort(joint)) else {}
            parts.append(_element("limit", limits))
        dynamics = {"damping": model.dof_damping[dof], "friction": model.dof_frictionloss[dof]}
        if kind == "floating" and model.dof_armature[dof]:
            self._lose("rotor inertia of a free body", self.joints[joint])
        elif kind != "floating":
            geared = (model.actuator_armature[k] * model.actuator_gear[k][0] ** 2 for k in self._actuators_of(joint))
            dynamics["armature"] = float(model.dof_armature[dof] + sum(geared))
        parts.append(_element("dynamics", dynamics if any(dynamics.values()) else {}))
        if joint in self.couplings:
            driver, multiplier, offset = self.couplings[joint]
            ratio = _element("mimic", {"multiplier": multiplier, "offset": offset})
            parts.append(ratio.replace("<mimic", f"<mimic joint={quoteattr(self.joints[driver])}"))
        return "".join(parts)

    def _actuators_of(self, joint: int) -> list[int]:  # that act on one joint by a constant ratio
        kinds = self.mujoco.mjtTrn
        direct = (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT))
        acts = np.isin(self.model.actuator_trntype, direct) & (self.model.actuator_trnid[:, 0] == joint)
        return np.flatnonzero(acts).tolist()

    def _effort(self, joint: int) -> float:
        """The largest force of the actuators in Nm or N; infinite where one has no limit, or there is none."""
        model = self.model
        if model.jnt_actfrclimited[joint]:
            return float(np.abs(model.jnt_actfrcrange[joint]).max())
        total, actuators = 0.0, self._actuators_of(joint)
        for k in actuators:
            force = np.inf
            if model.actuator_forcelimited[k]:
                force = np.abs(model.actuator_forcerange[k]).max()
            elif model.actuator_ctrllimited[k] and self._is_motor(k):
                force = np.abs(model.actuator_ctrlrange[k]).max() * abs(model.actuator_gainprm[k][0])
            total += force * abs(model.actuator_gear[k][0])
        return float(total) if actuators else np.inf

    def _is_motor(self, actuator: int) -> bool:  # its force is its input times a constant
        model = self.model
        kinds = (model.actuator_gaintype[actuator], model.actuator_biastype[actuator], model.actuator_dyntype[actuator])
        return not any(kinds)

    def _motors(self) -> tuple[Motor, ...]:
        """All motors, where some act at sites; of a servo the input is its joint force."""
        model, found, taken, needed = self.model, [], set[str](), False
        for k in range(model.nu):
            gear, gain = model.actuator_gear[k], float(model.actuator_gainprm[k][0])
            link, wrench = "", ()
            name, motor = model.actuator(k).name or f"actuator_{k + 1}", self._is_motor(k)
            at_site = model.actuator_trntype[k] == self.mujoco.mjtTrn.mjTRN_SITE and model.actuator_trnid[k][1] < 0
            joints = [joint for joint in range(model.njnt) if k in self._actuators_of(joint)]
            if joints and model.jnt_type[joints[0]] >= 2 and joints[0] not in {*self.couplings, *self.locked}:
                name = name if motor else self.joints[joints[0]]
                column = {self.joints[joints[0]]: gain * float(gear[0]) if motor else 1.0}
                if not motor and Motor(name, column) in found:  # a second law of this joint
                    continue
            elif motor and at_site:
                site = model.actuator_trnid[k][0]
                body, pose = model.site_bodyid[site], self._pose(model.site_pos[site], model.site_quat[site])
                while body and not model.body_jntnum[body]:
                    pose = self._pose(model.body_pos[body], model.body_quat[body]) @ pose
                    body = model.body_parentid[body]
                first = model.body_jntadr[body]
                if not body:
                    return ()
                force = gain * pose[:3, :3] @ gear[:3]
                torque = gain * pose[:3, :3] @ gear[3:] + np.cross(pose[:3, 3], force)
                link, wrench, column, needed = self.bodies[body], (*force.tolist(), *torque.tolist()), {}, True
                if model.jnt_type[first] == 0:
                    names = [f"{self.joints[first]}.{each}" for each in VELOCITIES]
                    link, wrench, column = "", (), dict(zip(names, wrench, strict=True))
            elif joints or at_site:
                return ()
            else:
                continue
            found.append(Motor(self._named(name, taken), column, link, wrench))
        return tuple(found) if needed else ()

    def _couple(self) -> None:  # linear couplings of two joints, and joints that one holds
        model, kinds = self.model, self.mujoco.mjtEq
        for k in range(model.neq):
            if model.eq_type[k] != kinds.mjEQ_JOINT or not model.eq_active0[k]:
                continue
            joint, other, law = model.eq_obj1id[k], model.eq_obj2id[k], model.eq_data[k][:5]
            name, start = self._equality(k), model.qpos0[model.jnt_qposadr[joint]]
            if other >= 0 and law[2:].any():
                self._lose("couplings of joints that are not linear", name)
            elif joint in self.couplings or joint in self.locked:
                self._lose("second couplings of a joint", name)
            elif other < 0:
                self.locked[joint] = float(start + law[0])
            else:
                offset = start + law[0] - law[1] * model.qpos0[model.jnt_qposadr[other]]
                self.couplings[joint] = int(other), float(law[1]), float(offset)

    def _equality(self, k: int) -> str:
        return self.model.equality(k).name or f"equality {k}"

    def _is_sprung(self, joint: int) -> bool:  # a linear spring, and one coordinate of its own
        model = self.model
        linear = model.jnt_stiffness[joint] and not _any(model, "jnt_stiffnesspoly", joint)
        return bool(linear) and model.jnt_type[joint] >= 2 and joint not in self.couplings

    def _loops(self) -> Iterator[tuple[str, str, str]]:
        """Equalities of type connect and weld between links; who moves a mocap body moves it from outside."""
        model, kinds = self.model, self.mujoco.mjtEq
        for k in range(model.neq):
            if model.eq_type[k] not in (int(kinds.mjEQ_CONNECT), int(kinds.mjEQ_WELD)) or not model.eq_active0[k]:
                continue
            ends = [model.eq_obj1id[k], model.eq_obj2id[k]]
            if model.eq_objtype[k] == int(self.mujoco.mjtObj.mjOBJ_SITE):
                ends = [model.site_bodyid[end] for end in ends]
            if (model.body_mocapid[ends] < 0).all():
                first, second = (self.bodies[end] for end in ends)
                yield self._equality(k), first, second

    def _lose(self, what: str, where: str) -> None:
        self.problems.note(f"left out: {what}", where)

    def _note_losses(self, motors: bool) -> None:  # what acts on the joints in MuJoCo and not here, and how often
        model, joints, kinds = self.model, range(self.model.njnt), self.mujoco.mjtEq
        known = [int(kind) for kind in (kinds.mjEQ_JOINT, kinds.mjEQ_CONNECT, kinds.mjEQ_WELD)]
        driving = {k for joint in joints if model.jnt_type[joint] >= 2 for k in self._actuators_of(joint)}
        if motors:
            driving |= {k for k in range(model.nu) if model.actuator_trntype[k] == self.mujoco.mjtTrn.mjTRN_SITE}
        sprung = [k for k in joints if model.jnt_stiffness[k] or _any(model, "jnt_stiffnesspoly", k)]
        linear = [k for k in sprung if self._is_sprung(k)]
        servos = [k for k in range(model.nu) if not self._is_motor(k)]
        other = np.array(model.eq_active0, bool) & ~np.isin(model.eq_type, known)
        lost = {
            "springs (Model.from_mjcf has them)": 0 if self.for_system else len(linear),
            "springs": len(sprung) - len(linear),
            "damping that is not linear": sum(_any(model, "dof_dampingpoly", model.jnt_dofadr[k]) for k in joints),
            "compensation of gravity": np.count_nonzero(model.body_gravcomp),
            "motions from outside (mocap)": np.count_nonzero(model.body_mocapid >= 0),
            "tendons": model.ntendon,
            "laws of actuators (u holds joint forces)": len(servos),
            "actuators that drive no single joint": len({*range(model.nu)} - driving - {*servos}),
            "forces of deformable bodies": model.nflex,
            "forces of plugins": model.nplugin,
            "forces of a medium": int(bool(model.opt.density or model.opt.viscosity)),
            "constraints of other kinds than joint, connect and weld": np.count_nonzero(other),
        }
        for what, count in lost.items():
            if count:
                self._lose(what, str(count))


def _any(model: Any, name: str, row: int | np.integer) -> bool:
    return bool(np.any(getattr(model, name, np.zeros((row + 1, 1)))[row]))


def _element(tag: str, given: dict[str, float]) -> str:
    inside = "".join(f' {name}="{float(value)!r}"' for name, value in given.items())
    return f"<{tag}{inside}/>" if given else ""
