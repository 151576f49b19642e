"""`Payload`: the weight of something that the robot carries and the model does not contain."""

from dataclasses import dataclass

import torch
from gpytorch.kernels import Kernel
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, require_type
from forcegp.mechanics import ConstrainedDynamics, MechanicalSystem
from forcegp.priors.force_prior import ForcePrior, kernels_of
from forcegp.priors.tool_forces import require_moving
from forcegp.robots import Robot


@dataclass(frozen=True)
class Payload(ForcePrior):
    """Q_U = J_p^T m g + J_w^T sum_k (m c_k) R e_k x g: weight of an unknown mass m at c in the axes of link `frame`.

    J_p and J_w are the linear and angular Jacobians at the origin of `frame`, R its orientation. The four latents are
    constants: m (kg) and the first moments m c (kg m), normal about zero, so the posterior has mass and place with
    their covariance. It is the gravity of the load alone, which is what slow motions show. Its inertia adds to M and
    so acts on the acceleration itself, which no force over (q, v, u) does: learn the ten parameters of the link instead
    (`StructuredGP.identify`). With `moments=False` the load
    is a point mass at the origin of the frame.
    """

    frame: str
    moments: bool = True

    def __post_init__(self) -> None:
        if not isinstance(self.frame, str):
            raise InvalidInput(f"Payload frame is {self.frame!r}; give the name of the link that carries the load.")
        require_type("moments", self.moments, bool)

    @override
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        return ("mass", "moment-x", "moment-y", "moment-z") if self.moments else ("mass",)

    @override
    def check(self, system: MechanicalSystem) -> None:
        require_moving("Payload", self.frame, system.robot)
        if not bool(system.robot.gravity.any()):
            raise InvalidInput("Payload is a weight, but the robot's gravity is zero; leave it out or set gravity.")

    @override
    def mixing(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        kinematics = dynamics.state.kinematics
        gravity = kinematics.robot.gravity
        J = kinematics.frame_jacobian(self.frame)
        weight = (J[..., :3, :].mT @ gravity)[..., None]
        if not self.moments:
            return weight
        axes = kinematics.frame_pose(self.frame)[..., :3, :3]
        torques = torch.linalg.cross(axes, gravity[:, None].expand_as(axes), dim=-2)
        return torch.cat([weight, J[..., 3:, :].mT @ torques], dim=-1)

    @override
    def features(self, dynamics: ConstrainedDynamics) -> tuple[Float[Tensor, "*batch _"], ...]:
        nothing = dynamics.state.q[..., :0]  # constants depend on nothing
        return (nothing,) * (4 if self.moments else 1)

    @override
    def feature_names(self, robot: Robot) -> tuple[tuple[str, ...], ...]:
        return ((),) * len(self.latent_names(robot))

    @override
    def latent_units(self, robot: Robot) -> tuple[str, ...]:
        return ("kg", "kg m", "kg m", "kg m") if self.moments else ("kg",)

    @override
    def point_force(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch 3 C"]:
        gravity = dynamics.state.robot.gravity
        columns = torch.stack([gravity, *[torch.zeros_like(gravity)] * (3 if self.moments else 0)], dim=-1)
        return columns.expand(*dynamics.state.q.shape[:-1], *columns.shape)

    @override
    def kernels(self, robot: Robot, dimensions: tuple[int, ...], variances: Float[Tensor, " C"]) -> tuple[Kernel, ...]:
        return kernels_of("constant", dimensions, variances)
