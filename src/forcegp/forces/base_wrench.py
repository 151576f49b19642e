"""Unknown forces on a body that moves freely: `BaseWrench`, and `AerodynamicForce` of what air does to it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, usable_arguments
from forcegp.forces.joint_forces import as_names, chosen_inputs
from forcegp.forces.kernels import check_kernel
from forcegp.forces.thrusters import ObservedWind
from forcegp.forces.tool_forces import ToolPoint, finite_numbers, require_moving
from forcegp.forces.unknown import ExpressedKernels, Scaling
from forcegp.mechanics import ConstrainedDynamics, Contact, State
from forcegp.robots import Robot
from forcegp.robots.manifold import VELOCITIES

AXES = "xyz"
BASE_INPUTS = ("velocity", "drag", "rotor-drag", "angular-velocity", "thrust", "actuation", "height", "attitude")
FROM_ZERO = tuple(name for name in BASE_INPUTS if name not in ("height", "attitude"))  # scaled, never shifted


@dataclass(frozen=True)
class BaseWrench(ExpressedKernels):
    """Q_U = J^T E f(z): a force [N] and a torque [Nm] on a link, along the link's own axes E and about its origin.

    Parameters
    ----------
    frame: the link; None stands for the first that moves freely, the trunk or body of the robot.
    inputs: what the six functions depend on: "velocity" (linear, in the link's axes), "drag" (|velocity| velocity),
        "rotor-drag" (the root of the thrust, as the speed of rotors, times velocity), "angular-velocity", "actuation"
        (force and torque of all actuators on the free base) or "thrust" (those along z and about all axes), "height" of
        the link over z = 0, and "attitude" (the world's axes in those of the link, in which a constant force of the
        world is linear).
    kernel: an expression of `forcegp.forces.kernel_of`.
    """

    frame: str | None = None
    inputs: tuple[str, ...] = ("velocity", "angular-velocity", "attitude")
    kernel: str = "linear + squared-exponential"

    @usable_arguments("BaseWrench")
    def __post_init__(self) -> None:
        object.__setattr__(self, "inputs", chosen_inputs(type(self).__name__, as_names(self.inputs), BASE_INPUTS))
        check_kernel(self.kernel)
        if not (self.frame is None or isinstance(self.frame, str)):
            raise InvalidInput(f"{type(self).__name__} frame is {self.frame!r}; give the name of a link, or None.")

    @override
    def check(self, robot: Robot, contacts: Sequence[Contact]) -> None:
        require_moving(type(self).__name__, self.link(robot), robot)

    def link(self, robot: Robot) -> str:
        """The link that the force acts on. Raises InvalidInput where none is named and none moves freely."""
        if self.frame is not None:
            return self.frame
        if not robot.layout.groups:
            raise InvalidInput(
                f"{type(self).__name__} acts on a base that moves, and {robot.name} is fixed to the world; read it "
                "with base='floating', or name a link: frame=..."
            )
        body = robot.layout.groups[0].bodies.stop - 1
        return next(name for name in robot.link_names if robot.frame(name)[0] == body)

    @override
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        return tuple(f"{what}-{axis}" for what in ("force", "torque") for axis in AXES)

    @override
    def latent_units(self, robot: Robot) -> tuple[str, ...]:
        return ("N",) * 3 + ("Nm",) * 3

    @override
    def direction(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        where = self._point(dynamics)
        parts = where.jacobian[..., :3, :], where.jacobian[..., 3:, :]
        return torch.cat([part.mT @ where.orientation for part in parts], dim=-1)

    @override
    def point_force(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch 3 C"]:
        axes = self._point(dynamics).orientation
        return torch.cat([axes, torch.zeros_like(axes)], dim=-1)

    @override
    def features(self, dynamics: ConstrainedDynamics) -> tuple[Float[Tensor, "*batch _"], ...]:
        state, where = dynamics.state, self._point(dynamics)
        moving, turning = where.velocity(state.v).split(3, dim=-1)
        linear, angular = (
            (where.orientation.mT @ part[..., None])[..., 0] for part in (moving - self._flow(state), turning)
        )
        columns: dict[str, Callable[[], Tensor]] = {
            "velocity": lambda: linear,
            "drag": lambda: (linear.square().sum(-1, keepdim=True) + 1e-12).sqrt() * linear,
            "rotor-drag": lambda: _root_of_thrust(state) * linear,
            "angular-velocity": lambda: angular,
            "thrust": lambda: state.delivered[..., _base_rows(state.robot)][..., _thrust(state.robot)],
            "actuation": lambda: state.delivered[..., _base_rows(state.robot)],
            "height": lambda: where.position[..., 2:],
            "attitude": lambda: where.orientation.flatten(-2),
        }
        return (torch.cat([columns[name]() for name in self.inputs], dim=-1),) * 6

    @override
    def scalings(self, robot: Robot) -> tuple[tuple[Scaling, ...], ...]:
        labels = self._labels(robot)
        ways: tuple[Scaling, ...] = tuple(
            "scale" if name in FROM_ZERO else "standardize" for name in self.inputs for _ in labels[name]
        )
        return (ways,) * 6

    @override
    def feature_names(self, robot: Robot) -> tuple[tuple[str, ...], ...]:
        labels = self._labels(robot)
        return (tuple(label for name in self.inputs for label in labels[name]),) * 6

    def _flow(self, state: State) -> Tensor | float:
        """The velocity of what the link moves through, along the axes of the world."""
        return 0.0

    def _labels(self, robot: Robot) -> dict[str, Sequence[str]]:
        link, groups = self.link(robot), robot.layout.groups
        parts = VELOCITIES if groups else robot.joint_names
        pushes = [f"actuation along {part} [{'N' if part in AXES else 'Nm'}]" for part in parts]
        return {
            "velocity": [f"velocity of {link} along its {axis} [m/s]" for axis in AXES],
            "drag": [f"speed times velocity of {link} along its {axis} [m^2/s^2]" for axis in AXES],
            "rotor-drag": [f"root of thrust times velocity of {link} along its {axis} [N^1/2 m/s]" for axis in AXES],
            "angular-velocity": [f"angular velocity of {link} about its {axis} [rad/s]" for axis in AXES],
            "thrust": pushes[_thrust(robot)],
            "actuation": pushes,
            "height": [f"height of {link} [m]"],
            "attitude": [f"world {world} along {axis} of {link}" for world in AXES for axis in AXES],
        }

    def _point(self, dynamics: ConstrainedDynamics) -> ToolPoint:
        return ToolPoint.of(dynamics, self.link(dynamics.state.robot), (0.0, 0.0, 0.0))


@dataclass(frozen=True)
class AerodynamicForce(BaseWrench):
    """What air does to a body that flies: drag, changes of thrust with the flow and near the ground, and wind.

    The six functions of `BaseWrench` depend on velocity, by itself and times speed and rotor speed, rates, attitude,
    height and what the actuators deliver. So a linear kernel holds the usual laws (Faessler, Franchi & Scaramuzza, IEEE
    RA-L 2018) and a thrust that differs from the data sheet; "deviation" beside it is what they leave. Velocities are
    those against the air: the fit finds the wind of its rows (`forcegp.data.find_wind`), and where u has no columns of
    an `ObservedWind`, the air moves with `wind` [m/s, world], which the fit sets to the mean of its rows. `forcegp
    score` observes the wind of a recording, and the force that stays unexplained, from the rows
    before each (`forcegp.posterior.observing`). `observe` is the time in s that the observer of this force looks back;
    with None it follows the recording, and 0 observes nothing, neither here nor in the fit.
    """

    inputs: tuple[str, ...] = ("velocity", "drag", "rotor-drag", "angular-velocity", "thrust", "height", "attitude")
    kernel: str = "linear + deviation"
    observe: float | None = None
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @override
    def __post_init__(self) -> None:
        super().__post_init__()
        wind = finite_numbers(self.wind)
        if wind is None or len(wind) != 3:
            raise InvalidInput(f"AerodynamicForce wind is {self.wind!r}; give its velocity along x, y and z in m/s.")
        object.__setattr__(self, "wind", wind)
        if self.observe is None:
            return
        try:  # files and commands hold text
            seconds = float(self.observe)
        except (TypeError, ValueError):
            seconds = -1.0
        if not 0.0 <= seconds < 1e6:
            raise InvalidInput(f"AerodynamicForce observe is {self.observe!r}; give a time in s, 0, or None.")
        object.__setattr__(self, "observe", seconds)

    @override
    def _flow(self, state: State) -> Tensor | float:
        wind = ObservedWind.at(state)
        return state.v.new_tensor(self.wind) if wind is None else wind


def _base_rows(robot: Robot) -> slice:
    return robot.layout.groups[0].rows if robot.layout.groups else slice(0, robot.nv)


def _root_of_thrust(state: State) -> Float[Tensor, "*batch 1"]:
    """Of the force along z of a base that flies; of all that actuators deliver where there is none."""
    groups, push = state.robot.layout.groups, state.delivered[..., _base_rows(state.robot)]
    push = push[..., 2:3] if groups and groups[0].kind == "floating" else push
    return (push.square().sum(-1, keepdim=True) + 1e-4).sqrt().sqrt()  # smooth where rotors stand


def _thrust(robot: Robot) -> slice:
    """Which of the base rows thrusters that point up can drive; all where the base has no such rows."""
    return slice(2, None) if robot.layout.groups else slice(None)
