"""An unknown force that forcegp does not bring, in one file: the drag of a link that moves through air or water."""

from dataclasses import dataclass

import torch

from forcegp.forces import FORCES, Unknown, kernel_of


@dataclass(frozen=True)
class AirDrag(Unknown):
    """Q_U = -J_p^T |p'| p' c(|p'|): drag at the origin p of link `frame`, its coefficient c a function of the speed."""

    frame: str
    kernel: str = "constant + squared-exponential"

    def latent_names(self, robot):
        return ("drag",)

    def direction(self, dynamics):
        jacobian, velocity, speed = self._motion(dynamics)
        return -jacobian.mT @ (speed * velocity)[..., None]

    def features(self, dynamics):
        return (self._motion(dynamics)[2],)

    def kernels(self, robot, dimensions, variances):
        return tuple(kernel_of(self.kernel, d, s) for d, s in zip(dimensions, variances, strict=True))

    # The rest is optional: how features are prepared, names and units for messages and plots, the force in space.

    def scalings(self, robot):
        return ("scale",)

    def feature_names(self, robot):
        return ((f"speed of {self.frame} [m/s]",),)

    def latent_units(self, robot):
        return ("N s^2/m^2",)

    def point_force(self, dynamics):
        _, velocity, speed = self._motion(dynamics)
        return -(speed * velocity)[..., None]

    def _motion(self, dynamics):
        jacobian = dynamics.state.kinematics.frame_jacobian(self.frame)[..., :3, :]
        velocity = (jacobian @ dynamics.state.v[..., None])[..., 0]
        return jacobian, velocity, torch.linalg.vector_norm(velocity, dim=-1, keepdim=True)


FORCES["air-drag"] = AirDrag
