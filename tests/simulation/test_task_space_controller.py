import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from forcegp.simulation.bullet import ArmState
from forcegp.simulation.scenarios import KukaSurfaceConfig
from forcegp.simulation.trajectory import TaskSpaceController, rotation_vector


def matrix(quaternion: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(quaternion).as_matrix()


@given(st.integers(0, 10_000))
def test_the_rotation_vector_turns_one_orientation_into_the_other_by_the_shorter_way(seed):
    rng = np.random.default_rng(seed)
    aim, present = (values / np.linalg.norm(values) for values in rng.normal(size=(2, 4)))
    vector = rotation_vector(aim, present)
    assert np.linalg.norm(vector) <= np.pi + 1e-12
    x, y, z = vector
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    np.testing.assert_allclose(expm(skew) @ matrix(present), matrix(aim), atol=1e-12)
    np.testing.assert_allclose(rotation_vector(-aim, present), vector, atol=1e-12)
    np.testing.assert_allclose(rotation_vector(aim, -present), vector, atol=1e-12)


def test_the_law_is_the_published_one_with_the_pseudo_inverse():
    rng = np.random.default_rng(0)
    orientation = np.array([0.0, -1.0, 0.0, 0.0])
    posture, selected = np.deg2rad((85, 50, -10, -100, -170, -25, -100)), np.array([0, 1, 1, 0, 1, 0, 0.0])
    controller = TaskSpaceController(KukaSurfaceConfig())
    for _ in range(20):
        q, v, J, bias = rng.normal(size=7), rng.normal(size=7), rng.normal(size=(6, 7)), rng.normal(size=6)
        position, aim = rng.normal(size=3), tuple(rng.normal(size=(3, 3)))
        present = (values := rng.normal(size=4)) / np.linalg.norm(values)
        found = controller.joint_acceleration(ArmState(q, v, np.eye(7), np.zeros(7), position, present, J, bias), aim)

        velocity = J @ v
        task = np.concatenate(
            [
                aim[2] + 2 * 100 * (aim[1] - velocity[:3]) + 1e4 * (aim[0] - position),
                -2 * 100 * velocity[3:] + 1e4 * rotation_vector(orientation, present),
            ]
        )
        inverse = np.linalg.pinv(J)
        null = (np.eye(7) - inverse @ J) @ (selected * (1e4 * (posture - q) - 100 * v))
        np.testing.assert_allclose(found, inverse @ (task - bias) + null, rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(J @ found + bias, task, rtol=1e-9, atol=1e-6)
