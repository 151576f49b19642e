"""What all controllers share: torques within limits, and never one that is not finite."""

from collections.abc import Callable, Mapping
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, NumericalError, require_known
from forcegp.robots import Robot
from forcegp.robots.arguments import finite_vector, real_tensor
from forcegp.summary import Summary

OnFailure = Literal["raise", "hold"]


class Controller(Summary):
    """Limits the torques of a call, and raises or holds the last ones where it cannot compute any.

    `saturated` (nv,) are the joints whose torque was limited in the last call, `held` counts the calls that repeated
    the torque `last` (nv,) of the call before, which is zero at first.
    """

    def __init__(self, robot: Robot, torque_limits: Any, on_failure: OnFailure) -> None:
        require_known("on_failure", on_failure, type(self).__name__, ("raise", "hold"))
        robot.require_vectors("controllers")
        self.robot, self.on_failure = robot, on_failure
        stated = [joint.effort_limit for joint in robot.joints]
        self.torque_limits = per_joint("torque_limits", stated if torque_limits is None else torque_limits, robot.nv)
        if not bool(self.torque_limits.any()):
            raise InvalidInput(
                "torque_limits are zero in every joint, so nothing can be controlled; give Nm or N"
                + (": the URDF states an effort of 0." if torque_limits is None else ".")
            )
        self.restart()

    def restart(self) -> None:
        """Forget earlier calls."""
        self.last = torch.zeros(self.robot.nv, dtype=torch.float64)
        self.saturated = torch.zeros(self.robot.nv, dtype=torch.bool)
        self.held = 0

    @override
    def facts(self) -> Mapping[str, object]:
        """The robot, and how often it had to hold."""
        return {"robot": self.robot.name, "on failure": self.on_failure, "held": self.held}

    def vectors(self, **given: Any) -> list[Tensor]:
        """The vectors (nv,) as tensors, called within `limited`.

        Raises InvalidInput for what is none, NumericalError for one that is not finite where that is to be held.
        """
        try:
            return [torch.as_tensor(finite_vector(name, x, self.robot.nv)) for name, x in given.items()]
        except InvalidInput as error:
            shapes = {real_tensor(name, x, torch.device("cpu")).shape for name, x in given.items()}
            if self.on_failure == "hold" and shapes == {(self.robot.nv,)}:
                raise NumericalError(str(error)) from None
            raise

    def limited(self, compute: Callable[[], Tensor]) -> Float[Tensor, " nv"]:
        """The torques (nv,) that `compute` returns, within the limits.

        Raises NumericalError where there are none or one is not finite, unless the last ones are to be held.
        """
        try:
            asked = compute()
            if not bool(asked.isfinite().all()):
                raise NumericalError("the torques of this controller are not finite; check its gains and the state.")
        except NumericalError:
            if self.on_failure == "raise":
                raise
            self.held += 1
            self.saturated = torch.zeros_like(self.saturated)
            return self.last.clone()
        self.last = torch.minimum(torch.maximum(asked, -self.torque_limits), self.torque_limits)
        self.saturated: Bool[Tensor, " nv"] = self.last != asked
        return self.last.clone()


def per_joint(name: str, given: Any, nv: int) -> Float[Tensor, " nv"]:
    """One number that is not negative per joint, of one for all or one each; infinite ones are allowed."""
    values = real_tensor(name, given, torch.device("cpu"))
    if values.shape not in ((), (nv,)) or values.is_meta:
        raise InvalidInput(f"{name} has shape {tuple(values.shape)} on {values.device}; give one number, or {nv}.")
    if not bool((values >= 0.0).all()):
        raise InvalidInput(f"{name} is {given!r}; give numbers of at least 0.")
    return values.expand(nv).clone()
