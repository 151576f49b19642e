"""The numbers of a model that a fit estimates, as coordinates x of size 1: bodies, then coefficients of laws.

One unit is the typical size of a number in the log, or a factor of e on a log scale.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.linalg import block_diag
from torch import Tensor

from forcegp.errors import InvalidInput
from forcegp.evidence import bodies
from forcegp.evidence.least_squares import Rows
from forcegp.forces import Actuation, Body, Law, LogNormal, Normal, Parameter, Payload, RigidBodies
from forcegp.forces.joint_law import PerJointLaw
from forcegp.forces.registry import force_name
from forcegp.mechanics import State
from forcegp.model import Model
from forcegp.robots.inertia import physical_of_pseudo_inertia

LINEAR_SPREAD = 10.0
"""Standard deviation of the weak prior on numbers that are not logarithms, in their sizes: as large as the torques."""
SCALES = 1e-4  # half the relative error of a mass that was weighed: of scales, far below that of any log
FARTHEST = 25.0  # largest coordinate of a number that is estimated on a log scale about a median: a factor of 7e10


@dataclass(frozen=True, eq=False)
class Term:
    """One coefficient of a law: entries that are estimated, at `joints` (places in v; None: one number for all).

    value = size x, or size e^x with `logarithm`; a priori x has the mean `center` and the standard deviation `spread`.
    """

    law: int
    name: str
    joints: tuple[int, ...] | None
    size: Float[np.ndarray, " k"]
    start: Float[np.ndarray, " k"]
    center: Float[np.ndarray, " k"]
    spread: Float[np.ndarray, " k"]
    low: Float[np.ndarray, " k"]
    high: Float[np.ndarray, " k"]
    logarithm: bool

    def values(self, x: bodies.Coordinates) -> Float[np.ndarray, " k"]:
        """In SI units."""
        return self.size * (np.exp(x) if self.logarithm else x)

    def slopes(self, x: bodies.Coordinates) -> Float[np.ndarray, " k"]:
        """Derivatives of the values in x."""
        return self.values(x) if self.logarithm else self.size


@dataclass(frozen=True, eq=False)
class Carried:
    """A body to be estimated: that of the robot which moves with joint `body`, or a payload on `link`."""

    name: str
    body: int
    reference: Float[np.ndarray, "4 4"]
    """Pseudo-inertia where the search begins, in the frame of the body."""
    prior: Body
    payload: int | None = None
    """The number of the force, for a payload."""
    offset: Float[np.ndarray, "4 4"] | None = None
    """The pose of its link in the frame of the body."""
    weighed: bool = False
    """Whether its mass is known."""


class ParameterSpace:
    """The parameters of a model that are open: `Law.learned`, `RigidBodies.learn`, payloads without a mass.

    typical: sizes of "force", "position", "velocity" and "inertia" of each joint in the log, (nv,) each.
    """

    def __init__(self, model: Model, typical: Mapping[str, Float[np.ndarray, " nv"]]) -> None:
        self.model, self.typical = model, typical
        self.own = bodies.carrying(model.robot)
        self.carried = tuple(_carried(model))
        self.bodies = bodies.Bodies([each.reference for each in self.carried], [each.prior for each in self.carried])
        self.terms = tuple(_terms(model, typical))

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return self.bodies.size + sum(len(term.size) for term in self.terms)

    def split(self, x: bodies.Coordinates) -> tuple[np.ndarray, list[np.ndarray]]:
        """Coordinates of bodies, and of each term."""
        of_bodies, rest = x[: self.bodies.size], x[self.bodies.size :]
        return of_bodies, np.split(rest, np.cumsum([len(term.size) for term in self.terms])[:-1]) if self.terms else []

    @property
    def start(self) -> bodies.Coordinates:
        """Where the search begins."""
        return np.concatenate([np.zeros(self.bodies.size), *(term.start for term in self.terms)])

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest coordinates."""
        free = np.full(self.bodies.size, np.inf)
        least, most = (term.low for term in self.terms), (term.high for term in self.terms)
        return np.concatenate([-free, *least]), np.concatenate([free, *most])

    def longest_steps(self, x: bodies.Coordinates) -> bodies.Coordinates:
        """Most that a coordinate should change at once: infinite for those that the torque is linear in."""
        # what lies off the diagonal of a body's factor may double: a light one may be far away, or have its mass there
        each = [np.full_like(term.size, 1.0 if term.logarithm else np.inf) for term in self.terms]
        off = np.abs(x[: self.bodies.size].reshape(-1, 10)) * (np.arange(10) > 3)
        return np.concatenate([np.maximum(1.0, off).ravel(), *each])

    @property
    def steps(self) -> dict[str, Any]:
        """How a search may move, as options of `weighted_least_squares`."""
        return {"longest": self.longest_steps, "moved": self.moved}

    def prior(self, x: bodies.Coordinates) -> tuple[Float[np.ndarray, " entries"], Float[np.ndarray, "entries k"]]:
        """Distance from the prior in its standard deviations, and its Jacobian."""
        of_bodies, of_terms = self.split(x)
        distance, jacobian = self.bodies.distance(of_bodies)
        weighed = [10 * k for k, each in enumerate(self.carried) if each.weighed]  # log of the root of the mass
        distance = np.append(distance, of_bodies[weighed] / SCALES)
        jacobian = np.vstack([jacobian, np.eye(self.bodies.size)[weighed] / SCALES])
        values = [(own - term.center) / term.spread for own, term in zip(of_terms, self.terms, strict=True)]
        slopes = [1.0 / term.spread for term in self.terms]
        return np.concatenate([distance, *values]), block_diag(jacobian, np.diag(np.concatenate([[], *slopes])))

    def moved(self, x: bodies.Coordinates, step: bodies.Coordinates) -> bodies.Coordinates:
        """x + step to first order, along which parameters of bodies are straight (`Bodies.moved`)."""
        count = self.bodies.size
        return np.concatenate([self.bodies.moved(x[:count], step[:count]), x[count:] + step[count:]])

    # --- what the coordinates are

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Name, unit, start and prior of each of `numbers`: ten of a body, and every entry of a coefficient."""
        stated = np.concatenate([np.zeros(self.bodies.size), *(term.center for term in self.terms)])
        robot, starts, out = self.model.robot, iter(self.numbers(stated).tolist()), list[Parameter]()
        for each in self.carried:
            out += [
                Parameter(f"{each.name}.{name}", unit, next(starts), each.prior) for name, unit in bodies.QUANTITIES
            ]
        for term in self.terms:
            law = self.model.laws[term.law]
            label = coefficient_title(law, term.name)
            for k, joint in enumerate([None] if term.joints is None else [robot.joint_names[j] for j in term.joints]):
                unit = law.coefficients[term.name].unit if joint is None else law.unit(term.name, joint, robot)
                kind = LogNormal if term.logarithm else Normal
                center = term.values(term.center)[k]
                spread = term.spread[k] if term.logarithm else term.spread[k] * term.size[k]
                name = label if joint is None else f"{label}.{joint}"
                out.append(Parameter(name, unit, next(starts), kind(float(center), float(spread))))
        return tuple(out)

    def numbers(self, x: bodies.Coordinates) -> Float[np.ndarray, " n"]:
        """What people read: mass, center and inertia of bodies, then coefficients, in SI units; whole rotors."""
        of_bodies, of_terms = self.split(x)
        values = [self.bodies.numbers(of_bodies, self._frames)]
        for own, term in zip(of_terms, self.terms, strict=True):
            value = term.values(own)
            if type(self.model.laws[term.law]).__name__ == "Rotor":
                value = value + self.model.robot.armature.cpu().numpy()[list(term.joints or ())]
            values.append(value)
        return np.concatenate(values)

    def number_slopes(self, x: bodies.Coordinates) -> Float[np.ndarray, "n k"]:
        """Derivatives of the numbers in the coordinates."""
        of_bodies, of_terms = self.split(x)
        slopes = [term.slopes(own) for own, term in zip(of_terms, self.terms, strict=True)]
        return block_diag(self.bodies.number_slopes(of_bodies, self._frames), np.diag(np.concatenate([[], *slopes])))

    @cached_property
    def _frames(self) -> Float[np.ndarray, "n 4 4"]:
        """Poses, in the frame of the body, of the axes in which its numbers are told."""
        return np.array([np.eye(4) if x.offset is None else x.offset for x in self.carried]).reshape(-1, 4, 4)

    # --- what the model is at x

    def standard_parameters(self, x: bodies.Coordinates) -> Float[np.ndarray, "n 10"]:
        """Of the bodies that are estimated."""
        return self.bodies.parameters(x[: self.bodies.size])

    def values(self, x: bodies.Coordinates) -> dict[int, dict[str, Tensor]]:
        """Coefficients of the laws that are estimated, by number of the law."""
        out = {index: dict(named) for index, named in self._stated.items()}
        for own, term in zip(self.split(x)[1], self.terms, strict=True):
            named, value = out[term.law], torch.as_tensor(term.values(own), device=self.model.robot.device)
            if term.joints is None:
                named[term.name] = value[0]
            else:
                places = torch.tensor(term.joints, device=self.model.robot.device)
                named[term.name] = named[term.name].index_copy(0, places, value)
        return out

    @cached_property
    def _stated(self) -> dict[int, dict[str, Tensor]]:
        """The same before any is estimated; numbers of joints that are not stay."""
        out, robot = dict[int, dict[str, Tensor]](), self.model.robot
        for index, law in self._estimated.items():
            given, whole = law.values, isinstance(law, PerJointLaw)
            named = ((name, given[name].to(robot.device)) for name in law.coefficients)
            out[index] = {name: x.expand(robot.nv) if whole else x for name, x in named}
        return out

    def model_at(self, x: bodies.Coordinates) -> Model:
        """The model with the numbers of these coordinates, all of them known. Raises NonPhysicalInertia."""
        values, robot = self.values(x), self.model.robot
        pseudo, laws = self.bodies.pseudo_inertias(x[: self.bodies.size]), list[Any](self.model.laws)
        for index, named in values.items():
            laws[index] = laws[index].with_values(named)
        if wanted := {each.body: pseudo[k] for k, each in enumerate(self.carried) if each.payload is None}:
            robot = bodies.with_bodies(robot, wanted)
        for each, J in zip(self.carried, pseudo, strict=True):
            if each.payload is not None and each.offset is not None:
                there, law = np.linalg.inv(each.offset), laws[each.payload]
                mass, center, inertia = physical_of_pseudo_inertia(there @ J @ there.T)
                given = {"mass": float(mass), "center_of_mass": tuple(center), "inertia": tuple(map(tuple, inertia))}
                laws[each.payload] = replace(law, **given)
        closed = (replace(law, learn=()) if isinstance(law, RigidBodies) else law for law in laws)
        return replace(self.model, robot=robot, forces=(*closed, *self.model.unknown_forces))

    # --- what they do

    @property
    def under_load(self) -> Law | None:
        """The law that is estimated and depends on the torque of the actuators."""
        return next((law for law in self._estimated.values() if law.under_load), None)

    def torque(
        self, x: bodies.Coordinates, state: State, a: Rows, cache: dict[Any, Any], loads: State | None = None
    ) -> tuple[Float[np.ndarray, "loads rows nv"], Float[np.ndarray, "loads rows nv t"]]:
        """What the laws add to the torque of a motion, and the derivatives in their coordinates (without bodies).

        Of `loads` (2, rows, nv), laws under load see the first; after that comes what the second adds. `cache` holds
        features and directions of these states, which no coordinate changes.
        """
        total = np.zeros((1 if loads is None else 2, *a.shape))
        jacobian = np.zeros((*total.shape, self.size - self.bodies.size))
        values, of_terms, column = self.values(x), self.split(x)[1], 0
        for index, law in self._estimated.items():
            terms = [(own, term) for own, term in zip(of_terms, self.terms, strict=True) if term.law == index]
            if (basis := law.inertia_basis(self.model.robot)) is not None:
                if index not in cache or cache[index][0] is not a:
                    cache[index] = a, np.tensordot(a, basis.cpu().numpy(), (1, 2)).swapaxes(1, 2)
                moved, own = cache[index][1], values[index][next(iter(law.coefficients))].cpu().numpy()
                found = [(moved @ own, [moved[:, :, list(term.joints or ())] for _, term in terms])]
            else:
                if index not in cache:
                    seen = law.seen(loads if loads is not None and law.under_load else state)
                    cache[index] = law.features(seen), law.direction(state)
                found = _derivatives(law, values[index], [term for _, term in terms], *cache[index])
            for needed, each in zip(total, found, strict=False):
                needed += each[0]
            for place, (own, term) in enumerate(terms):
                places, width = list(term.joints or ()), len(term.size)
                for slopes, (_, each) in zip(jacobian, found, strict=False):
                    if each[place].ndim == 2:  # number j acts on joint j alone
                        slopes[:, places, range(column, column + width)] = each[place][:, places] * term.slopes(own)
                    else:
                        slopes[..., column : column + width] = each[place] * term.slopes(own)
                column += width
        return total, jacobian

    def delivered(self, x: bodies.Coordinates, state: State, known: Rows) -> Rows:
        """Torques of actuators, whose derivatives are minus those of `torque`; those `known` where no gain is free."""
        for index, law in self._estimated.items():
            if isinstance(law, Actuation):
                known = law.amplitude(law.features(state), self.values(x)[index]).cpu().numpy()
        return known

    @cached_property
    def _estimated(self) -> dict[int, Law]:
        return {index: self.model.laws[index] for index in dict.fromkeys(term.law for term in self.terms)}

    def added_inertia(self, x: bodies.Coordinates) -> Float[np.ndarray, "nv nv"]:
        """What the rotors that are estimated add to the mass matrix."""
        values, total = self.values(x), np.zeros((self.model.robot.nv,) * 2)
        for index, law in self._estimated.items():
            if (basis := law.inertia_basis(self.model.robot)) is not None:
                total += np.tensordot(values[index][next(iter(law.coefficients))].cpu().numpy(), basis.cpu().numpy(), 1)
        return total


def force_title(law: Law) -> str:
    """What parameters of a law are called by."""
    try:
        return law.called or force_name(law)
    except InvalidInput:
        return law.title


def coefficient_title(law: Law, name: str) -> str:
    """What parameters of a coefficient are called by, but for their joint."""
    return force_title(law) if len(law.coefficients) == 1 else f"{force_title(law)}.{name}"


def _derivatives(
    law: Law, values: Mapping[str, Tensor], terms: Sequence[Term], features: tuple[Tensor, ...], B: Tensor | None
) -> list[tuple[np.ndarray, list[np.ndarray]]]:
    """Minus the force (rows, nv), with slopes by entry (rows, nv, k), or (rows, nv); then what another load adds."""
    rows, wanted = features[0].shape[:-1], {term.name for term in terms}
    numbers = {name: x.expand(*rows, *x.shape).clone().requires_grad_(name in wanted) for name, x in values.items()}
    found = []
    with torch.enable_grad():
        # a number that all directions share has no last dimension to broadcast along
        given = {name: value[..., None] if value.dim() == len(rows) else value for name, value in numbers.items()}
        needed = -law.amplitude(features, given)
        parts = [needed[0], needed[1] - needed[0]] if needed.dim() > len(rows) + 1 else [needed]
        for part in parts:
            if terms[0].joints is not None:  # amplitude j depends on entries j alone
                own = [numbers[term.name] for term in terms]
                each = torch.autograd.grad(part.sum(), own, retain_graph=True, materialize_grads=True)
                if B is not None:
                    each = [x.diag_embed()[..., list(term.joints or ())] for x, term in zip(each, terms, strict=True)]
            else:
                each, totals = [], part.flatten(0, -2).sum(0)
                for term in terms:
                    own = [torch.autograd.grad(total, numbers[term.name], retain_graph=True)[0] for total in totals]
                    each.append(torch.stack(own, dim=-1)[..., None])
            force = part.detach() if B is None else (B @ part.detach()[..., None])[..., 0]
            found.append((force.cpu().numpy(), [(x if B is None else B @ x).cpu().numpy() for x in each]))
    return found


def _terms(model: Model, typical: Mapping[str, np.ndarray]) -> list[Term]:
    robot, out = model.robot, []
    singles = np.flatnonzero(np.isin(robot.joint_names, robot.single_joint_names))
    for index, law in enumerate(model.laws):
        sizes = typical
        if law.transmission is not None:  # those at its motors
            T = np.asarray(torch.as_tensor(law.transmission).cpu())
            force, inertia = abs(np.linalg.inv(T)).T @ typical["force"], typical["inertia"] / (T**2).sum(1)
            sizes = {name: abs(T) @ typical[name] for name in ("position", "velocity")}
            sizes |= {"force": force, "inertia": inertia}
        for name in law.learned:
            coefficient, given, per_joint = law.coefficients[name], getattr(law, name), isinstance(law, PerJointLaw)
            joints = singles if per_joint else np.zeros(1, dtype=int)
            size = coefficient.size(sizes)[joints]

            def of(value: Any, joints: np.ndarray = joints, per_joint: bool = per_joint) -> np.ndarray:
                array = np.asarray(torch.as_tensor(value).detach().cpu(), dtype=np.float64)
                return (np.broadcast_to(array, (robot.nv,))[joints] if per_joint else array.reshape(1)).copy()

            logarithm = coefficient.logarithm or isinstance(given, LogNormal)
            low, high = np.full_like(size, coefficient.lowest), np.full_like(size, coefficient.highest)
            if logarithm:
                spread, start = np.ones_like(size), np.zeros_like(size)
                low, high = (np.log(np.maximum(x, 1e-300)) for x in (low, high))
                if not coefficient.logarithm:
                    low, high = np.full_like(size, -FARTHEST), np.full_like(size, FARTHEST)
                if isinstance(given, LogNormal):
                    size = size if coefficient.logarithm else of(given.median)
                    start, spread = np.log(of(given.median) / size), of(given.spread)
                elif isinstance(given, Normal):
                    start = np.log(of(given.mean) / size)
                    spread = spread if given.std is None else of(given.std) / of(given.mean)
                center = start
            else:
                low, high = low / size, high / size
                center, spread = np.zeros_like(size), np.full_like(size, LINEAR_SPREAD)
                start = of(coefficient.default) / size if coefficient.default else np.ones_like(size)
                if isinstance(given, Normal):
                    center = start = of(given.mean) / size
                    std = of(np.nan if given.std is None else given.std) / size
                    spread = np.where(np.isnan(std), spread, std)
            open_ = (spread > 0.0) & (law.acts_on(name, robot)[joints] if per_joint else True)
            start = np.clip(start, low, high)
            size, start, center, spread, low, high = (x[open_] for x in (size, start, center, spread, low, high))
            places = tuple(joints[open_].tolist()) if per_joint else None
            if open_.any():
                out.append(Term(index, name, places, size, start, center, spread, low, high, logarithm))
    return out


def _carried(model: Model) -> list[Carried]:
    robot, layout = model.robot, model.robot.layout
    own, out = bodies.carrying(robot), []
    named = dict(zip(own, bodies.body_names(robot), strict=True))
    for index, law in enumerate(model.laws):
        if isinstance(law, RigidBodies):
            references = dict(zip(own, bodies.body_pseudo_inertias(robot).cpu().numpy(), strict=True))
            for body, prior in law.bodies(own, robot).items():
                if body not in references:
                    raise InvalidInput(f"the body of joint {layout.bodies[body].name!r} has no mass; give it one.")
                out.append(Carried(named[body], body, references[body], prior))
        elif isinstance(law, Payload) and not law.known:
            assert law.link is not None, "its link is chosen before"
            body = layout.links[law.link].body
            offset = np.linalg.inv(layout.child_frames[body]) @ layout.links[law.link].offset
            titles = [isinstance(x, Payload) and not x.known for x in model.laws]
            name = "payload" if sum(titles) == 1 else f"payload.{law.link}"
            out.append(Carried(name, body, law.usual(offset), law.prior, index, offset, law.mass is not None))
    return out
