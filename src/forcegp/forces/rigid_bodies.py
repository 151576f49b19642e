"""`RigidBodies`: gravity, Coriolis and centrifugal forces; and `Payload`, a body that the robot carries."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, usable_arguments
from forcegp.forces.force import Body, Law
from forcegp.mechanics.gauss_principle import State
from forcegp.robots import Robot
from forcegp.robots.inertia import physical_of_pseudo_inertia, pseudo_inertia
from forcegp.robots.urdf_file import replace_inertial


class WholeLaw(Law):
    """A law that is no sum of amplitudes: `force_at` is its force, none unless a subclass has one."""

    @override
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Tensor:
        raise NotImplementedError(f"{self.title} is no sum of amplitudes: `force_at` is its force")

    @override
    def force_at(self, state: State, values: Mapping[str, Tensor]) -> Tensor:
        return torch.zeros_like(state.v)


@dataclass(frozen=True, eq=False)
class RigidBodies(WholeLaw):
    """Coriolis, centrifugal and gravity forces of the robot's bodies, -bias(q, v); their inertia is the mass matrix.

    learn: which bodies a fit estimates, from those of the robot's file: "all" bodies that move, or by name of a link:
        (link, ...), or {link: Body(strength)}. A body is what one joint moves as one; any link of it names it.
    """

    learn: Literal["all"] | Sequence[str] | Mapping[str, Body] = ()

    @override
    def force_at(self, state: State, values: Mapping[str, Tensor]) -> Tensor:
        return -state.bias

    @override
    def bound_to(self, robot: Robot) -> "RigidBodies":
        given = self.learn
        if isinstance(given, str):
            if given != "all":
                raise InvalidInput(f"RigidBodies learn is {given!r}; give 'all', or names of links in a list.")
            return self
        bodies = given if isinstance(given, Mapping) else dict.fromkeys(given, Body())
        for link, body in bodies.items():
            if robot.frame(link)[0] < 0:
                raise InvalidInput(f"link {link!r} does not move, so nothing on it shows; give a moving one.")
            if not isinstance(body, Body):
                raise InvalidInput(f"RigidBodies learn {link!r} is {body!r}; give Body(strength).")
        return replace(self, learn=dict(bodies))

    def bodies(self, carrying: Sequence[int], robot: Robot) -> dict[int, Body]:
        """The bodies to be estimated, of those with mass, by their number."""
        if self.learn == "all":
            return dict.fromkeys(carrying, Body())
        assert isinstance(self.learn, Mapping), "it is bound"
        return {robot.layout.links[link].body: body for link, body in self.learn.items()}


USUAL = 0.5, 0.05  # mass in kg and size in m of the payload at which a search begins
WEAK = 0.01  # weight of the prior on a payload: a factor of e in its mass costs 0.02 nats


@dataclass(frozen=True, eq=False)
class Payload(WholeLaw):
    """A body that the robot carries on `link`: its weight, and what its inertia adds to the robot's.

    link: None stands for the base that moves, else for the last link of the last joint.
    mass [kg], center_of_mass [m] in the axes of the link, and inertia [kg m^2] (3, 3) about the centre of mass and
        along these axes; without a mass, `forcegp.fit` estimates all ten numbers, without a centre all but it.
    """

    link: str | None = None
    mass: float | None = None
    center_of_mass: Sequence[float] | None = (0.0, 0.0, 0.0)
    inertia: Sequence[Sequence[float]] | None = None
    prior: ClassVar[Body] = Body(WEAK)

    @usable_arguments("Payload")
    def __post_init__(self) -> None:
        if self.link is None and self.known:
            raise InvalidInput(f"Payload has a mass of {self.mass} kg and no link; name the link that carries it.")
        if self.mass is not None and not 0.0 < self.mass < np.inf:
            raise InvalidInput(f"Payload mass is {self.mass!r}; give a positive one in kg, or None to have it found.")
        if self.center_of_mass is None:
            return
        center = np.array(self.center_of_mass, dtype=np.float64)
        inertia = None if self.inertia is None else np.array(self.inertia, dtype=np.float64)
        if center.shape != (3,) or (inertia is not None and inertia.shape != (3, 3)):
            raise InvalidInput("Payload has a centre of mass of three numbers, and an inertia of three rows of three.")
        if not np.isfinite(center).all() or not (inertia is None or np.isfinite(inertia).all()):
            raise InvalidInput("Payload has numbers that are not finite; give others.")
        object.__setattr__(self, "center_of_mass", tuple(center.tolist()))
        object.__setattr__(self, "inertia", None if inertia is None else tuple(map(tuple, inertia.tolist())))

    @property
    def known(self) -> bool:
        """Whether its numbers are given."""
        return self.mass is not None and self.center_of_mass is not None

    @property
    def pseudo_inertia(self) -> Float[np.ndarray, "4 4"]:
        """In the axes of the link, of a payload that is known."""
        assert self.mass is not None, "it is known"
        assert self.center_of_mass is not None, "it is known"
        inertia = np.zeros((3, 3)) if self.inertia is None else np.array(self.inertia)
        return pseudo_inertia(self.mass, np.array(self.center_of_mass), inertia)

    @override
    def bound_to(self, robot: Robot) -> "Payload":
        if self.link is not None and robot.frame(self.link)[0] < 0:
            raise InvalidInput(f"link {self.link!r} does not move, so nothing on it shows; give a moving one.")
        return self

    def usual(self, offset: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """Pseudo-inertia of a usual payload, of its mass if that is given, on a link with this pose in its body."""
        mass, size = USUAL
        mass = self.mass or mass
        return offset @ pseudo_inertia(mass, np.zeros(3), 0.4 * mass * size**2 * np.eye(3)) @ offset.T


def carrying(robot: Robot, payloads: Iterable[Payload]) -> Robot:
    """The robot whose links include the payloads that are known."""
    for payload in payloads:
        if payload.link is not None and payload.known:
            held = robot.link(payload.link)
            own = pseudo_inertia(held.mass, held.center_of_mass, held.inertia)
            parts = physical_of_pseudo_inertia(own + payload.pseudo_inertia)
            robot = robot.with_text(replace_inertial(robot.urdf_text, payload.link, *parts, source=robot.source))
    return robot
