"""Motion along a surface and force along its normal, without a force sensor."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.control.tracking import TrackingController, torques_for
from forcegp.errors import InvalidInput, require_type
from forcegp.models.predictor import Predictor
from forcegp.models.structured.components import require_actuated
from forcegp.robots.arguments import real_tensor


class HybridForce(TrackingController):
    """u = M a + h - A^T lambda_d - Q_U(lambda_d): a reference along the contacts, and wanted forces against them.

    a is the acceleration of the feedback, freed from what the contacts would resist: of all that satisfy A a = b the
    one nearest to it in the kinetic metric (Gauss' principle). lambda_d presses the robot onto the surface; friction
    under load, learned or known, is that of lambda_d. So the force is right where the model is: no sensor is read.

    * predictor: `posterior.predictor()` of a model with contacts and analytical mean. Gains as `TrackingController`
      has them. Forces are evaluated at (q, v_d), as in `ComputedTorque`. Newton's method goes on from the torques of
      the last call, for friction under load depends on them.
    """

    def __init__(self, predictor: Predictor, **settings: Any) -> None:
        self.predictor = require_type("predictor", predictor, Predictor, " : posterior.predictor()")
        self.system = predictor.posterior.system
        if not self.system.touching or self.system.loops:
            raise InvalidInput(
                "HybridForce wants a force against a contact, and this model has none, or a closed loop; name it in "
                "posterior.with_contacts([...]), or use ComputedTorque."
            )
        require_actuated(predictor.posterior)
        super().__init__(self.system.robot, **settings)

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
        at = self.predictor.joint_forces(q, v_d, self.last)
        free = a_d + self.feedback(e, e_v)
        towards = torch.linalg.solve(at.M, at.A.mT)  # M^-1 A^T
        a = free + towards @ torch.linalg.lstsq(at.A @ towards, at.b - at.A @ free, driver="gelsd").solution
        u = torques_for(self.predictor, q, v_d, at.M @ a - at.A.mT @ self.wanted, self.last, at)
        # where that finds none with shorter steps, or its error
        return self.predictor.inverse_dynamics(q, v_d, a, self.wanted).mean if u is None else u
