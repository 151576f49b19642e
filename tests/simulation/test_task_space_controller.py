import numpy as np
import pinocchio as pin

from forcegp.simulation.bullet import ArmState
from forcegp.simulation.scenarios import KukaSurfaceConfig
from forcegp.simulation.trajectory import joint_acceleration


def turned(quaternion: np.ndarray) -> np.ndarray:
    return pin.Quaternion(quaternion).toRotationMatrix()


def test_the_law_is_the_published_one_with_the_pseudo_inverse():
    rng = np.random.default_rng(0)
    orientation = np.array([0.0, -1.0, 0.0, 0.0])
    posture, selected = np.deg2rad((85, 50, -10, -100, -170, -25, -100)), np.array([0, 1, 1, 0, 1, 0, 0.0])
    for _ in range(20):
        q, v, J, bias = rng.normal(size=7), rng.normal(size=7), rng.normal(size=(6, 7)), rng.normal(size=6)
        position, aim = rng.normal(size=3), tuple(rng.normal(size=(3, 3)))
        present = (values := rng.normal(size=4)) / np.linalg.norm(values)
        state = ArmState(q, v, np.eye(7), np.zeros(7), position, present, J, bias)
        found = joint_acceleration(KukaSurfaceConfig(), state, aim)

        velocity = J @ v
        task = np.concatenate(
            [
                aim[2] + 2 * 100 * (aim[1] - velocity[:3]) + 1e4 * (aim[0] - position),
                -2 * 100 * velocity[3:] + 1e4 * pin.log3(turned(orientation) @ turned(present).T),
            ]
        )
        inverse = np.linalg.pinv(J)
        null = (np.eye(7) - inverse @ J) @ (selected * (1e4 * (posture - q) - 100 * v))
        np.testing.assert_allclose(found, inverse @ (task - bias) + null, rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(J @ found + bias, task, rtol=1e-9, atol=1e-6)
