"""Terms of the joint torque beside the rigid bodies: friction, offset, and the inertia of rotors.

A term adds ``f(parameters; v) + B(parameters) a`` to the torque that a motion needs, and becomes a known force of the
system (which has the opposite sign). A new friction law is one entry in `LAWS`. Joints of several degrees of freedom,
such as a base that moves, have no terms.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from forcegp.analytical.identifiability import carrying
from forcegp.errors import InvalidInput, usable_arguments
from forcegp.mechanics import (
    Armature,
    ConstantJointForce,
    CoulombJointFriction,
    DirectionalJointFriction,
    KnownForce,
    LoadJointFriction,
    MechanicalSystem,
    RotorInertia,
    State,
    StribeckJointFriction,
    ViscousJointFriction,
)

Arrays = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Field:
    """One number per joint: its name and unit, its size as a multiple of torque and velocity, what it may be.

    `size` is (power of the typical torque, power of the typical velocity, factor). With `logarithm` the coordinate is
    the logarithm of the number over that size, within `lowest` and `highest` times it; else the number over it.
    `known` is what the known force calls it, which holds the sum with the field `above` where that is given.
    """

    name: str
    unit: str
    size: tuple[int, int, float]
    lowest: float = 0.0
    highest: float = np.inf
    logarithm: bool = False
    known: str = ""
    above: str | None = None


@dataclass(frozen=True)
class Law:
    """A known force that depends on v and u alone, with the numbers in it that are estimated."""

    kind: type[KnownForce]
    fields: tuple[Field, ...]

    def force(self, values: Mapping[str, torch.Tensor]) -> KnownForce:
        """The known force with these numbers, by the names of the fields."""
        sums = {f: values[f.name] + (values[f.above] if f.above else 0.0) for f in self.fields}
        return self.kind(**{f.known or f.name: number for f, number in sums.items()})

    def read(self, force: KnownForce) -> dict[str, np.ndarray]:
        """The numbers of a known force by the names of the fields."""
        read = {f.name: torch.as_tensor(getattr(force, f.known or f.name)).numpy().copy() for f in self.fields}
        return {f.name: np.maximum(read[f.name] - read[f.above], 0.0) if f.above else read[f.name] for f in self.fields}

    def torque(self, values: Arrays, state: State) -> tuple[np.ndarray, np.ndarray]:
        """What it adds to the torque (rows, nv), and the derivative in each field (fields, rows, nv)."""
        numbers = [torch.tensor(values[f.name]).expand(state.v.shape).clone().requires_grad_() for f in self.fields]
        with torch.enable_grad():
            torque = -self.force(dict(zip((f.name for f in self.fields), numbers, strict=True))).force(state)
            derivatives = torch.autograd.grad(torque.sum(), numbers)
        return torque.detach().numpy(), torch.stack(derivatives).numpy()


VELOCITY_SCALE = Field("velocity_scale", "1/s", (0, 1, 0.1), 0.03, 20.0, logarithm=True)
COULOMB = Field("coulomb", "force", (1, 0, 0.1))
LAWS: dict[str, Law] = {
    "viscous": Law(ViscousJointFriction, (Field("viscous", "force s", (1, -1, 0.1), known="coefficients"),)),
    "coulomb": Law(CoulombJointFriction, (replace(COULOMB, known="coefficients"), VELOCITY_SCALE)),
    "stribeck": Law(
        StribeckJointFriction,
        (
            COULOMB,
            Field("breakaway", "force", (1, 0, 0.1), known="static", above="coulomb"),
            Field("stribeck_velocity", "1/s", (0, 1, 0.3), 0.1, 10.0, logarithm=True),
            VELOCITY_SCALE,
        ),
    ),
    "load": Law(
        LoadJointFriction, (COULOMB, Field("load", "1", (0, 0, 0.1), highest=9.0, known="coefficients"), VELOCITY_SCALE)
    ),
    "direction": Law(
        DirectionalJointFriction, (Field("direction", "force s", (1, -1, 0.1), lowest=-np.inf, known="differences"),)
    ),
    "offset": Law(ConstantJointForce, (Field("offset", "force", (1, 0, 0.1), lowest=-np.inf, known="values"),)),
}
"""Friction laws and the offset by the name that `friction=` has for them."""
LINEAR_SPREAD = 10.0
"""Standard deviation of the prior on numbers that are not logarithms, in their sizes: as large as the torques."""
DRY = ("coulomb", "stribeck", "load")
"""Laws of dry friction: each has a constant part."""
INERTIA = Field("armature", "inertia", (0, 0, 0.1), known="inertia")
INERTIAS: dict[str, type[Armature | RotorInertia]] = {"armature": Armature, "rotor": RotorInertia}


class JointTerms:
    """The terms that are estimated, in coordinates x of size 1 for typical values; 10 times smaller is likely as well.

    Parameters
    ----------
    system: where their start values are read, and the transmission of rotors.
    friction: names out of `LAWS`; of those in `DRY` one, since each contains Coulomb friction.
    inertia: "armature", "rotor" (rotors of the system's RotorInertia) or None.
    torque, velocity, mass: typical size of joint forces, velocities and diagonal entries of M (nv,), with the unit
        of a coordinate in proportion.

    Raises InvalidInput for other names.
    """

    @usable_arguments("identify_analytical")
    def __init__(
        self,
        system: MechanicalSystem,
        friction: Sequence[str],
        inertia: str | None,
        *,
        torque: Float[np.ndarray, " nv"],
        velocity: Float[np.ndarray, " nv"],
        mass: Float[np.ndarray, " nv"],
    ):
        unknown = next((name for name in friction if name not in LAWS), None)
        if unknown is not None or isinstance(friction, str):
            raise InvalidInput(f"friction is {friction!r}; give a tuple of names out of {', '.join(LAWS)}.")
        dry = [name for name in dict.fromkeys(friction) if name in DRY]
        if len(dry) > 1:
            raise InvalidInput(f"friction names {' and '.join(dry)}; name one of them, each contains Coulomb friction.")
        if inertia not in (None, *INERTIAS):
            raise InvalidInput(f"rotors are {inertia!r}; give one of {', '.join(INERTIAS)}, or None.")
        self.robot, self.joints = system.robot, system.robot.single_joint_names
        self.laws = [LAWS[name] for name in dict.fromkeys(friction) if self.joints]
        self.inertia = inertia = inertia if self.joints else None
        self.bodies = carrying(system.robot)
        self.rows = np.flatnonzero(np.isin(system.robot.joint_names, self.joints))
        torque, velocity, mass = torque[self.rows], velocity[self.rows], mass[self.rows]
        self._rest = system.robot.kinematics(system.robot.space.neutral().to(system.robot.device))
        self.kinds = tuple([law.kind for law in self.laws] + ([INERTIAS[inertia]] if inertia else []))
        listed = {kind: [force for force in system.known_forces if type(force) is kind] for kind in self.kinds}
        twice = next((kind.__name__ for kind, found in listed.items() if len(found) > 1), None)
        if twice is not None:
            raise InvalidInput(f"the system lists {twice} more than once; list it once to have it estimated.")
        self._given = {kind: found[0] for kind, found in listed.items() if found}
        if inertia == "rotor" and RotorInertia not in self._given:
            raise InvalidInput(
                "rotors='rotor' estimates the rotors of a RotorInertia(...) with its transmission, and the system "
                "lists none; add it to known_forces, or use rotors='armature'."
            )
        self.fields = [field for law in self.laws for field in law.fields] + ([INERTIA] if inertia else [])
        mass = mass / np.maximum((self._transmission().numpy()[self.rows] ** 2).sum(1), 1e-12) if inertia else mass
        sizes = [
            f.size[2] * torque ** f.size[0] * velocity ** f.size[1] * (mass if f is INERTIA else 1.0)
            for f in self.fields
        ]
        self._sizes = np.array(sizes).reshape(len(self.fields), len(self.joints))
        self._logarithms = np.array([field.logarithm for field in self.fields], dtype=bool).reshape(-1, 1)

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return self._sizes.size

    @property
    def names(self) -> tuple[str, ...]:
        """Name of every coordinate's number: `viscous.JOINT`, ..., in the order of x."""
        return tuple(f"{field.name}.{joint}" for field in self.fields for joint in self.joints)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest coordinates."""
        limits = [np.log([f.lowest, f.highest]) if f.logarithm else (f.lowest, f.highest) for f in self.fields]
        each = np.repeat(np.array(limits).reshape(-1, 2), len(self.joints), axis=0)
        return each[:, 0], each[:, 1]

    @property
    def longest_steps(self) -> Float[np.ndarray, " k"]:
        """Most that a coordinate should change at once: infinite for those that the torque is linear in."""
        return (np.where(self._logarithms, 1.0, np.inf) * np.ones_like(self._sizes)).ravel()

    def start(self, unlisted: float = 1.0) -> Float[np.ndarray, " k"]:
        """Coordinates of what the system lists; of what it does not, `unlisted`, and typical velocities."""
        rows: list[np.ndarray] = []
        blocks = self.laws + ([Law(INERTIAS[self.inertia], (INERTIA,))] if self.inertia else [])
        for law in blocks:
            given = law.read(self._given[law.kind]) if law.kind in self._given else {}
            for field in law.fields:
                size = self._sizes[len(rows)]
                value = size if field.logarithm else unlisted * size
                value = given[field.name][self.rows] if field.name in given else value
                rows.append(np.log(value / size) if field.logarithm else value / size)
        return np.clip(np.array(rows).ravel(), *self.bounds)

    def prior(self) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """Mean and standard deviation of a weak prior: around what the system lists, else 0 or typical velocities."""
        spread = np.where(self._logarithms, 1.0, LINEAR_SPREAD) * np.ones_like(self._sizes)
        return self.start(unlisted=0.0), spread.ravel()

    def values(self, x: Float[np.ndarray, " k"]) -> Float[np.ndarray, "fields joints"]:
        """The numbers in SI units."""
        x = x.reshape(self._sizes.shape)
        return np.where(self._logarithms, np.exp(np.where(self._logarithms, x, 0.0)), x) * self._sizes

    def totals(self, x: Float[np.ndarray, " k"]) -> Float[np.ndarray, "fields joints"]:
        """`values`, rotor inertias with those that the robot has already."""
        values = self.values(x)
        if self.inertia == "armature":
            values[-1] += self.robot.armature.cpu().numpy()[self.rows]
        return values

    def slopes(self, x: Float[np.ndarray, " k"]) -> Float[np.ndarray, "fields joints"]:
        """Derivative of each number in its own coordinate."""
        return np.where(self._logarithms, self.values(x), self._sizes)

    def torque(
        self,
        x: Float[np.ndarray, " k"],
        v: Float[np.ndarray, "rows nv"],
        a: Float[np.ndarray, "rows nv"],
        load: Float[np.ndarray, "rows nv"],
    ) -> tuple[Float[np.ndarray, "rows nv"], Float[np.ndarray, "rows nv k"]]:
        """What the terms add to the torque at v and a under actuators of torque `load` = |u|, and derivatives in x."""
        values, slopes = self.values(x), self.slopes(x)
        total, joints = np.zeros_like(v), len(self.joints)
        jacobian = np.zeros((*v.shape, len(self.fields), joints))
        at_v, at_load = (torch.tensor(x[:, self.rows]) for x in (v, load))
        state = State(at_v, at_v, at_load, self.robot, self._rest)  # laws look at v and u alone
        for law, row, named in self._by_law(values):
            added, derivatives = law.torque(named, state)
            total[:, self.rows] += added
            for k, derivative in enumerate(derivatives, row):
                jacobian[:, self.rows, k, np.arange(joints)] = derivative * slopes[k]
        if self.inertia:
            moved = np.einsum("pij,nj->nip", self._inertia_basis(), a)
            total = total + moved @ values[-1]
            jacobian[:, :, -1] = moved * slopes[-1]
        return total, jacobian.reshape(*v.shape, -1)

    def added_inertia(self, x: Float[np.ndarray, " k"]) -> Float[np.ndarray, "nv nv"]:
        """What the rotors add to the mass matrix."""
        if not self.inertia:
            return np.zeros((self.robot.nv,) * 2)
        return np.tensordot(self.values(x)[-1], self._inertia_basis(), 1)

    def known_forces(self, x: Float[np.ndarray, " k"]) -> tuple[KnownForce, ...]:
        """The terms as known forces of a system."""
        values = torch.zeros(len(self.fields), self.robot.nv, dtype=torch.float64)
        values[self._logarithms[:, 0]] = 1.0  # scales of velocity must be positive, also where nothing has friction
        values[:, self.rows] = torch.tensor(self.values(x))
        forces = [law.force(named) for law, _, named in self._by_law(values)]
        if self.inertia == "armature":
            forces.append(Armature(values[-1]))
        elif self.inertia == "rotor":
            forces.append(RotorInertia(values[-1], self._transmission()))
        return tuple(forces)

    def _by_law(self, values: Any) -> Iterator[tuple[Law, int, dict[str, Any]]]:
        """Every law, the row of its first field, and its rows of `values` by the names of its fields."""
        row = 0
        for law in self.laws:
            yield law, row, {field.name: values[row + k] for k, field in enumerate(law.fields)}
            row += len(law.fields)

    def _transmission(self) -> torch.Tensor:
        if self.inertia == "armature":
            return torch.eye(self.robot.nv, dtype=torch.float64)
        rotors = self._given[RotorInertia]
        assert isinstance(rotors, RotorInertia), "known forces are kept by their class"
        return torch.as_tensor(rotors.transmission)

    def _inertia_basis(self) -> np.ndarray:
        """(rotor, nv, nv): inertia added per unit of each rotor's."""
        T = self._transmission().numpy()[self.rows]
        return T[:, :, None] * T[:, None, :]
