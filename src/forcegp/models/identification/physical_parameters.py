"""Physical parameters as unconstrained numbers: inertias of links and coefficients of known forces, to be estimated.

Every parameter has a scaled form s with s = 0 at its start value:

    mass m = m0 e^s,   centre of mass c = c0 + r s with the link's radius of gyration r,   coefficient k = k0 e^s,
    inertia about the centre of mass: its second moments are m0 V V^T with V upper triangular,
    log V_ii = log V0_ii + s and V_ij = V0_ij + (row i of V0's length) s.

V does not depend on the mass, so a link whose inertia is not learned keeps it about its centre of mass whatever mass
and centre become. In the log-Cholesky parameters of Rucker & Wensing (2022), whose factor carries e^alpha, that reads
alpha = alpha0 + s/2, d_i = log V_ii + alpha0 - alpha and s_ij = V_ij e^(alpha0 - alpha). Every s gives a body that can
exist. The search moves z with s = T z; T makes its steps comparable (`structured.physical_start`).
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput, NumericalError, UnknownJoint, require_known, usable_arguments
from forcegp.mechanics import MechanicalSystem
from forcegp.robots import LinkInertia, physical_from_parameters

PHYSICAL = "physical"
"""Name of the free parameters z among those of the search."""

INERTIALS, COEFFICIENTS = "inertials.", "coefficients."
"""How the names of physical parameters begin, before that of the link or of the known force."""

ALPHA, DIAGONAL, OFF_DIAGONAL, CENTER = 0, slice(1, 4), slice(4, 7), slice(7, 10)
ROW_OF_OFF_DIAGONAL = (0, 1, 0)  # s12, s23, s13
FARTHEST = 25.0
"""Largest scaled parameter: a factor of 7e10 on a mass or coefficient, 25 radii of gyration for a centre of mass."""

SIZES = {"mass": 1, "com": 3, "inertia": 6}
MOMENTS = {"xx": (0, 0), "xy": (0, 1), "xz": (0, 2), "yy": (1, 1), "yz": (1, 2), "zz": (2, 2)}
COEFFICIENT_UNITS = {
    "viscous-joint-friction": ("Nms/rad", "Ns/m"),
    "coulomb-joint-friction": ("Nm", "N"),
    "load-joint-friction": ("1", "1"),
    "armature": ("kg m^2", "kg"),
    "rotor-inertia": ("kg m^2", "kg"),
}
"""For revolute and for prismatic joints."""


@dataclass(frozen=True)
class Coefficients:
    """Coefficients of a known force, to be estimated on a log scale: positive by construction.

    Parameters
    ----------
    force: one of `COEFFICIENT_UNITS`, for instance 'viscous-joint-friction', which the system must list once.
    joints: names of the joints whose coefficient is learned; None means all of one degree of freedom. The others keep
        theirs.
    start: start value in the force's unit; None takes the system's own, which must be positive.
    """

    force: str
    joints: tuple[str, ...] | None = None
    start: float | None = None

    @usable_arguments("Coefficients")
    def __post_init__(self) -> None:
        if self.joints is not None:
            object.__setattr__(self, "joints", (self.joints,) if isinstance(self.joints, str) else tuple(self.joints))
            if not self.joints or len(set(self.joints)) < len(self.joints):
                raise InvalidInput(f"joints is {self.joints!r}; name one or more joints, each once, or None for all")
        if self.start is not None and not (isinstance(self.start, int | float) and 0.0 < self.start < float("inf")):
            raise InvalidInput(f"start is {self.start!r}; give a positive, finite number: coefficients are logarithms")


Learned = LinkInertia | Coefficients


@dataclass(frozen=True, eq=False)
class _Link:
    """The chosen parts of one link."""

    link: str
    parts: tuple[str, ...]
    start: Float[Tensor, "10"]

    @property
    def names(self) -> list[tuple[str, str]]:
        named = {
            "mass": [("mass", "kg")],
            "com": [(f"com.{axis}", "m") for axis in "xyz"],
            "inertia": [(f"inertia.{axes}", "kg m^2") for axes in MOMENTS],
        }
        return [(f"{self.link}.{name}", unit) for part in self.parts for name, unit in named[part]]

    @property
    def scaled_names(self) -> list[str]:
        named = {
            "mass": ["log {}.mass"],
            "com": ["{}.com.x/r", "{}.com.y/r", "{}.com.z/r"],
            "inertia": [f"log {{}}.extent.{x}" for x in "xyz"] + [f"{{}}.shear.{xy}" for xy in ("xy", "yz", "xz")],
        }
        return [name.format(self.link) for part in self.parts for name in named[part]]

    def tensors(self, s: Float[Tensor, "k"]) -> dict[str, Tensor]:
        """`inertials.<link>` (10,)."""
        pieces = dict(zip(self.parts, s.split([SIZES[part] for part in self.parts]), strict=True))
        logs, off_diagonal, center = self.start[DIAGONAL], self.start[OFF_DIAGONAL], self.start[CENTER]
        lengths = _row_lengths(logs, off_diagonal)
        rise = 0.5 * pieces["mass"] if "mass" in pieces else s.new_zeros(1)
        if "com" in pieces:
            center = center + torch.linalg.vector_norm(lengths) * pieces["com"]
        if "inertia" in pieces:
            logs = logs + pieces["inertia"][:3]
            off_diagonal = off_diagonal + lengths[list(ROW_OF_OFF_DIAGONAL)] * pieces["inertia"][3:]
        alpha = self.start[ALPHA] + rise
        return {INERTIALS + self.link: torch.cat([alpha, logs - rise, off_diagonal * (-rise).exp(), center])}

    def values(self, s: Float[Tensor, "k"]) -> Float[Tensor, "k"]:
        """In SI units, in the order of `names`."""
        mass, center, inertia = physical_from_parameters(self.tensors(s)[INERTIALS + self.link])
        each = {"mass": mass[None], "com": center, "inertia": torch.stack([inertia[at] for at in MOMENTS.values()])}
        return torch.cat([each[part] for part in self.parts])


@dataclass(frozen=True, eq=False)
class _Coefficients:
    """Coefficients of some joints of one known force."""

    force: str
    joints: tuple[str, ...]
    chosen: Tensor  # positions of those joints
    start: Float[Tensor, "nv"]  # of all joints
    units: tuple[str, ...]

    @property
    def names(self) -> list[tuple[str, str]]:
        return [(f"{self.force}.{joint}", unit) for joint, unit in zip(self.joints, self.units, strict=True)]

    @property
    def scaled_names(self) -> list[str]:
        return [f"log {self.force}.{joint}" for joint in self.joints]

    def tensors(self, s: Float[Tensor, "k"]) -> dict[str, Tensor]:
        """`coefficients.<force>` (nv,)."""
        return {COEFFICIENTS + self.force: self.start.index_copy(0, self.chosen, self.values(s))}

    def values(self, s: Float[Tensor, "k"]) -> Float[Tensor, "k"]:
        """In SI units, in the order of `names`."""
        return self.start[self.chosen] * s.exp()


@dataclass(frozen=True, eq=False)
class PhysicalParameters:
    """What is learned of a system, as a function of free numbers z (k,), 0 at the start values; s = `transform` z.

    `names` such as 'tool.mass', 'tool.com.x' or 'viscous-joint-friction.A1' and `units` have the order of `values(z)`.
    """

    system: MechanicalSystem
    groups: tuple[_Link | _Coefficients, ...]
    transform: Float[Tensor, "k k"]

    @classmethod
    def of(cls, system: MechanicalSystem, learn: Learned | Iterable[Learned]) -> "PhysicalParameters":
        """The parameters that `learn` names, from the values that the system has, scaled but not yet whitened.

        Raises InvalidInput, UnknownLink or UnknownJoint for what the system does not have, or has twice, and
        NonPhysicalInertia for bodies without thickness, whose parameters are infinite.
        """
        chosen = (learn,) if isinstance(learn, Learned) else tuple(learn)
        if not chosen or not all(isinstance(entry, Learned) for entry in chosen):
            raise InvalidInput(
                f"learn is {learn!r}; give robot.link(NAME).inertial('mass', 'com'), Coefficients(NAME), or several"
            )
        groups = (*_link_groups(system, chosen), *(_coefficients(system, c) for c in chosen if type(c) is Coefficients))
        names = [name for group in groups for name, _ in group.names]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise InvalidInput(f"{twice} is named twice in learn; name it once")
        identity = torch.eye(len(names), dtype=torch.float64, device=system.robot.device)
        return cls(system, groups, identity)

    @property
    def names(self) -> tuple[str, ...]:
        """One per number."""
        return tuple(name for group in self.groups for name, _ in group.names)

    @property
    def units(self) -> tuple[str, ...]:
        """SI units in the order of `names`."""
        return tuple(unit for group in self.groups for _, unit in group.names)

    @property
    def scaled_names(self) -> tuple[str, ...]:
        """What each number of s is: 'log tool.mass', 'tool.com.x/r' (r: radius of gyration), 'log tool.extent.x'."""
        return tuple(name for group in self.groups for name in group.scaled_names)

    @property
    def zero(self) -> Float[Tensor, "k"]:
        """z at the start values."""
        return self.transform.new_zeros(len(self.transform))

    def _split(self, z: Float[Tensor, "k"]) -> Iterable[tuple[_Link | _Coefficients, Tensor]]:
        return zip(self.groups, (self.transform @ z).split([len(group.names) for group in self.groups]), strict=True)

    def tensors(self, z: Float[Tensor, "k"]) -> dict[str, Tensor]:
        """The parameters that `MarginalLikelihood` understands, differentiable in z.

        Coefficients of one force that are learned in several groups are joined. Raises NumericalError for values beyond
        `FARTHEST`, so that a search turns back: data that do not inform a parameter let it run away.
        """
        farthest = float((self.transform @ z).detach().abs().amax()) if len(z) else 0.0
        if not farthest <= FARTHEST:
            raise NumericalError(
                f"a physical parameter is a factor of e^{farthest:.3g} (or radii of gyration) from its start"
            )
        out: dict[str, Tensor] = {}
        for group, s in self._split(z):
            for name, value in group.tensors(s).items():
                if name in out and isinstance(group, _Coefficients):
                    value = out[name].index_copy(0, group.chosen, value[group.chosen])
                out[name] = value
        return out

    def values(self, z: Float[Tensor, "k"]) -> Float[Tensor, "k"]:
        """Physical values in SI units, in the order of `names`, differentiable in z."""
        return torch.cat([group.values(s) for group, s in self._split(z)])

    def named(self, z: Float[Tensor, "k"]) -> dict[str, float]:
        """Physical values by name."""
        return dict(zip(self.names, self.values(z.detach()).tolist(), strict=True))

    def system_at(self, z: Float[Tensor, "k"]) -> MechanicalSystem:
        """The system whose URDF and known forces carry the values at z."""
        tensors = {name: value.detach() for name, value in self.tensors(z.detach()).items()}
        inertials, forces = inertials_of(tensors), coefficients_of(tensors)
        return self.system.with_robot(self.system.robot.with_inertials(inertials)).with_coefficients(forces)


def _link_groups(system: MechanicalSystem, chosen: Sequence[Learned]) -> list[_Link]:
    """One group per link, its parts in the order mass, com, inertia."""
    parts: dict[str, list[str]] = {}
    for entry in chosen:
        if isinstance(entry, LinkInertia):
            parts.setdefault(entry.link, []).extend(entry.parts)
    for link, named in parts.items():
        twice = next((part for part in named if named.count(part) > 1), None)
        if twice is not None:
            raise InvalidInput(f"the {twice} of {link!r} is named twice in learn; name it once")
    start = system.robot.inertial_parameters(*parts)
    return [_Link(link, tuple(part for part in SIZES if part in parts[link]), start[link]) for link in parts]


def _coefficients(system: MechanicalSystem, entry: Coefficients) -> _Coefficients:
    robot = system.robot
    force = system.known_forces[system.force_index(entry.force)]
    joints = robot.single_joint_names if entry.joints is None else entry.joints
    for joint in joints:
        require_known("joint", joint, robot.name, robot.joint_names, UnknownJoint)
    chosen = torch.tensor([robot.joint_names.index(joint) for joint in joints], device=robot.device)
    values = getattr(force, str(force.learned)).detach().clone()
    if entry.start is not None:
        values[chosen] = entry.start
    none = [joint for joint, value in zip(joints, values[chosen].tolist(), strict=True) if not value > 0.0]
    if none:
        raise InvalidInput(
            f"{entry.force} is 0 for {', '.join(none)}, and the logarithm of a coefficient starts from a positive "
            f"value; give one, as in Coefficients({entry.force!r}, start=0.1), or name other joints"
        )
    kinds = [robot.joint(joint).type == "prismatic" for joint in joints]
    units = tuple(COEFFICIENT_UNITS[entry.force][prismatic] for prismatic in kinds)
    return _Coefficients(entry.force, tuple(joints), chosen, values, units)


def _row_lengths(logs: Float[Tensor, "3"], off_diagonal: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Lengths of the rows of V: root mean squares of the mass about the centre along x, y and z, in m."""
    s12, s23, s13 = off_diagonal.unbind(-1)
    zero = torch.zeros_like(s12)
    rows = torch.stack([torch.stack([s12, s13]), torch.stack([s23, zero]), torch.stack([zero, zero])])
    return (logs.exp().square() + rows.square().sum(-1)).sqrt()


def learn_to_list(physical: PhysicalParameters) -> list[Mapping[str, object]]:
    """What was learned, as plain JSON values."""
    return [
        {"link": group.link, "parts": list(group.parts)}
        if isinstance(group, _Link)
        else {"force": group.force, "joints": list(group.joints)}
        for group in physical.groups
    ]


def inertials_of(parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Link name -> log-Cholesky parameters, from the entries `inertials.<link>`."""
    return {name[len(INERTIALS) :]: value for name, value in parameters.items() if name.startswith(INERTIALS)}


def coefficients_of(parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Known force -> coefficients (nv,), from the entries `coefficients.<known force>`."""
    return {name[len(COEFFICIENTS) :]: value for name, value in parameters.items() if name.startswith(COEFFICIENTS)}
