"""`Noise`: of measured accelerations, of forces, and of sensors."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput, require_type, usable_arguments

ACCELERATION = "noise.log_acceleration"
FORCE = "noise.log_force"
SENSOR, PUSHES = "noise.log_sensor", "noise.log_pushes"
STATED = SENSOR, PUSHES  # what no search changes


@dataclass(frozen=True)
class Noise:
    """Standard deviations: `acceleration` in rad/s^2 or m/s^2, `force` in Nm or N (None: no force-level noise).

    Each is one number or one per joint; `sensor` is one number or one per column of force sensors [N] and IMUs [m/s^2].
    `pushes` are those of forces on joints that something pushes which nobody measured, one per joint. None for
    `acceleration` takes what the dataset states. With `learn` they are start values of the optimisation, else they stay
    fixed; the hyperprior of a learned one is log-normal around its start value, with a factor of e as one standard
    deviation. `sensor` and `pushes` stay.
    The covariance of one row is diag(acceleration^2) + H diag(force^2 + pushes^2) H^T.
    """

    acceleration: float | tuple[float, ...] | None = 0.1
    force: float | tuple[float, ...] | None = None
    learn: bool = False
    sensor: float | tuple[float, ...] | None = None
    pushes: tuple[float, ...] | None = None

    @usable_arguments("Noise")
    def __post_init__(self) -> None:
        require_type("learn", self.learn, bool)
        for name in ("acceleration", "force", "sensor", "pushes"):
            if getattr(self, name) is not None:
                given = getattr(self, name)
                message = f"Noise {name} is {given!r}; give a positive, finite standard deviation, or one per joint."
                try:
                    values = torch.as_tensor(given, dtype=torch.float64)
                except (TypeError, ValueError, RuntimeError):
                    raise InvalidInput(message) from None
                if values.dim() > 1 or not values.numel() or not bool(((values > 0) & torch.isfinite(values)).all()):
                    raise InvalidInput(message)
                object.__setattr__(self, name, tuple(values.tolist()) if values.dim() else float(values))

    def parameters(self, nv: int, device: torch.device | None = None) -> dict[str, Float[Tensor, "nv"]]:
        """Logarithms of deviations by joint. InvalidInput for a wrong number, and where only a dataset has it."""
        if self.acceleration is None:
            raise InvalidInput("Noise(None) takes noise of accelerations from the dataset of a fit; give a number.")
        named = {ACCELERATION: self.acceleration, FORCE: self.force, PUSHES: self.pushes}
        named, out = {name: value for name, value in named.items() if value is not None}, {}
        for name, value in named.items():
            values = torch.as_tensor(value, dtype=torch.float64, device=device)
            if values.dim() and len(values) != nv:
                raise InvalidInput(f"Noise has {len(values)} values for {nv} joints; give one number or one per joint.")
            out[name] = values.expand(nv).log()
        if self.sensor is not None:
            out[SENSOR] = torch.as_tensor(self.sensor, dtype=torch.float64, device=device).reshape(-1).log()
        return out

    @staticmethod
    def covariance(
        parameters: Mapping[str, Tensor], H: Float[Tensor, "*batch D nv"]
    ) -> Float[Tensor, "1 D"] | Float[Tensor, "N D D"]:
        """Variances (1, D) of all rows, or their covariances (N, D, D) when there is force-level noise.

        The D entries are nv accelerations and what sensors measure beside them; H is what joint forces make of them.
        """
        acceleration = (2.0 * parameters[ACCELERATION]).exp()[None]
        if (sensed := H.shape[-2] - acceleration.shape[-1]) > 0:
            acceleration = torch.cat([acceleration, (2.0 * parameters[SENSOR]).exp()[None].expand(1, sensed)], dim=-1)
        if not (forces := [(2.0 * parameters[name]).exp() for name in (FORCE, PUSHES) if name in parameters]):
            return acceleration
        return torch.diag_embed(acceleration) + (H * torch.stack(forces).sum(0)) @ H.mT

    def log_prior(self, parameters: Mapping[str, Tensor]) -> Float[Tensor, ""]:
        """Log density (up to a constant) of the noise among `parameters` under its hyperprior; 0 where it is fixed.

        Without it, maximum likelihood lets flexible kernels explain the noise of a joint away: measured on a 3-joint
        arm with 60 points, one of three standard deviations collapsed from 0.05 to 1e-4.
        """
        if not (learned := [name for name in (ACCELERATION, FORCE) if name in parameters]):
            return torch.zeros((), dtype=torch.float64)
        level = parameters[learned[0]]
        starts = self.parameters(len(level), level.device)
        return -0.5 * torch.stack([(parameters[name] - starts[name]).square().sum() for name in learned]).sum()

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> "Noise":
        """The noise that `to_dict` stored."""
        given: dict[str, Any] = {name: tuple(x) if isinstance(x, list) else x for name, x in stored.items()}
        return cls(**given)
