"""The tool of `kuka-surface` by Pinocchio."""

import numpy as np
import pinocchio as pin
from tests.robots.pinocchio_oracle import Oracle


class Tool:
    """Position of the contact point in the world (3,), for one posture."""

    def __init__(self, model):
        self.oracle = Oracle(model.robot.to_urdf(), model.robot)
        self.contact = model.contacts[0]

    def position(self, q: np.ndarray) -> np.ndarray:
        model, data = self.oracle.model, self.oracle.data
        pin.framesForwardKinematics(model, data, self.oracle.configuration(q))
        return data.oMf[model.getFrameId(self.contact.frame)].act(np.array(self.contact.point))

    def speed(self, q: np.ndarray, v: np.ndarray, step: float = 1e-6) -> float:
        return float(np.linalg.norm(self.position(q + step * v) - self.position(q - step * v)) / (2.0 * step))
