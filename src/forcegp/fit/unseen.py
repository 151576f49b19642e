"""What a log leaves open of the forces: joints that something pushes, and torques that contacts hide.

Accelerations show joint forces but for A^T lambda: an error of a torque along A^T goes into the contact forces unseen.
Its size cannot be learned without a force sensor. It has a prior from the robot, which predictions carry.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from forcegp.data import Dataset, evenly
from forcegp.doubts import Doubt, look
from forcegp.evidence.least_squares import NoiseLevels, Rows, orthonormal_columns, without
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.evidence.recorded_rows import RecordedRows
from forcegp.forces import Payload, RigidBodies
from forcegp.model import Model
from forcegp.noise import Noise
from forcegp.summary import listed

ROWS = 1000  # rows that are looked at, evenly spread
PUSHED = 0.5
"""Of what a joint without a drive needs for its motion: the force there that nobody measured, from which on something
pushes it. Friction of a bearing is a few per cent; a hand is more than the weight."""
ALONE = 0.05  # least share of a joint's force, squared, that contacts leave to be seen; below, they may carry all of it
FLAT = 10.0
"""Of what pushes a joint: its standard deviation. A hand is no white noise about zero: taken for one it pulls contact
forces towards those without a hand, by as much as other joints leave open (1.77 N for 1.47 on the leg of a Solo)."""
NONE = 1e-9  # of torques: of joints that nothing pushes, a standard deviation that has a logarithm
ROUNDED = 1e-4
"""Of what noise of joint forces makes of accelerations: least noise of these, so that covariances have an inverse."""
LEARNED = 0.02  # of torques: their noise where a search for it begins, when force sensors show it
OF_TORQUE = 0.2
"""Standard deviation of a torque that nothing shows, in the torque of the log or of its load: gains of drives that
nobody calibrated, and friction (10 to 16 % and 10 % on that leg, 9.5 % on a UR10e)."""


@dataclass(frozen=True, eq=False)
class Unseen:
    """Joints that something pushes, how strongly, and what contacts hide of torques; `typical` joint forces."""

    typical: Float[np.ndarray, " nv"]
    pushed: tuple[int, ...]
    pushing: Float[np.ndarray, " nv"]
    hidden: Float[np.ndarray, " nv"] | None

    @classmethod
    def of(cls, model: Model, log: Dataset, typical: Float[np.ndarray, " nv"]) -> "Unseen":
        """Of a log. Nothing is hidden where sensors measure all contacts."""
        nothing = cls(typical, (), np.zeros_like(typical), None)
        if not model.contacts or model.carries_known_forces:
            return nothing
        log = log.rows(evenly(log, ROWS))
        rows, robot, a = rows_of_known_physics(model, log), model.robot, np.array(log.a)
        residual = rows.in_torque(np.zeros(0), rows.moving(a))[0][:, : robot.nv]
        needed = rows.kinematics.inverse_dynamics(torch.as_tensor(a, device=robot.device)).cpu().numpy()
        single, pushing = np.isin(robot.joint_names, robot.single_joint_names), np.zeros_like(typical)
        for j in np.flatnonzero(single & ~rows.delivered.any(0)).tolist():
            force = push(residual, rows.open, typical, j)
            if _size(force) > PUSHED * _size(needed[:, j]):
                pushing[j] = _size(force)
        seen = all(contact.frame in rows.sensed for contact in model.contacts)
        hidden = None if seen else np.where(pushing > 0.0, FLAT * pushing, OF_TORQUE * typical)
        return cls(typical, tuple(np.flatnonzero(pushing).tolist()), pushing, hidden)

    def with_pushes(self, noise: Noise, rows: int = 1) -> Noise:
        """The noise with what pushes, and with that of joint forces where sensors show it, which is learned."""
        # A hand lasts: so many rows in which it pushes tell functions no more than one
        if noise.sensor is not None and noise.force is None:
            noise = replace(noise, force=tuple(LEARNED * self.typical))
        if not self.pushed:
            return noise
        return replace(noise, pushes=tuple(np.maximum(FLAT * np.sqrt(rows) * self.pushing, NONE * self.typical)))

    def levels(
        self,
        a: Float[np.ndarray, "rows nv"],
        found: Sequence[np.ndarray],
        open_: Float[np.ndarray, "rows m nv"],
        noise: Float[np.ndarray, " nv"],
    ) -> NoiseLevels:
        """Noise of torques as residuals show it, and of a as far as contacts forbid it, above rounding of the rest.

        `found` are predicted accelerations, M and H; `open_` directions of joint forces that no equation shows.
        """
        predicted, M, H = found
        missed = (a - predicted)[..., None]
        forbidden = (missed - H @ M @ missed)[..., 0]
        # without a row that shows it, a residual says nothing of a torque: contacts hide all of it
        force = np.where((open_**2).sum(1).mean(0) < 1.0 - 1e-6, noise, 1e-12)
        moved = np.sqrt((H**2 @ (force**2 + (FLAT * self.pushing) ** 2)).mean(0))
        return NoiseLevels(np.sqrt((forbidden**2).mean(0) + (ROUNDED * moved) ** 2).clip(1e-12), force)

    @property
    def stated(self) -> dict[str, list[float]]:
        """For the settings of a posterior, whose predictions of forces carry it: standard deviations per joint."""
        return {} if self.hidden is None else {"hidden_force": self.hidden.tolist()}

    def doubts(self, model: Model) -> list[Doubt]:
        """One, where something pushes a joint."""
        if not (names := [model.robot.joint_names[j] for j in self.pushed]):
            return []
        what = f"nothing drives {listed(names)}, u is 0 there, and the motion needs forces there that nobody "
        what += "measured. Its own equation is left out."
        do = "Contact forces follow from the other joints: predict them given accelerations, a=..."
        return [look(about="pushed joints", what=what, do=do, joints=tuple(names))]


def rows_of_known_physics(model: Model, log: Dataset) -> RecordedRows:
    """Rows of the model without what is to be learned."""
    stated = (law for law in model.laws if not law.learned and not (isinstance(law, Payload) and not law.known))
    closed = tuple(replace(law, learn=()) if isinstance(law, RigidBodies) else law for law in stated)
    alone = replace(model, forces=tuple(law for law in closed if not law.memory_names(model.robot)))
    u = log.u[:, [k for k, name in enumerate(model.inputs) if name in alone.inputs]]
    return RecordedRows(ParameterSpace(alone, {}), log.q, log.v, u, any_contact=True, sensed=log.measured)


def push(
    residual: Rows, open_: Float[np.ndarray, "rows m nv"], typical: Float[np.ndarray, " nv"], joint: int
) -> Float[np.ndarray, " rows"]:
    """What acts on a joint if it alone explains the residual of joint forces (`typical` size) that contacts leave."""
    span = orthonormal_columns(open_ / typical)
    left = without(residual / typical, span)
    axis = without(np.broadcast_to(np.eye(len(typical))[joint], left.shape), span)
    return typical[joint] * (axis * left).sum(1) / np.maximum((axis**2).sum(1), ALONE)


def _size(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))
