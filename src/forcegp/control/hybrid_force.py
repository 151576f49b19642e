"""Motion along a surface and force along its normal, without a force sensor."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.control.tracking import CLOSE, ROUNDS, TrackingController
from forcegp.errors import InvalidInput, require_type
from forcegp.models.predictor import Predictor
from forcegp.models.structured.components import surplus_of
from forcegp.robots.arguments import real_tensor


class HybridForce(TrackingController):
    """u = M a + h - A^T lambda_d - Q_U(lambda_d): a reference along the contacts, and wanted forces against them.

    a is the acceleration of the feedback, freed from what the contacts would resist: of all that satisfy A a = b the
    one nearest to it in the kinetic metric (Gauss' principle). lambda_d presses the robot onto the surface; friction
    under load, learned or known, is that of lambda_d. So the force is right where the model is: no sensor is read.

    * predictor: `posterior.predictor()` of a model with contacts and analytical mean. Gains as `TrackingController`
      has them. Forces are evaluated at (q, v_d), as in `ComputedTorque`; a call takes milliseconds: Broyden's method
      goes on from the torques and the Jacobian of the last call.
    """

    def __init__(self, predictor: Predictor, **settings: Any) -> None:
        self.predictor = require_type("predictor", predictor, Predictor, " : posterior.predictor()")
        self.system = predictor.posterior.system
        if not self.system.contacts:
            raise InvalidInput(
                "HybridForce wants a force against a contact, and this model has none; name it in "
                "posterior.with_contacts([...]), or use ComputedTorque."
            )
        super().__init__(self.system.robot, **settings)

    @override
    def restart(self) -> None:
        """Forget earlier calls and the integral of the error."""
        super().restart()
        self._u, self._inverse = self.last, torch.eye(self.robot.nv, dtype=torch.float64)

    @override
    def __call__(self, q: Any, v: Any, q_d: Any, v_d: Any, a_d: Any, normal_force: Any = None) -> Float[Tensor, " nv"]:
        """The torques (nv,) in Nm (N) for this reference and `normal_force` (m,) in N, one per contact.

        A normal force is positive where the surface pushes the robot off; a surface only pushes.
        """
        count = len(self.system.contacts)
        wanted = real_tensor("normal_force", 0.0 if normal_force is None else normal_force, torch.device("cpu"))
        if normal_force is None or wanted.shape not in ((), (count,)) or not bool((wanted >= 0.0).all()):
            raise InvalidInput(
                f"normal_force is {normal_force!r}; give the force in N with which the surface pushes, at least 0, one "
                f"per contact ({count})."
            )
        self.wanted = wanted.expand(count)
        return super().__call__(q, v, q_d, v_d, a_d)

    @override
    def _torques(self, q: Tensor, v: Tensor, v_d: Tensor, a_d: Tensor, e: Tensor, e_v: Tensor) -> Tensor:
        at = self.system.dynamics(q, v_d, torch.zeros_like(q))
        free = a_d + self.feedback(e, e_v)
        a = at.acceleration_map(known=False)((at.M @ free[..., None])[..., 0])  # M^-1 Q_b + H M a
        surplus = surplus_of(self.predictor.posterior, torch.cat([q, v_d, a])[None], self.wanted[None])
        with torch.no_grad():
            u, inverse, r = self._u, self._inverse, surplus(self._u[None])[0]
            for _ in range(ROUNDS):
                if float(r.abs().max()) <= CLOSE * (1.0 + float(u.abs().max())):
                    self._u, self._inverse = u, inverse
                    return u
                d = -inverse @ r
                u, before = u + d, r
                r = surplus(u[None])[0]
                back = inverse @ (r - before)  # Broyden 1965, "A class of methods for solving nonlinear equations"
                inverse = inverse + torch.outer(d - back, d @ inverse) / (d @ back)
        self._u = self.predictor.inverse_dynamics(q, v_d, a, self.wanted).mean  # Newton's method, or its error
        return self._u
